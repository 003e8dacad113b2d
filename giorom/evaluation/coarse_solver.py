"""The package's own solver on coarser grids: the cheaper run a user would choose instead.

The material points of a coarse run are the samples, each with the volume and mass of the particles
it stands for; the walls stay where the fine grid has them. What the samples do is compared with the
same material points of the fine run, and carried to all particles by the field of the model it is
compared with.

The step is the largest stable one, found on a scene that is not scored: beginning with the fewest
substeps that the time-step rules allow, it is made longer while no guard is broken and the error
against the fine run stays within a tenth of that of the rules' step (or of the noise floor, if that
is larger). The rules keep a margin of about two, so that they alone would make the solver slower
than it has to be.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.stopwatch import synchronize
from giorom.mpm import Scene, SimulationError, SolverConfig
from giorom.mpm.similar import Similar, on_cells
from giorom.mpm.simulate import Run, chosen_substeps
from giorom.pipeline import Decode
from giorom.state import Trajectory

LONGER_STEPS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
"""Steps that are tried, over that of the rules."""

SHORTER_STEPS = (2, 4)
"""Multiples of the rules' substeps where these break a guard."""

TOLERANCE = 1.1
"""Largest error of a longer step, over that of the rules' step."""


@dataclass(frozen=True, kw_only=True)
class SolverRun:
    """What a run of the solver did, on its own material points."""

    position: Float[Tensor, "t q d"]
    """Positions at every frame, the first included [m]; after a broken guard the last repeats."""

    seconds: list[float]
    """Wall time of each frame after the first [s]."""

    diverged_at: int | None
    """Frame that broke a guard, if any."""

    grid_cells: int
    """Cells per axis of its grid."""

    cell: float
    """Width of a cell [m]."""

    substeps: int
    """Substeps of a frame."""


def seeded_at(scene: Scene, samples: Int[Tensor, " q"]) -> Scene:
    """A scene whose particles are some of the particles, with the volumes of all.

    Every particle gives its volume to the nearest sample of its own material, held ones to held
    ones; where a material has no sample, to the nearest of all.

    Args:
        scene: The scene.
        samples: Which particles remain.
    """
    position = scene.position.double().numpy()
    chosen = position[samples.numpy()]
    kind = 2 * scene.material_index + scene.kinematic.long()
    owner = torch.from_numpy(cKDTree(chosen).query(position)[1])
    for each in kind[samples].unique():
        own, members = kind == each, (kind[samples] == each).nonzero()[:, 0]
        nearest = cKDTree(chosen[members.numpy()]).query(position[own.numpy()])[1]
        owner[own] = members[torch.from_numpy(nearest)]
    volume = torch.zeros(len(samples), dtype=torch.float64)
    volume.index_add_(0, owner, scene.volume.double())
    return replace(
        scene,
        position=scene.position[samples],
        velocity=scene.velocity[samples],
        affine_velocity=scene.affine_velocity[samples],
        volume=volume.to(scene.volume.dtype),
        particle_type=scene.particle_type[samples],
        material_index=scene.material_index[samples],
    )


def run_coarse(
    scene: Scene,
    solver: SolverConfig,
    *,
    samples: Int[Tensor, " q"] | None = None,
    coarsening: float = 1.0,
    substeps: int | None = None,
    device: str = "cpu",
) -> SolverRun:
    """Simulate a scene with fewer material points on larger cells, and time every frame.

    Args:
        scene: The full-order scene.
        solver: The full-order solver.
        samples: Which particles are its material points; by default all.
        coarsening: Cells of the full-order grid along one cell.
        substeps: Substeps of a frame; by default the fewest that the time-step rules allow. More
            are taken as they are, fewer too.
        device: ``cpu`` or ``cuda``.
    """
    similar = _on_grid(scene, solver, samples=samples, coarsening=coarsening)
    own = replace(solver, grid_cells=similar.grid_cells, substeps=substeps)
    run = Run(similar.scene, own, device=device, obey_rules=False)
    positions, seconds, diverged_at = [], [], None
    frames = run.frames()
    positions.append(similar.metres(next(frames).double()))
    try:
        for taken, position in timed(frames):
            seconds.append(taken)
            positions.append(similar.metres(position.double()))
    except SimulationError:
        diverged_at = len(positions)
    positions += [positions[-1]] * (solver.frames - len(positions))
    return SolverRun(
        position=torch.stack(positions).float(),
        seconds=seconds,
        diverged_at=diverged_at,
        grid_cells=similar.grid_cells,
        cell=coarsening / solver.grid_cells,
        substeps=run.substeps,
    )


def timed(frames: Iterator[Any]) -> Iterator[tuple[float, Any]]:
    """Each item with the wall time it took to make [s]; the clock of every speed here."""
    while True:
        start = time.perf_counter()
        try:
            item = next(frames)
            synchronize()
        except StopIteration:
            return
        yield time.perf_counter() - start, item


