"""Table 8: wall time of 200 steps against the number of points at one radius.

The body stays, so that more points at one radius mean more neighbours each: edges grow with the
square of the points.
"""

from giorom.reproduce.report import Result
from giorom.reproduce.study import Study
from giorom.reproduce.timing import METHODS, SIZES, equal_degree_radius, timed_body
from giorom.reproduce.timing_table import (
    COLUMNS,
    compare_with_paper,
    draw_times,
    shrink_note,
    step_row,
    timing_notes,
    upscale_note,
    upscale_seconds,
)

TITLE = "Table 8: seconds of 200 steps against the number of points, plasticine"

PAPER_RADIUS = 0.06
"""Radius of the paper's graphs [m]."""

PAPER: dict[int, dict[str, float]] = {
    1776: {"paper": 3.9, "gns": 7.8, "gat": 71.1},
    4143: {"paper": 14.5, "gns": 38.3, "gat": 153.4},
    5608: {"paper": 27.3, "gns": 68.7, "gat": 295.3},
    7056: {"paper": 47.6, "gns": 111.6, "gat": 394.2},
}
"""Seconds by number of points (arXiv:2407.03925v2, Table 8; RTX 3060)."""

PAPER_PARAMETERS = {"paper": 4_312_247, "gns": 1_592_987, "gat": 1_999_003}
"""Parameters as the paper counts them."""


def run(study: Study) -> Result:
    """Measure every method at every number of points."""
    size = SIZES[study.scale.name]
    radius = equal_degree_radius(PAPER_RADIUS, points=1.0, instead_of=size.shrink_points)
    rows = []
    with timed_body(study) as body:
        for method in METHODS:
            for paper_points in list(PAPER)[: size.cells]:
                points = round(paper_points / size.shrink_points)
                found = body.step(
                    method, points=points, radius=radius if body.uses_graph(method) else None
                )
                decoded = body.decode("transport", points=size.body_points, sparse_points=points)
                rows.append(
                    step_row(method, found)
                    | {
                        "paper_points": paper_points,
                        "paper_parameters": PAPER_PARAMETERS.get(method),
                        "upscale_seconds": upscale_seconds(decoded),
                    }
                )
    compare_with_paper(rows, PAPER, by="paper_points")
    return Result(
        id="table8",
        title=TITLE,
        columns=["method", "paper_points", *COLUMNS, "paper_parameters"],
        rows=rows,
        notes=[
            *shrink_note(size.shrink_points, what=f"The radius is {radius:.4g} m everywhere."),
            *timing_notes(study),
            upscale_note(decoded),
        ],
        draw=draw_times(rows, over="points", label="points", title=TITLE),
    )
