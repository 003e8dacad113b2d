"""How far the solver is from repeating its own motion on the scenes of a model or preset."""

from collections.abc import Callable
from typing import Any

from giorom.evaluation.noise_floor import measure_noise_floor as measure
from giorom.generate import SCENES_PER_SEED
from giorom.mpm import SceneConfig, SolverConfig

SEED = 3000
"""Seed of the scenes: neither that of training data nor that of the held-out sets."""

TRAJECTORIES = 4
FRAMES = 400
"""Frames after the first, whatever the preset has."""


def measure_noise_floor(
    scene: SceneConfig,
    solver: SolverConfig,
    *,
    trajectories: int = TRAJECTORIES,
    frames: int = FRAMES,
    seed: int = SEED,
    device: str = "cpu",
    report: Callable[[int, int], None] = lambda _, __: None,
) -> dict[str, Any]:
    """Simulate scenes of a family again with small changes.

    Args:
        scene: The family.
        solver: Its solver; the number of frames is replaced.
        trajectories: How many scenes.
        frames: Frames after the first.
        seed: Scene i is drawn with ``seed * SCENES_PER_SEED + i``.
        device: ``cpu`` or ``cuda``.
        report: Called with runs done and wanted.
    """
    seeds = [seed * SCENES_PER_SEED + index for index in range(trajectories)]
    found = measure(scene, solver, seeds=seeds, frames=frames, device=device, report=report)
    return found | {"seed": seed}
