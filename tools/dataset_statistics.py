"""Generate the 2-D data sets and set their statistics beside the published ones.

    python tools/dataset_statistics.py --trajectories 100 --jobs 2 --out docs/results/datasets.md

Every trajectory of a preset is drawn and simulated in memory, nothing is stored. The published
numbers are those of ``giorom.data.published``; an ``x 1.07`` says generated over published.
"""

import argparse
import functools
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from giorom.config import load_experiment
from giorom.data.published import PublishedDataset, published_for
from giorom.data.statistics import Statistics, measure_statistics
from giorom.mpm import SimulationError, draw_scene, simulate
from giorom.state import Trajectory

PRESETS = ("water2d", "sand2d", "goop2d", "multimaterial2d")
SCENES_PER_SEED = 1_000_000
ROWS = (
    ("velocity_mean", 1, "mean velocity, up"),
    ("velocity_std", 0, "spread of velocity, across"),
    ("velocity_std", 1, "spread of velocity, up"),
    ("acceleration_std", 0, "spread of acceleration, across"),
    ("acceleration_std", 1, "spread of acceleration, up"),
)


@dataclass(frozen=True, kw_only=True)
class Generated:
    """What a preset gave."""

    preset: str
    statistics: Statistics
    counts: list[int]
    frames: int
    frame_dt: float
    bounds: Tensor
    failed: int
    seconds: float


def main() -> int:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--out", type=Path, help="Markdown file; the screen by default")
    arguments = parser.parse_args()
    sets = [generated(name, arguments) for name in arguments.presets]
    text = page(sets, arguments)
    if arguments.out is None:
        sys.stdout.write(text)
    else:
        arguments.out.write_text(text, encoding="utf-8")
    return 0


def trajectory(seed: int, *, preset: str) -> tuple[Trajectory | None, float]:
    """One trajectory and its CPU seconds; none where a guard of the solver stopped it."""
    torch.set_num_threads(1)
    experiment = load_experiment(preset)
    start = time.process_time()
    try:
        made = simulate(draw_scene(experiment.scene, seed=seed), experiment.solver)
    except SimulationError:
        made = None
    return made, time.process_time() - start


def generated(preset: str, arguments: argparse.Namespace) -> Generated:
    """Statistics of a generated set, measured as its trajectories arrive."""
    counts: list[int] = []
    seconds: list[float] = []
    last: list[Trajectory] = []

    def arriving() -> Iterator[Trajectory]:
        context = multiprocessing.get_context("spawn")
        first = arguments.seed * SCENES_PER_SEED
        make = functools.partial(trajectory, preset=preset)
        with ProcessPoolExecutor(max_workers=arguments.jobs, mp_context=context) as pool:
            for made, spent in pool.map(make, range(first, first + arguments.trajectories)):
                seconds.append(spent)
                if made is None:
                    continue
                counts.append(made.position.shape[1])
                last[:] = [made]
                yield made

    statistics = measure_statistics(arriving())
    (example,) = last
    return Generated(
        preset=preset,
        statistics=statistics,
        counts=counts,
        frames=example.frame_count,
        frame_dt=example.frame_dt,
        bounds=example.bounds,
        failed=len(seconds) - len(counts),
        seconds=sum(seconds) / len(seconds),
    )


def page(sets: list[Generated], arguments: argparse.Namespace) -> str:
    """The whole page as Markdown."""
    command = f"python tools/dataset_statistics.py --trajectories {arguments.trajectories}"
    versions = ", ".join(f"{name} {version(name)}" for name in ("giorom", "warp-lang", "torch"))
    lines = [
        "# The generated 2-D data sets beside the published ones",
        "",
        "Made by:",
        "",
        f"    {command} --seed {arguments.seed} --jobs {arguments.jobs} --out "
        f"docs/results/datasets.md",
        "",
        f"Seed {arguments.seed}, {arguments.trajectories} trajectories of each preset, {versions}, "
        f"Python {platform.python_version()}, {platform.machine()}. Velocities and accelerations "
        "are per frame, over all free particles and frames; axis 1 points up. The published data "
        "themselves were not at hand: their numbers are those that somebody printed, see "
        "`giorom/data/published.py`. Free to choose were the sizes, the places, the speeds, the "
        "stiffness and the grid; that the spreads agree says that bodies fall, hit and come to "
        "rest about as fast, not that one set could replace the other.",
    ]
    for made in sets:
        lines += ["", *section(made)]
    return "\n".join(lines) + "\n"


def section(made: Generated) -> list[str]:
    """One preset: sizes, then the statistics."""
    rows = published_for(load_experiment(made.preset).system)
    walls = ", ".join(f"[{low:.4g}, {high:.4g}]" for low, high in made.bounds.tolist())
    mean = sum(made.counts) / len(made.counts)
    lines = [
        f"## {made.preset}",
        "",
        f"{made.seconds:.1f} CPU seconds a trajectory; {made.failed} of "
        f"{len(made.counts) + made.failed} stopped by a guard of the solver.",
        "",
        "| | generated | " + " | ".join(row.name for row in rows) + " |",
        "|---|---|" + "---|" * len(rows),
        line(
            "particles", f"{min(made.counts)} to {max(made.counts)}, mean {mean:.0f}", rows, known
        ),
        line("frames", f"{made.frames}", rows, lambda row: f"{row.frames} (+ 1)"),
        line(
            "time between frames [s]", f"{made.frame_dt:g}", rows, lambda row: f"{row.frame_dt:g}"
        ),
        line("walls [m]", walls, rows, walls_of),
    ]
    for name, axis, text in ROWS:
        value = float(getattr(made.statistics, name)[axis])
        lines.append(
            line(text, f"{value:.3e}", rows, functools.partial(printed, name, axis, value))
        )
    return lines


def line(text: str, value: str, rows: list[PublishedDataset], entry: Callable) -> str:
    """One row of a table."""
    return f"| {text} | {value} | " + " | ".join(entry(row) for row in rows) + " |"


def known(row: PublishedDataset) -> str:
    """Particle numbers of a published set."""
    each = ", ".join(str(count) for count in row.particle_counts)
    return f"up to {row.most_particles}" + (f"; {each}" if each else "")


def walls_of(row: PublishedDataset) -> str:
    """Walls of a published set."""
    if row.bounds is None:
        return "not printed"
    return ", ".join(f"[{low:g}, {high:g}]" for low, high in row.bounds)


def printed(name: str, axis: int, value: float, row: PublishedDataset) -> str:
    """A published statistic and how the generated value compares."""
    if row.statistics is None:
        return "not printed"
    published = float(getattr(row.statistics, name)[axis])
    return f"{published:.3e} (x {value / published:.2f})"


if __name__ == "__main__":
    sys.exit(main())
