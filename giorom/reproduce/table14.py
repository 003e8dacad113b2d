"""Table 14: how many training trajectories a model needs, water in two dimensions.

The first n of the data set are trained on, with scales from these alone; validation and test stay.
"""

from typing import Any

from giorom.data.trajectory_file import trajectory_count
from giorom.reproduce.ablation import NETWORK, Variant, train_variants
from giorom.reproduce.charts import OTHER, OURS, draw_paper, draw_rows, finish
from giorom.reproduce.methods import METHODS
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study

TITLE = "Table 14: number of training trajectories, water in 2-D"

SYSTEM = "water2d"
"""System of the table."""

PAPER = {50: 1.0e-2, 150: 6.7e-3, 200: 6.4e-3, 400: 6.1e-3, 1000: 5.9e-3}
"""Rollout error [m^2] by training trajectories; Table 14 of arXiv:2407.03925v2."""

MOST = 1000
"""Training trajectories of the paper's whole set."""

COLORS = {NETWORK: OURS, "default": OTHER}
"""Methods that are trained, and their colours."""


def counts(present: int) -> dict[int, float]:
    """The shares that the paper takes of its set, of a set of ``present`` trajectories.

    Args:
        present: Training trajectories there are.

    Returns:
        The paper's error by number of trajectories; of equal numbers the larger share.
    """
    return {max(1, round(present * count / MOST)): error for count, error in PAPER.items()}


def variants(present: int) -> list[Variant]:
    """Every method with every number of trajectories."""
    return [
        Variant(
            system=SYSTEM,
            method=method,
            labels={
                "method": METHODS[method].title,
                "trajectories": count,
                "share": count / present,
            },
            changes={} if count == present else {"training": {"trajectories": count}},
            paper=error if method == NETWORK else None,
        )
        for method in COLORS
        for count, error in counts(present).items()
    ]


def run(study: Study) -> Result:
    """Train on every number of trajectories."""
    present = trajectory_count(study.dataset(SYSTEM), "train")
    rows = train_variants(study, variants(present))
    return Result(
        id="table14",
        title=TITLE,
        columns=[
            "method",
            "trajectories",
            "share",
            "rollout_mse",
            "diverged",
            "paper",
            "ratio",
            "steps",
        ],
        rows=rows,
        notes=[
            f"Share of the {present} training trajectories there are; the paper's is of {MOST}, "
            f"and its numbers stand beside the same share: 50, 150, 200, 400 and 1000.",
            "Every training has the same time, however many trajectories it sees. Errors of the "
            "samples [m²] on the same test trajectories.",
        ],
        draw=lambda figure: draw(figure, rows),
    )


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Error by share of the trajectories."""
    axes = figure.add_subplot()
    for method, color in COLORS.items():
        title = METHODS[method].title
        chosen = [row for row in rows if row["method"] == title]
        draw_rows(axes, chosen, [row["share"] for row in chosen], label=title, color=color)
    shares = [count / MOST for count in PAPER]
    draw_paper(axes, shares, list(PAPER.values()), label=f"paper ({MOST} trajectories = 1)")
    finish(axes, x="share of the training trajectories")
    axes.set_xscale("log")
