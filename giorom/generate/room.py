"""Refuse a data set that cannot fit, before any of it is made.

The estimate takes the first scene for all. It counts what is certain: float32 positions, once
in the parts and once in the split files, compressed as far as bodies at rest are.
"""

import math
import os
import shutil
from pathlib import Path

from giorom.data.trajectory_file import SPLITS
from giorom.generate.trajectory import SCENES_PER_SEED
from giorom.mpm import Scene, SolverConfig

COMPRESSED = 0.5
"""Share of its size that a trajectory takes on the disk, at least; measured over 60 frames: 0.52
of a clamped elastic body, 0.66 to 0.73 of thrown water, sand, goop and jelly."""

WHOLE = 1.5
"""Size in memory of a trajectory whose statistics are measured, over that of its positions."""

BYTES_PER_PARTICLE = 4 * (2 * 3 + 3 * 9 + 3)
"""Memory of the solver for one particle in three dimensions, float32: position and velocity;
affine velocity, stress and strain; volume, mass and volume correction."""


def require_room(
    scene: Scene, solver: SolverConfig, *, folder: Path, trajectories: int, missing: int, jobs: int
) -> None:
    """Refuse a data set larger than the free disk, or runs larger than the free memory.

    Args:
        scene: The first scene.
        solver: Grid and frames.
        folder: Where the data set is to be.
        trajectories: How many it shall hold.
        missing: How many of them are not there yet.
        jobs: Runs at a time.

    Raises:
        ValueError: Says how much is needed and how much there is.
    """
    if trajectories > SCENES_PER_SEED:
        raise ValueError(
            f"a data set holds at most {SCENES_PER_SEED} trajectories, got {trajectories}. Make "
            f"several of different --seed."
        )
    points, dimension = scene.position.shape
    trajectory = solver.frames * points * dimension * 4
    what = f"{solver.frames} frames of {points} particles"
    splits = sum(_size(folder / f"{name}.h5") for name in SPLITS)
    needed = COMPRESSED * trajectory * (missing + trajectories) - splits
    free = shutil.disk_usage(next(place for place in (folder, *folder.parents) if place.exists()))
    if needed > free.free:
        raise ValueError(
            f"{trajectories} trajectories of {what} take about {_text(needed)} on the disk, but "
            f"{_text(free.free)} are free at {folder}. Ask for fewer trajectories or frames, or "
            f"for a larger SceneConfig.spacing, or free some space."
        )
    grid = solver.grid_cells**dimension * (dimension + 1) * 4
    memory = min(jobs, missing) * (grid + points * BYTES_PER_PARTICLE) + WHOLE * trajectory
    present = free_memory()
    if present is not None and memory > present:
        raise ValueError(
            f"{min(jobs, missing)} runs at a time on a grid of {solver.grid_cells} cells per axis, "
            f"and the statistics of {what}, take about {_text(memory)} of memory, but "
            f"{_text(present)} are free. Use fewer --jobs, fewer frames, or a larger "
            f"SceneConfig.spacing."
        )


def free_memory() -> int | None:
    """Memory that can be had without swapping [bytes]; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        known = dict(line.split(":", 1) for line in lines)
        return int(known["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None


def _size(path: Path) -> int:
    return os.path.getsize(path) if path.is_file() else 0


def _text(size: int | float) -> str:
    """A size in a unit that suits it."""
    power = min(int(math.log2(max(size, 1.0)) // 10), 4)
    return f"{size / 1024**power:.3g} {('bytes', 'KiB', 'MiB', 'GiB', 'TiB')[power]}"
