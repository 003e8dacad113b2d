"""One model at other numbers of samples and on shapes it never saw (Table 2 of the paper)."""

import math
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from giorom.evaluation.discretisation import at_density, evaluate_at_density
from giorom.evaluation.machine import describe_machine
from giorom.generate.held_out import held_out_trajectories, make_held_out
from giorom.simulator import Simulator
from giorom.state import Trajectory

FACTORS = (1.0, 0.25, 0.5, 1.25, 2.0, 4.0)
"""Numbers of samples over the trained one; the first is what the others are compared with."""

SEED = 1
"""Number of the held-out sets; the scores of a model use 0."""

TRAJECTORIES = 10

KEPT = {"sparse": ("one_step_mse", "rollout_mse"), "full": ("one_step_mse", "rollout_mse")}


def measure_discretisation(
    simulator: Simulator,
    *,
    trajectories: int = TRAJECTORIES,
    frames: int | None = None,
    factors: tuple[float, ...] = FACTORS,
    seed: int = SEED,
    jobs: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Score a model with other numbers of samples, then on the shapes kept from training.

    Args:
        simulator: The model.
        trajectories: Scenes of each row, at least.
        frames: Frames of a rollout; by default those of the training trajectories.
        factors: Numbers of samples over the trained one; the first must be one.
        seed: Number of the held-out sets.
        jobs: Processes that make them.
        report: Called with a line before each row.
    """
    if factors[0] != 1.0:
        raise ValueError(f"the first factor is the reference and must be 1, got {factors[0]:g}.")
    start = time.perf_counter()
    config = simulator.config
    rows = []
    with tempfile.TemporaryDirectory(prefix="giorom-discretisation-") as temporary:
        common = {"frames": frames, "seed": seed, "jobs": jobs}
        folder = Path(temporary) / "same"
        make_held_out(config, folder=folder, trajectories=trajectories, **common)
        for factor in factors:
            report(f"{factor:g} x the samples")
            found = _scored(simulator, held_out_trajectories(folder), factor, frames=frames)
            rows.append(_row(f"{factor:g} x", found) | {"factor": factor})
        shapes = config.scene.held_out_shapes
        for shape in shapes:
            report(f"shape {shape}")
            folder = Path(temporary) / shape
            each = -(-trajectories // len(shapes))
            make_held_out(config, folder=folder, trajectories=each, shape=shape, **common)
            found = _scored(simulator, held_out_trajectories(folder), 1.0, frames=frames)
            rows.append(_row(f"shape {shape}", found) | {"factor": 1.0, "shape": shape})
    for row in rows:
        row["ratio"] = _ratio(row, rows[0])
    return {
        "trajectories": trajectories,
        "seed": seed,
        "rows": rows,
        "seconds": time.perf_counter() - start,
        "machine": describe_machine(),
    }


def _scored(
    simulator: Simulator, trajectories: Iterable[Trajectory], factor: float, *, frames: int | None
) -> list[dict[str, Any]]:
    """Scores of every trajectory at another number of samples."""
    simulator = at_density(simulator, factor)
    return [evaluate_at_density(simulator, t, factor, frames=frames) for t in trajectories]


def _row(setting: str, results: list[dict[str, Any]]) -> dict[str, Any]:
    """Means and spreads of a setting; diverged rollouts are counted and left out of them.

    A mean over a step that is not finite is none.
    """
    sound = [result for result in results if result["diverged_at"] is None]
    row: dict[str, Any] = {
        "setting": setting,
        "trajectories": len(results),
        "diverged": len(results) - len(sound),
        "frames": min(result["frames"] for result in results),
        "points": round(fmean(result["points"] for result in results)),
        "sparse_points": round(fmean(result["sparse_points"] for result in results)),
        "radius": results[0]["radius"],
    }
    for where, keys in KEPT.items():
        for key in keys:
            values = [result[where][key] for result in sound]
            known = all(math.isfinite(value) for value in values)
            row[f"{where}_{key}"] = fmean(values) if values and known else None
            row[f"{where}_{key}_std"] = stdev(values) if len(values) > 1 and known else None
    static = [result["full"]["static_mse"] for result in results]
    return row | {"full_static_mse": fmean(static)}


def _ratio(row: dict[str, Any], reference: dict[str, Any]) -> float | None:
    """Rollout error on all particles over that of the reference; none if a rollout diverged."""
    one, other = reference["full_rollout_mse"], row["full_rollout_mse"]
    if row["diverged"] or reference["diverged"] or not one:
        return None
    return other / one
