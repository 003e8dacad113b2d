"""The peers that Table 3 lacks: newer networks and a linear model, in the setting of Table 3."""

from giorom.reproduce.drawing import panels_of
from giorom.reproduce.methods import NEWER_ROWS
from giorom.reproduce.report import Result
from giorom.reproduce.scale import SYSTEMS_3D
from giorom.reproduce.stepper_table import COLUMNS, Comparison, compare_steppers, ranks
from giorom.reproduce.study import Study
from giorom.reproduce.table3 import notes

TITLE = "The peers that Table 3 lacks: newer networks and a linear model"


def run(study: Study) -> Result:
    """Train all on all systems, with the first seed."""
    comparison = Comparison(
        systems=SYSTEMS_3D,
        methods=("io-not-io", *NEWER_ROWS),
        paper={},
        seeds=study.seeds[:1],
    )
    rows = compare_steppers(study, comparison)

    columns = [column for column in COLUMNS if column not in ("paper", "ratio")]
    return Result(
        id="peers",
        title=TITLE,
        columns=columns,
        rows=rows,
        notes=[*ranks(rows), "One seed each; Table 3 has all.", *notes()[:5]],
        draw=panels_of(rows),
    )