def largest_stable_substeps(
    scene: Scene,
    solver: SolverConfig,
    truth: Trajectory,
    *,
    samples: Int[Tensor, " q"] | None = None,
    coarsening: float = 1.0,
    floor: float = 0.0,
    device: str = "cpu",
) -> int | None:
    """Fewest substeps of a frame with which a coarse run is stable; see the module.

    Args:
        scene: A scene that is not scored.
        solver: The full-order solver.
        truth: Its full-order motion.
        samples: Which particles are material points of the coarse run; by default all.
        coarsening: Cells of the full-order grid along one cell.
        floor: Error that says nothing, because a small change of the fine run makes as much [m^2].
        device: ``cpu`` or ``cuda``.

    Returns:
        None if guards are broken with more substeps than the rules ask for, too.
    """
    rules = rules_substeps(scene, solver, samples=samples, coarsening=coarsening)

    def error(substeps: int) -> float:
        options = {"samples": samples, "coarsening": coarsening, "device": device}
        run = run_coarse(scene, solver, substeps=substeps, **options)
        return math.inf if run.diverged_at is not None else sparse_error(run, truth, samples)

    allowed = error(rules)
    if not math.isfinite(allowed):
        shorter = (factor * rules for factor in SHORTER_STEPS)
        return next((count for count in shorter if math.isfinite(error(count))), None)
    best = rules
    for count in sorted({math.ceil(rules / factor) for factor in LONGER_STEPS}, reverse=True)[1:]:
        if not error(count) <= TOLERANCE * max(allowed, floor):
            break
        best = count
    return best


def rules_substeps(
    scene: Scene,
    solver: SolverConfig,
    *,
    samples: Int[Tensor, " q"] | None = None,
    coarsening: float = 1.0,
) -> int:
    """Fewest substeps of a frame that the time-step rules allow a coarse run."""
    similar = _on_grid(scene, solver, samples=samples, coarsening=coarsening)
    return chosen_substeps(
        similar.scene, replace(solver, grid_cells=similar.grid_cells, substeps=None)
    )


def _on_grid(
    scene: Scene, solver: SolverConfig, *, samples: Int[Tensor, " q"] | None, coarsening: float
) -> Similar:
    """The material points of a run on its grid; the full-order grid itself without coarsening."""
    points = scene if samples is None else seeded_at(scene, samples)
    if coarsening != 1.0:
        return on_cells(points, grid_cells=solver.grid_cells, coarsening=coarsening)
    corner = torch.zeros(scene.position.shape[1], dtype=torch.float64)
    return Similar(scene=points, grid_cells=solver.grid_cells, factor=1.0, origin=corner)


def sparse_error(run: SolverRun, truth: Trajectory, samples: Int[Tensor, " q"] | None) -> float:
    """Mean squared distance of the material points from those of the fine run, all frames [m^2]."""
    true = truth.position if samples is None else truth.position[:, samples]
    return float(squared_error_per_frame(run.position, true).mean())


def score_coarse(
    run: SolverRun,
    truth: Trajectory,
    *,
    samples: Int[Tensor, " q"] | None = None,
    decode: Decode | None = None,
) -> dict[str, Any]:
    """Errors and time of a coarse run.

    Args:
        run: The run.
        truth: The full-order motion.
        samples: Which particles are its material points; by default all.
        decode: Carries the samples to all particles; needed with ``samples``.

    Returns:
        ``sparse_rollout_mse`` and ``full_rollout_mse`` [m^2], means over all frames, the first
        included; medians over frames of ``solver_seconds`` and ``upscale_seconds`` and their sum
        ``seconds_per_frame``; ``points``, ``grid_cells``, ``substeps``, ``diverged_at``.
    """
    upscale, full = 0.0, run.position
    if samples is not None:
        decoded = list(timed(map(_required(decode), run.position[1:])))
        upscale = _median_after_first([seconds for seconds, _ in decoded])
        full = torch.stack([truth.position[0], *(position for _, position in decoded)])
        full = torch.where(truth.kinematic[:, None], truth.position, full)
    solver_seconds = _median_after_first(run.seconds)
    return {
        "points": run.position.shape[1],
        "grid_cells": run.grid_cells,
        "cell": run.cell,
        "substeps": run.substeps,
        "sparse_rollout_mse": sparse_error(run, truth, samples),
        "full_rollout_mse": float(squared_error_per_frame(full, truth.position).mean()),
        "solver_seconds": solver_seconds,
        "upscale_seconds": upscale,
        "seconds_per_frame": solver_seconds + upscale,
        "diverged_at": run.diverged_at,
    }


def _median_after_first(seconds: list[float]) -> float:
    """Median time of a frame; the first, which records kernels and allocates, is a warm-up."""
    return median(seconds[1:] or seconds or [math.nan])


def _required(decode: Decode | None) -> Callable[[Tensor], Tensor]:
    if decode is None:
        raise ValueError("score_coarse needs decode, which carries the samples to all particles.")
    return decode
