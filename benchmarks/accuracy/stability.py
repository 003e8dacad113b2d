"""Do rollouts last? Many random scenes, rolled out for several training horizons.

A rollout is lost when a position is not finite or a sample lies beyond a wall by more than the
solver itself may press a particle beyond one (0.6 of its grid cells). Each scene starts from the
frames of the solver that the model is given; only samples are rolled out.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

from giorom.evaluation.endurance import Fate, endure
from giorom.evaluation.machine import describe_machine
from giorom.generate import SCENES_PER_SEED
from giorom.mpm import draw_scene, simulate
from giorom.mpm.boundary import WALL_TOLERANCE
from giorom.pipeline import start_from_trajectory
from giorom.simulator import Simulator
from giorom.state import SparseState, concatenate_states

SEED = 2000
"""Seed of the scenes: neither that of training data nor that of the held-out sets."""

SCENES = 50
HORIZONS = 5.0
BATCH = 10
"""Scenes that are rolled out side by side."""

Report = Callable[[int, int], None]


def measure_stability(
    simulator: Simulator,
    *,
    scenes: int = SCENES,
    horizons: float = HORIZONS,
    batch: int = BATCH,
    seed: int = SEED,
    report: Report = lambda _, __: None,
) -> dict[str, Any]:
    """Roll random scenes of a model's family out and count those that are lost.

    Args:
        simulator: The model.
        scenes: How many.
        horizons: Length of a rollout, in training trajectories.
        batch: Scenes side by side.
        seed: Scene i is drawn with ``seed * SCENES_PER_SEED + i``.
        report: Called with scenes done and wanted.
    """
    config = simulator.config
    frames = round(horizons * config.solver.frames)
    tolerance = WALL_TOLERANCE / config.solver.grid_cells
    fates: list[Fate] = []
    start = time.perf_counter()
    for first in range(0, scenes, batch):
        chosen = range(first, min(first + batch, scenes))
        states = list(_starts(simulator, [seed * SCENES_PER_SEED + scene for scene in chosen]))
        device = next(simulator.parameters()).device
        found = endure(
            concatenate_states(states).to(device),
            frames,
            connect=simulator.connect,
            step=simulator.dynamics.step,
            tolerance=tolerance,
        )
        fates += [replace(fate, scene=first + fate.scene) for fate in found]
        report(len(fates), scenes)
    lost = [fate for fate in fates if fate.lost_at is not None]
    return {
        "scenes": scenes,
        "frames": frames,
        "horizons": horizons,
        "tolerance": tolerance,
        "lost": len(lost),
        "not_finite": sum(fate.reason == "not finite" for fate in lost),
        "beyond_walls": sum(fate.reason == "beyond a wall" for fate in lost),
        "first_loss": min((fate.lost_at for fate in lost), default=None),
        "largest_excursion": max(fate.excursion for fate in fates),
        "losses": [asdict(fate) for fate in lost],
        "seed": seed,
        "seconds": time.perf_counter() - start,
        "machine": describe_machine(),
    }


def _starts(simulator: Simulator, seeds: list[int]) -> Iterator[SparseState]:
    """The first frames of the solver for each scene, on the samples."""
    history = simulator.config.features.history
    solver = replace(simulator.config.solver, frames=history)
    for seed in seeds:
        # What a body melts to later is not seen in the first frames.
        scene = replace(draw_scene(simulator.config.scene, seed=seed), switch=None)
        truth = simulate(scene, solver)
        samples = simulator.sample(truth.position[0])
        yield start_from_trajectory(truth, samples, history=history)
