"""Measured times as rows, notes and pictures of a table."""

from collections.abc import Callable
from itertools import groupby
from typing import Any

from giorom.evaluation.stage_speed import FEWEST_STEPS
from giorom.reproduce.study import Study
from giorom.reproduce.timing import ROLLOUT, SIZES

COLUMNS = [
    "points",
    "degree",
    "edges",
    "parameters",
    "graph_seconds",
    "network_seconds",
    "integration_seconds",
    "seconds",
    "times_papers_network",
    "upscale_seconds",
    "memory_mb",
    "steps_timed",
    "paper",
    "ratio",
    "paper_times_papers_network",
]
"""Columns of the tables of times, behind the method and what varies."""


def step_row(method: str, found: dict[str, Any]) -> dict[str, Any]:
    """A measured step as columns of a table, times for a whole rollout.

    Args:
        method: Name of the stepper.
        found: What ``measure_step`` gave.
    """
    stages = {name: found[f"{name}_seconds"] for name in ("graph", "network", "integration")}
    return {
        "method": method,
        "points": found["points"],
        "edges": found["edges"],
        "degree": found["edges"] / found["points"],
        "parameters": found["parameters"],
        **{
            f"{name}_seconds": None if value is None else ROLLOUT * value
            for name, value in stages.items()
        },
        "seconds": ROLLOUT * found["step_seconds"],
        "seconds_min": ROLLOUT * found["step_seconds_min"],
        "seconds_max": ROLLOUT * found["step_seconds_max"],
        "memory_mb": found["peak_bytes"] / 1e6,
        "steps_timed": found["steps_timed"],
    }


def upscale_seconds(found: dict[str, Any]) -> float:
    """Seconds of the recovery of all points over a whole rollout, binding included.

    Args:
        found: What ``measure_decode`` gave.
    """
    return found["bind_seconds"] + ROLLOUT * found["decode_seconds"] / found["frames"]


def compare_with_paper(
    rows: list[dict[str, Any]], published: dict[Any, dict[str, float]], *, by: str
) -> None:
    """Write into rows the paper's seconds, our share of them, and both in units of its network.

    A method without a graph is compared with the paper's network at the first of its values.

    Args:
        rows: Rows of ``step_row``, changed in place.
        published: The paper's seconds by what varies, then by method.
        by: Column of what varies, in the paper's values.
    """
    ours = {row[by]: row["seconds"] for row in rows if row["method"] == "paper"}
    for row in rows:
        here = published.get(row[by], {})
        row["paper"] = here.get(row["method"])
        row["ratio"] = None if row["paper"] is None else row["seconds"] / row["paper"]
        row["times_papers_network"] = _share(row["seconds"], ours.get(row[by]))
        row["paper_times_papers_network"] = _share(row["paper"], here.get("paper"))


def _share(value: float | None, whole: float | None) -> float | None:
    return None if value is None or whole is None else value / whole


def timing_notes(study: Study) -> list[str]:
    """What has to be said below every table of times."""
    size = SIZES[study.scale.name]
    memory = (
        "what a step allocates on the GPU beyond what was allocated before it"
        if study.device == "cuda"
        else "the growth of the process' resident memory to its high-water mark (VmHWM, set back "
        "before the step) during the first step of a process that has done nothing before; that "
        "of the grid stepper is mostly its kernels being loaded"
    )
    return [
        f"Seconds are those of {ROLLOUT} steps: {ROLLOUT} times the median over the timed steps "
        f"(column `steps timed`: up to {size.steps}; fewer, but at least "
        f"{min(FEWEST_STEPS, size.steps)}, where one takes long); in brackets fastest and slowest "
        f"step; one step in advance is not counted. The steps start from "
        f"frames spread evenly over {size.frames} frames of the solver's motion. Float32, batch "
        f"of one, {study.jobs} thread(s), device {study.device}, eager; graphs are built on the "
        f"way, nothing is written. `network` contains the features.",
        "The networks have random weights, on which no time depends. Only live parameters count: "
        "the paper prints 4,312,247 for its network, of which 2,387,669 do anything.",
        "The grid stepper (`default`) has no graph and no radius; `network` is its whole step, "
        "integration included. Its grid is that of the preset whatever the number of points.",
        f"Memory is {memory}."
        + ("" if study.scale.alone else " At this scale it was measured in the running process."),
        "The paper timed an RTX 3060, with graphs built on its CPU, and does not give the number "
        "of edges; `times papers network` is what can be compared across machines.",
    ]


def upscale_note(found: dict[str, Any]) -> str:
    """What the column ``upscale_seconds`` counts.

    Args:
        found: What ``measure_decode`` gave for moving least squares.
    """
    return (
        f"`upscale` recovers {found['points']} points by moving least squares (transport), "
        f"binding included, and is not part of the seconds."
    )


def shrink_note(shrink: float, *, what: str) -> list[str]:
    """How fewer points than the paper's stand for them; nothing where they do not."""
    if shrink == 1.0:
        return []
    return [
        f"{shrink:g} times fewer points than the paper's, radii {shrink ** (1 / 3):.3g} times "
        f"larger: in the interior of the body a point has as many neighbours as in the paper's "
        f"graph of the same body, near its surface fewer. {what}"
    ]


def draw_times(
    rows: list[dict[str, Any]], *, over: str, label: str, title: str
) -> Callable[[Any], None]:
    """A function that draws seconds against what varies, a line for each method.

    Args:
        rows: Rows of ``step_row``.
        over: Column on the horizontal axis.
        label: Its title.
        title: Title of the picture.
    """

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        for name, group in groupby(rows, key=lambda row: row["method"]):
            own = list(group)
            if own[0][over] is None:
                for axes, column in ((left, "seconds"), (right, "memory_mb")):
                    axes.axhline(own[0][column], color="black", linestyle="--", label=name)
                continue
            for axes, column in ((left, "seconds"), (right, "memory_mb")):
                places = [row[over] for row in own]
                axes.plot(places, [row[column] for row in own], marker="o", label=name)
        left.set_ylabel(f"time of {ROLLOUT} steps [s]")
        right.set_ylabel("memory of a step [MB]")
        for axes in (left, right):
            axes.set_xlabel(label)
            axes.set_yscale("log")
            axes.grid(alpha=0.3, which="both")
        left.legend()
        figure.suptitle(title)

    return draw
