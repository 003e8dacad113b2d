"""Table 4: parts of the network exchanged, plasticine, with the noise that each is trained with.

The paper tries four noises for its weakest variant, two for another and one for the rest. Here
every network has no noise and 3e-4 m, beside whatever more the paper has.
"""

from typing import Any

from giorom.reproduce.ablation import Variant, train_variants
from giorom.reproduce.charts import ERROR, OURS, PAPER
from giorom.reproduce.methods import METHODS
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study

TITLE = "Table 4: parts of the network exchanged, plasticine"

SYSTEM = "plasticine3d"
"""System of the table."""

ROWS: tuple[tuple[str, float, float | None, float | None], ...] = (
    ("io-not-io", 0.0, 1.17e-9, 8e-4),
    ("io-not-io", 3e-4, None, None),
    ("not", 0.0, 3.35e-9, 0.05),
    ("not", 3e-4, None, None),
    ("io-fno-io", 0.0, 2.1e-9, 0.117),
    ("io-fno-io", 3e-4, 3.4e-9, 3.2e-3),
    ("2gno-fno-2gno", 0.0, None, None),
    ("2gno-fno-2gno", 3e-4, 1.9e-7, 0.09),
    ("gno-fno-gno", 0.0, 8.0e-9, 21.84),
    ("gno-fno-gno", 3e-6, 9.5e-9, 16.70),
    ("gno-fno-gno", 3e-4, 2.8e-7, 0.36),
    ("gno-fno-gno", 3e-3, 2.67e-5, 2.85),
)
"""Method, noise [m], one-step and rollout error of the paper [m^2], where it has them; Table 4 of
arXiv:2407.03925v2."""


def variants() -> list[Variant]:
    """One variant a row."""
    return [
        Variant(
            system=SYSTEM,
            method=method,
            labels={
                "network": METHODS[method].title,
                "noise": noise,
                "paper_one_step_mse": one_step,
            },
            changes={"training": {"noise_std": noise}},
            paper=rollout,
        )
        for method, noise, one_step, rollout in ROWS
    ]


def run(study: Study) -> Result:
    """Train every network with every noise."""
    rows = train_variants(study, variants(), full=True)
    return Result(
        id="table4",
        title=TITLE,
        columns=[
            "network",
            "noise",
            "one_step_mse",
            "paper_one_step_mse",
            "rollout_mse",
            "diverged",
            "paper",
            "ratio",
            "parameters",
        ],
        rows=rows,
        notes=_notes(rows),
        draw=lambda figure: draw(figure, rows),
    )


def _notes(rows: list[dict[str, Any]]) -> list[str]:
    still = rows[0]["static_mse"]
    known = "" if still is None else f" Holding still has a rollout error of {still:.3g} m²."
    return [
        "Noise is the spread of the training noise on the newest velocity, as displacement per "
        "frame [m]; one-step and rollout errors are those of the samples [m²].",
        "Rows without an entry of the paper are noises that the paper tries for other networks "
        "alone.",
        f"The paper averages rollouts that diverge (its 21.84 m² in a box of one metre); here they "
        f"are counted and left out.{known}",
    ]


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Rollout errors of all rows with their range over seeds, the paper's beside ours."""
    figure.set_size_inches(8.0, 6.0)
    axes = figure.add_subplot()
    lines = range(len(rows))
    for line, row in enumerate(rows):
        if row["rollout_mse"] is None:
            axes.text(0.02, line, "diverged", transform=axes.get_yaxis_transform(), va="center")
    known = [(line, row) for line, row in enumerate(rows) if row["rollout_mse"] is not None]
    values = [row["rollout_mse"] for _, row in known]
    below = [row["rollout_mse"] - row["rollout_mse_min"] for _, row in known]
    above = [row["rollout_mse_max"] - row["rollout_mse"] for _, row in known]
    places = [line for line, _ in known]
    axes.errorbar(values, places, xerr=[below, above], fmt="o", color=OURS, capsize=3, label="ours")
    paper = [(row["paper"], line) for line, row in enumerate(rows) if row["paper"] is not None]
    axes.plot(*zip(*paper, strict=True), "s", color=PAPER, markerfacecolor="none", label="paper")
    axes.set_yticks(lines, [f"{row['network']}, {row['noise']:g} m" for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel(ERROR)
    axes.set_ylabel("network, training noise per frame")
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.legend(fontsize="small")
