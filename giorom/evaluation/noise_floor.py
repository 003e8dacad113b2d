"""How far the solver is from repeating its own motion: no surrogate can be asked for less.

The same scene is simulated again with another velocity of every particle (independent, normal
noise), with twice the substeps, on a finer grid, or with its particles seeded elsewhere in the same
body. The errors are those of a rollout: mean squared difference of the displacements of the same
particles, at a frame and as mean of all frames so far.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.evaluation.comparison import REPORT_FRAMES
from giorom.evaluation.machine import describe_machine
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.mpm import Scene, SceneConfig, SimulationError, SolverConfig, draw_scene, simulate
from giorom.mpm.simulate import chosen_substeps
from giorom.state import Trajectory

SPEEDS = (1e-3, 1e-2)
"""Standard deviations of each component of the added velocity [m/s]."""

FINER = 1.25
"""Grid cells per axis of the finer grid, over those of the preset."""

JITTER = 0.25
"""Farthest that a particle is seeded from its place on each axis [spacings]."""

Change = Callable[[Scene, SolverConfig, int], tuple[Scene, SolverConfig]]
"""Another run of a scene: what changes, from the scene, the solver and a seed."""


def measure_noise_floor(
    scene: SceneConfig,
    solver: SolverConfig,
    *,
    seeds: list[int],
    frames: int,
    device: str = "cpu",
    report: Callable[[int, int], None] = lambda _, __: None,
) -> dict[str, Any]:
    """Simulate scenes of a family again with small changes.

    Args:
        scene: The family.
        solver: Its solver; the number of frames is replaced.
        seeds: Seed of each scene.
        frames: Frames after the first.
        device: ``cpu`` or ``cuda``.
        report: Called with runs done and wanted.
    """
    start = time.perf_counter()
    solver = replace(solver, frames=frames + 1)
    errors: dict[str, list[torch.Tensor]] = {name: [] for name in changes()}
    failed: list[str] = []
    wanted = len(seeds) * (1 + len(errors))
    for index, seed in enumerate(seeds):
        drawn = draw_scene(scene, seed=seed)
        truth = simulate(drawn, solver, device=device)
        report(index * (1 + len(errors)) + 1, wanted)
        for number, (name, change) in enumerate(changes().items()):
            try:
                found = deviation(change, drawn, solver, truth, seed=index, device=device)
                errors[name].append(found)
            except SimulationError as error:
                failed.append(f"scene {index}, {name}: {error}")
            report(index * (1 + len(errors)) + number + 2, wanted)
    return {
        "trajectories": len(seeds),
        "frames": frames,
        "rows": [_row(name, found) for name, found in errors.items() if found],
        "failed": failed,
        "seconds": time.perf_counter() - start,
        "machine": describe_machine(),
    }


def changes() -> dict[str, Change]:
    """What is changed, by name."""
    shaken: dict[str, Change] = {f"velocity + {speed:g} m/s": _shake_by(speed) for speed in SPEEDS}
    return shaken | {"substeps x 2": _halve_substeps, f"grid cells x {FINER:g}": _refine}


def deviation(
    change: Change,
    scene: Scene,
    solver: SolverConfig,
    truth: Trajectory,
    *,
    seed: int,
    device: str = "cpu",
) -> Float[Tensor, " t"]:
    """Mean squared difference of the displacements of a changed run, for each frame [m^2].

    Args:
        change: What is changed.
        scene: The scene.
        solver: The solver.
        truth: Its motion without the change.
        seed: Seed of the change.
        device: ``cpu`` or ``cuda``.

    Raises:
        SimulationError: If the changed run breaks a guard.
    """
    changed_scene, changed_solver = change(scene, solver, seed)
    again = simulate(changed_scene, changed_solver, device=device).position
    moved = truth.position + (again[0] - truth.position[0])
    return squared_error_per_frame(again, moved)


def seed_elsewhere(scene: Scene, solver: SolverConfig, seed: int) -> tuple[Scene, SolverConfig]:
    """A change that moves each free particle within the cell it fills, its velocity with it."""
    generator = torch.Generator().manual_seed(seed)
    reach = JITTER * scene.volume[:, None] ** (1.0 / scene.position.shape[1])
    offset = reach * (2.0 * torch.rand(scene.position.shape, generator=generator) - 1.0)
    low, high = (side.clone() for side in scene.bounds.to(scene.position).unbind(dim=1))
    if scene.clamp_plane is not None:
        low[1] = max(float(low[1]), scene.clamp_plane)
    position = torch.clamp(scene.position + offset, low, high)
    position = torch.where(scene.kinematic[:, None], scene.position, position)
    turned = torch.einsum("pij,pj->pi", scene.affine_velocity, position - scene.position)
    return replace(scene, position=position, velocity=scene.velocity + turned), solver


def _shake_by(speed: float) -> Change:
    def shake(scene: Scene, solver: SolverConfig, seed: int) -> tuple[Scene, SolverConfig]:
        generator = torch.Generator().manual_seed(seed)
        noise = speed * torch.randn(scene.velocity.shape, generator=generator)
        noise[scene.kinematic] = 0.0
        return replace(scene, velocity=scene.velocity + noise), solver

    return shake


def _halve_substeps(scene: Scene, solver: SolverConfig, _: int) -> tuple[Scene, SolverConfig]:
    return scene, replace(solver, substeps=2 * chosen_substeps(scene, solver))


def _refine(scene: Scene, solver: SolverConfig, _: int) -> tuple[Scene, SolverConfig]:
    cells = round(FINER * solver.grid_cells)
    return scene, replace(solver, grid_cells=cells, substeps=None)


def _row(name: str, errors: list[torch.Tensor]) -> dict[str, Any]:
    """Means and largest values over scenes, at the frames of the report and until then."""
    table = torch.stack(errors)
    until = table.cumsum(dim=1) / torch.arange(1, table.shape[1] + 1)
    frames = [frame for frame in REPORT_FRAMES if frame < table.shape[1]]
    return {
        "change": name,
        "scenes": len(errors),
        "mse_at": {str(f): float(table[:, f].mean()) for f in frames},
        "mse_at_largest": {str(f): float(table[:, f].max()) for f in frames},
        "mse_until": {str(f): float(until[:, f].mean()) for f in frames},
        "mse_until_largest": {str(f): float(until[:, f].max()) for f in frames},
    }
