"""Table 10: how many message-passing layers, their error and the time of a rollout.

The layers are split evenly before and after the latent grid: 4 are two and two, the network of the
other tables. (Its rollout of 0.0008 with 2 is also Table 4's, so that the paper may count the
layers of each of the two interaction operators instead; row 2n would then be the paper's row n.)
The paper says time per step; by its Table 8 it must be seconds of a rollout of 200 steps.
"""

from typing import Any

from giorom.reproduce.ablation import (
    NETWORK,
    TIMED_FRAMES,
    Variant,
    frame_cost,
    network_changes,
    train_variants,
    trials_of,
)
from giorom.reproduce.charts import OURS, draw_paper, draw_rows, finish
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study
from giorom.reproduce.trial import Trial

TITLE = "Table 10: message-passing layers, time and error"

SYSTEM = "plasticine3d"
"""System; the paper does not name its own, whose 0.0008 is that of plasticine."""

PAPER = {2: (3.6, 8e-4), 4: (3.8, 9e-4), 6: (4.2, 1.4e-3), 8: (4.3, 9e-4)}
"""Seconds per rollout and loss by layers; Table 10 of arXiv:2407.03925v2, 2,247 nodes, radius
0.077 m, a GPU."""

STEPS = 200
"""Steps of a rollout."""


def variants(study: Study) -> list[Variant]:
    """One variant for each number of layers."""
    return [
        Variant(
            system=SYSTEM,
            labels={"layers": layers},
            changes=network_changes(
                study, SYSTEM, {"layers_before": layers // 2, "layers_after": layers // 2}
            ),
            paper=loss,
        )
        for layers, (_, loss) in PAPER.items()
    ]


def run(study: Study) -> Result:
    """Train with every number of layers, then time a frame of each."""
    made = variants(study)
    rows = train_variants(study, made)
    for trials, row in zip(trials_of(study, made), rows, strict=True):
        row.update(_seconds(study, trials))
        row["paper_seconds"] = PAPER[row["layers"]][0]
    first = rows[0]
    for row in rows:
        row["times_2_layers"] = _over(row["rollout_seconds"], first["rollout_seconds"])
        row["paper_times_2_layers"] = row["paper_seconds"] / first["paper_seconds"]
    return Result(
        id="table10",
        title=TITLE,
        columns=[
            "layers",
            "rollout_seconds",
            "network_seconds",
            "graph_seconds",
            "edges",
            "times_2_layers",
            "paper_seconds",
            "paper_times_2_layers",
            "rollout_mse",
            "diverged",
            "paper",
            "ratio",
            "parameters",
        ],
        rows=rows,
        notes=_notes(rows, study),
        draw=lambda figure: draw(figure, rows),
    )


def _seconds(study: Study, trials: list[Trial]) -> dict[str, Any]:
    """Seconds of a rollout by the median frame."""
    names = ("graph_seconds", "network_seconds")
    cost = frame_cost(study, trials, upscale=False)
    if cost is None:
        return dict.fromkeys(("rollout_seconds", "samples", *names))
    seconds = {name: STEPS * cost[name] for name in names}
    sizes = {"samples": cost["points"], "edges": cost["edges"]}
    return {"rollout_seconds": STEPS * cost["step_seconds"], **seconds, **sizes}


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value / other


def _notes(rows: list[dict[str, Any]], study: Study) -> list[str]:
    samples = next((row["samples"] for row in rows if row["samples"]), None)
    return [
        f"Layers are split evenly before and after the latent grid of {NETWORK}. The paper's "
        f"0.0008 for 2 layers is also its Table 4, whose network has 2 and 2: if it counts the "
        f"layers of one interaction operator, its row n belongs to our row 2 n.",
        f"Seconds of {STEPS} frames: the median of {TIMED_FRAMES} after a warm-up, on one thread, "
        f"the graph apart from the network, {samples} samples. The paper: 2,247 nodes on a GPU, "
        f"said to be per step, which its Table 8 contradicts; the growth with the layers can be "
        f"compared, the seconds cannot.",
        f"Rollout error of the samples [m²], {len(study.seeds)} seed(s) each.",
    ]


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Error on the left, time relative to two layers on the right."""
    left, right = figure.subplots(1, 2)
    layers = [row["layers"] for row in rows]
    draw_rows(left, rows, layers)
    draw_paper(left, layers, [row["paper"] for row in rows])
    finish(left, x="message-passing layers")
    known = [row for row in rows if row["times_2_layers"] is not None]
    right.plot(
        [row["layers"] for row in known],
        [row["times_2_layers"] for row in known],
        "o-",
        color=OURS,
        label="ours",
    )
    draw_paper(right, layers, [row["paper_times_2_layers"] for row in rows])
    right.set_xlabel("message-passing layers")
    right.set_ylabel("time of a rollout, 2 layers = 1")
    right.set_ylim(bottom=0.0)
    right.grid(visible=True, alpha=0.3)
    right.legend(fontsize="small")
    for axes in (left, right):
        axes.set_xticks(layers)
