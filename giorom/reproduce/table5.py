"""Table 5: the time-stepper swapped, the field kept: samples forecast, all particles recovered."""

from typing import Any

from giorom.reproduce.compare import paired, score_columns, with_ratio
from giorom.reproduce.drawing import panels_of
from giorom.reproduce.methods import METHODS
from giorom.reproduce.report import Result
from giorom.reproduce.scale import SYSTEMS_3D
from giorom.reproduce.stepper_table import ranks, relative
from giorom.reproduce.study import Study, Trial
from giorom.reproduce.tuning import chosen_pair, tuned

TITLE = "Table 5: rollout error with the time-stepper swapped and the field kept"

ROWS = ("default", "io-not-io", "gns", "io-fno-io")

PAPER = {
    "water3d": {"io-not-io": 0.0106, "gns": 0.011, "io-fno-io": 0.025},
    "sand3d": {"io-not-io": 0.0009, "gns": 0.0008, "io-fno-io": 0.0067},
    "plasticine3d": {"io-not-io": 0.0008, "gns": 0.0038, "io-fno-io": 0.0072},
    "elastic3d": {"io-not-io": 0.0004, "gns": 0.0019, "io-fno-io": 0.0058},
}
"""Rollout errors [m^2] of arXiv:2407.03925v2, Table 5; those of Table 3, so of the samples."""

COLUMNS = [
    "system",
    "method",
    "rollout_mse",
    "projection_floor_mse",
    "sparse_rollout_mse",
    "paper",
    "ratio",
    "times_ours",
    "diverged",
    "steps",
    "parameters",
    "edges",
]

SCORES = {
    "rollout_mse": ("full", "rollout_mse"),
    "projection_floor_mse": ("full", "projection_floor_mse"),
    "sparse_rollout_mse": ("sparse", "rollout_mse"),
    "one_step_mse": ("full", "one_step_mse"),
    "static_mse": ("full", "static_mse"),
    "chamfer": ("full", "chamfer"),
}
"""Columns that are scores."""


def run(study: Study) -> Result:
    """Train each time-stepper on each system with every seed and score it on all particles."""
    asked = [
        Trial(system=system, method=method, seed=seed)
        for system in SYSTEMS_3D
        for method in ROWS
        for seed in study.seeds
    ]
    trials = tuned(study, asked)
    study.train_all(trials)
    rows = [row for system in SYSTEMS_3D for row in _system_rows(study, system, trials)]

    return Result(
        id="table5",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=[
            *ranks(rows),
            "`rollout mse` is that of all particles, end to end: the samples are forecast and all "
            "particles recovered by the field of the preset. `projection floor mse` is what the "
            "field leaves of it with the true samples.",
            "The paper's numbers are those of its Table 3, on the samples: `ratio` is that of "
            "`sparse rollout mse` to them.",
            "Where the paper trains IO + FNO + IO with noise, all networks here get theirs by the "
            "same tuning.",
            "`times ours`: error of all particles over that of ours, geometric mean over test "
            "trajectories, with the 95 % interval of a bootstrap over them.",
        ],
        draw=panels_of([row | {"paper": None} for row in rows]),
    )


def _system_rows(study: Study, system: str, trials: list[Trial]) -> list[dict[str, Any]]:
    """A row for every time-stepper."""
    found = {m: [t for t in trials if (t.system, t.method) == (system, m)] for m in ROWS}
    scores = {method: [study.scores(trial) for trial in mine] for method, mine in found.items()}
    rows = []
    for method, mine in scores.items():
        row = {"system": system, "method": METHODS[method].title, "name": method}
        row |= score_columns(mine, SCORES)
        others = mine if method != "default" else []
        against = paired(others, scores["default"], key="rollout_mse")
        row |= {relative(key): value for key, value in against.items()}
        row |= with_ratio(row["sparse_rollout_mse"], PAPER[system].get(method))
        rows.append(row | chosen_pair(found[method][0]))
    return rows
