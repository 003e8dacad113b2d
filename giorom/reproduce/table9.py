"""Table 9: a step of few samples and the recovery of many points, against a step of them all.

The stepper moves 1776 samples whatever the number of points, and only the recovery depends on it;
GNS moves every point.
"""

from collections.abc import Callable
from typing import Any

from giorom.reproduce.report import Result
from giorom.reproduce.study import Study
from giorom.reproduce.timing import ROLLOUT, SIZES, equal_degree_radius, timed_body
from giorom.reproduce.timing_table import timing_notes, upscale_seconds

TITLE = "Table 9: seconds of 200 frames of all points, plasticine"

SPARSE_POINTS, RADIUS = 1776, 0.06
"""Samples, and radius of their graph [m] (arXiv:2407.03925v2, Tables 8 and 9)."""

POINTS = (7_000, 20_000, 40_000, 60_000, 100_000)
"""Points of the body, about; the paper goes from 7k to 100k."""

TINY_SPARSE, TINY_POINTS = 60, (200, 400)
"""The same where only the command is shown."""

DENSE = "gns"
"""What moves all points instead."""

FIELDS = ("local", "transport", "neural_basis", "pod")
"""What recovers all points; the paper's is a neural basis."""

COLUMNS = [
    "points",
    "field",
    "bind_seconds",
    "upscale_seconds",
    "seconds_paper",
    "seconds_default",
    "gns_seconds",
    "gns_estimated",
    "times_faster_paper",
    "times_faster_default",
    "upscale_memory_mb",
    "gns_memory_mb",
    "gns_edges",
]


def run(study: Study) -> Result:
    """Measure steppers on the samples, fields on the points, and GNS on the points."""
    is_tiny = SIZES[study.scale.name].cells is not None
    sparse = TINY_SPARSE if is_tiny else SPARSE_POINTS
    with timed_body(study) as body:
        radius = equal_degree_radius(RADIUS, points=sparse, instead_of=SPARSE_POINTS)
        steps = {
            "paper": body.step("paper", points=sparse, radius=radius),
            "default": body.step("default", points=sparse, radius=None),
        }
        rows: list[dict[str, Any]] = []
        known, known_at = None, 0
        for points in TINY_POINTS if is_tiny else POINTS:
            wanted = steps["paper"]["edges"] / sparse * points
            if known is None or wanted <= body.size.most_edges:
                wider = equal_degree_radius(radius, points=points, instead_of=sparse)
                known, known_at = body.step(DENSE, points=points, radius=wider), points
            for field in FIELDS:
                found = body.decode(field, points=points, sparse_points=sparse)
                row = {"field": field, "gns_estimated": known_at != points}
                rows.append(row | _row(found, steps) | _beside(found, steps, known))
    return Result(
        id="table9",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=_notes(study, steps),
        draw=_drawing(rows),
    )


def _row(found: dict[str, Any], steps: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A recovery, and the whole of it with each stepper."""
    upscale = upscale_seconds(found)
    return {
        "points": found["points"],
        "sparse_points": found["sparse_points"],
        "bind_seconds": found["bind_seconds"],
        "upscale_seconds": upscale,
        "upscale_memory_mb": found["peak_bytes"] / 1e6,
        **{
            f"seconds_{name}": ROLLOUT * step["step_seconds"] + upscale
            for name, step in steps.items()
        },
    }


def _beside(
    found: dict[str, Any], steps: dict[str, dict[str, Any]], dense: dict[str, Any]
) -> dict[str, Any]:
    """GNS on all points beside it: measured, or of a smaller body times the ratio of the points."""
    factor = found["points"] / dense["points"]
    seconds = ROLLOUT * dense["step_seconds"] * factor
    upscale = upscale_seconds(found)
    return {
        "gns_seconds": seconds,
        "gns_memory_mb": factor * dense["peak_bytes"] / 1e6,
        "gns_edges": round(factor * dense["edges"]),
        **{
            f"times_faster_{name}": seconds / (ROLLOUT * step["step_seconds"] + upscale)
            for name, step in steps.items()
        },
    }


def _notes(study: Study, steps: dict[str, dict[str, Any]]) -> list[str]:
    moved = ", ".join(
        f"{name} {ROLLOUT * step['step_seconds']:.3g} s and {step['peak_bytes'] / 1e6:.3g} MB"
        for name, step in steps.items()
    )
    sparse = steps["paper"]
    return [
        f"`seconds paper` and `seconds default` are {ROLLOUT} steps of {sparse['points']} samples "
        f"({moved}; {sparse['edges']} edges for the network) and the recovery of all points, "
        f"binding included. `times faster` is GNS on all points over that.",
        f"All {SIZES[study.scale.name].frames} frames of the motion are decoded in their order and "
        f"counted.",
        "GNS has on every number of points as many neighbours to a point as the samples have, "
        "which is kinder to it than one radius for all. Where that graph has more than "
        f"{SIZES[study.scale.name].most_edges} edges it was not run: its time and memory are those "
        "of the largest body it was run on, times the ratio of the points (`gns estimated`).",
        "The paper's own numbers of this table are not known to us. Its Table 8 gives 3.9 s for "
        "its network on 1776 points, and 111.6 s for GNS on 7056 at the same radius.",
        *timing_notes(study),
    ]


def _drawing(rows: list[dict[str, Any]]) -> Callable[[Any], None]:
    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2, sharex=True)
        for field in FIELDS:
            own = [row for row in rows if row["field"] == field]
            points = [row["points"] for row in own]
            left.plot(points, [row["seconds_paper"] for row in own], marker="o", label=field)
            right.plot(points, [row["seconds_default"] for row in own], marker="o", label=field)
        for axes, name in ((left, "the paper's network"), (right, "grid stepper (default)")):
            for estimated, style in ((False, "s"), (True, "x")):
                own = [row for row in rows if row["gns_estimated"] is estimated]
                if not own:
                    continue
                axes.plot(
                    [row["points"] for row in own],
                    [row["gns_seconds"] for row in own],
                    style,
                    color="black",
                    label="GNS on all points" + (", estimated" if estimated else ""),
                )
            axes.set_title(f"{name} on the samples, all points recovered")
            axes.set_xlabel("points")
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.grid(alpha=0.3, which="both")
        left.set_ylabel(f"time of {ROLLOUT} frames [s]")
        left.legend()
        figure.set_size_inches(11.0, 4.8)

    return draw
