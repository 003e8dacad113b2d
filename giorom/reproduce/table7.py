"""Table 7: wall time of 200 steps against the radius of the graph.

A larger radius means more edges, and the time of message passing goes into edges.
"""

from giorom.reproduce.report import Result
from giorom.reproduce.study import Study
from giorom.reproduce.timing import (
    METHODS,
    SIZES,
    TimedBody,
    equal_degree_radius,
    timed_body,
)
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

TITLE = "Table 7: seconds of 200 steps against the radius, plasticine"

PAPER_POINTS = 7056
"""Points of the paper's graph."""

PAPER: dict[float, dict[str, float]] = {
    0.04: {"paper": 20.1, "gns": 43.5, "gat": 146.5},
    0.05: {"paper": 34.3, "gns": 73.5, "gat": 236.5},
    0.06: {"paper": 47.6, "gns": 111.6, "gat": 394.2},
    0.07: {"paper": 65.8, "gns": 162.0, "gat": 532.8},
    0.08: {"paper": 89.7, "gns": 226.2, "gat": 645.2},
    0.09: {"paper": 104.1, "gns": 305.9, "gat": 733.8},
    0.10: {"paper": 109.3, "gns": 386.0, "gat": 812.5},
}
"""Seconds by radius [m] (arXiv:2407.03925v2, Table 7; RTX 3060)."""


def run(study: Study) -> Result:
    """Measure every method at every radius."""
    size = SIZES[study.scale.name]
    points = round(PAPER_POINTS / size.shrink_radii)
    rows = []
    with timed_body(study) as body:
        found = body.decode("transport", points=size.body_points, sparse_points=points)
        for method in METHODS:
            for paper_radius in _radii(body, method):
                radius = None
                if paper_radius is not None:
                    radius = equal_degree_radius(
                        paper_radius, points=points, instead_of=PAPER_POINTS
                    )
                row = step_row(method, body.step(method, points=points, radius=radius))
                rows.append(row | {"paper_radius": paper_radius, "radius": radius})
    for row in rows:
        row["upscale_seconds"] = upscale_seconds(found)
    compare_with_paper(rows, PAPER, by="paper_radius")
    return Result(
        id="table7",
        title=TITLE,
        columns=["method", "paper_radius", "radius", *COLUMNS],
        rows=rows,
        notes=[
            *shrink_note(size.shrink_radii, what=f"The paper has {PAPER_POINTS} points."),
            *timing_notes(study),
            upscale_note(found),
        ],
        draw=draw_times(rows, over="radius", label="radius of the graph [m]", title=TITLE),
    )


def _radii(body: TimedBody, method: str) -> list[float | None]:
    """The paper's radii; none for a stepper without a graph."""
    if not body.uses_graph(method):
        return [None]
    return list(PAPER)[: body.size.cells]
