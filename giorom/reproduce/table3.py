"""Table 3: rollout error of the samples, time-stepper against time-stepper, on four 3-D systems."""

from giorom.reproduce.drawing import panels_of
from giorom.reproduce.methods import PAPER_ROWS
from giorom.reproduce.report import Result
from giorom.reproduce.scale import SYSTEMS_3D
from giorom.reproduce.stepper_table import COLUMNS, Comparison, compare_steppers, ranks
from giorom.reproduce.study import Study

TITLE = "Table 3: rollout error of the samples of six networks and of ours"

PAPER = {
    "water3d": (0.011, 0.06, 0.38, 0.046, 0.15, 0.0106),
    "plasticine3d": (0.0038, 0.0083, 0.09, 0.0052, 0.097, 0.0008),
    "elastic3d": (0.0019, 0.0097, 0.18, 0.0028, 0.084, 0.0004),
    "sand3d": (0.0008, 0.011, 0.07, 0.0085, 0.0075, 0.0009),
}
"""Rollout errors [m^2] of arXiv:2407.03925v2, Table 3, in the order of ``PAPER_ROWS``. The text of
the paper that we had does not carry the labels of the rows: the first and the last follow from its
Table 5, the others from the order in which the methods are named."""


def run(study: Study) -> Result:
    """Train all on all systems, with every seed."""
    comparison = Comparison(
        systems=SYSTEMS_3D,
        methods=PAPER_ROWS,
        paper={
            system: dict(zip(PAPER_ROWS, values, strict=True)) for system, values in PAPER.items()
        },
        seeds=study.seeds,
    )
    rows = compare_steppers(study, comparison)

    return Result(
        id="table3",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=[*ranks(rows), *notes()],
        draw=panels_of(rows),
    )


def notes() -> list[str]:
    """How the columns are counted."""
    return [
        "Errors are mean squared distances of the samples in m², the given frames counted as in "
        "the paper; in brackets the range over seeds. Rollouts that diverged are in no mean.",
        "`times ours`: error over that of ours, geometric mean over test trajectories, with the "
        "95 % interval of a bootstrap over them.",
        "`equal steps mse`: a training of the first seed with as many optimiser steps as the "
        "slowest of the networks did in the equal time. Ours is fitted to whole rollouts, by a "
        "search where a grid moves the samples: its steps are not those of a network, and it has "
        "no such number.",
        "`lasted`: frames until a rollout diverged, the mean over all rollouts.",
        "`edges`: edges of the graph that the method reads, at the first frame.",
        "The paper's numbers are of its own data, sizes and training times: a scale, not a target. "
        "The cross in the picture is the paper's.",
    ]
