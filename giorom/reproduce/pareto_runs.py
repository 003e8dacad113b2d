"""What the chart of error against time is made of: runs of models and of the solver, timed alike.

All start from the first frames of the same test trajectories and end with the positions of every
particle: the samples of a model and the material points of a coarse solver run are carried to the
others by one field, that of our default. One clock (``coarse_solver.timed``) takes every frame
whole, graph, network, integration and recovery of the particles, on one thread or on the GPU.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import fmean, median
from typing import Any

import torch
from torch import Tensor

from giorom.config import Experiment
from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.coarse_solver import (
    largest_stable_substeps,
    rules_substeps,
    run_coarse,
    score_coarse,
    timed,
)
from giorom.evaluation.comparison import surroundings_of, trivial_predictions
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.noise_floor import deviation, seed_elsewhere
from giorom.evaluation.rollout import far_outside
from giorom.fields import FieldDecoder
from giorom.mpm import Scene, SimulationError, SolverConfig, draw_scene
from giorom.pipeline import Decode, rollout, start_from_trajectory
from giorom.reproduce.study import Study
from giorom.simulator import Simulator
from giorom.state import Trajectory

TIMED_FRAMES = 30
"""Most frames of the full-order solver that are timed on each trajectory."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """A trajectory of the data set and the scene it was simulated from."""

    trajectory: Trajectory
    """Positions of all particles at every frame."""

    scene: Scene
    """The particles at the start, with their velocities and volumes."""

    solver: SolverConfig
    """The solver that moved them, with the substeps it took."""


def truths(study: Study, system: str, where: str) -> list[Truth]:
    """Trajectories of a split with their scenes, drawn again from their seeds.

    Raises:
        ValueError: If a scene drawn again does not begin as the trajectory does.
    """
    experiment = study.experiment(system)
    found = []
    for trajectory in iterate_trajectories(study.dataset(system), where):
        scene = draw_scene(experiment.scene, seed=trajectory.attributes["seed"])
        if not torch.equal(scene.position, trajectory.position[0]):
            raise ValueError(
                f"scene {trajectory.attributes['seed']} of {system}, drawn again, is another one "
                f"than the data set holds. Remove {study.shared / 'data'} and start again."
            )
        solver = _solver_of(experiment, trajectory)
        found.append(Truth(trajectory=trajectory, scene=scene, solver=solver))
    return found


def _solver_of(experiment: Experiment, trajectory: Trajectory) -> SolverConfig:
    substeps = int(trajectory.attributes["substeps"])
    return replace(experiment.solver, frames=trajectory.frame_count, substeps=substeps)


def run_model(
    simulator: Simulator,
    field: Simulator,
    trajectories: list[Trajectory],
    *,
    share: float,
) -> dict[str, Any]:
    """Error and time of a model on some trajectories.

    Args:
        simulator: Moves the samples.
        field: Carries them to all particles.
        trajectories: The truth, on the device of the models.
        share: Samples over those it was trained with.
    """
    results = []
    for trajectory in trajectories:
        position = trajectory.position[0]
        trained = simulator.config.sampling.sample_count(len(position))
        count = min(max(round(share * trained), position.shape[1] + 1), len(position))
        samples = simulator.sample(position, count=count)
        results.append(_run_one(simulator, field, trajectory, samples))
    return _summary(results)


def _run_one(
    simulator: Simulator, field: Simulator, trajectory: Trajectory, samples: Tensor
) -> dict[str, Any]:
    """One rollout; stopped where ``roll_out`` would call it diverged."""
    history = simulator.config.features.history
    frames = trajectory.frame_count - history
    decode = decoder(field, trajectory, samples)
    truth = trajectory.position[history:]

    def motion() -> Iterator[tuple[Tensor, Tensor]]:
        state = start_from_trajectory(trajectory, samples, history=history)
        steps = rollout(
            state,
            frames,
            connect=simulator.connect,
            step=simulator.dynamics.step,
            prescribed=truth[:, samples],
        )
        for later in steps:
            yield later.position, decode(later.position)

    seconds, sparse, full = [], [], []
    try:
        for taken, (position, everything) in timed(motion()):
            if bool(far_outside(position, trajectory.bounds).any()):
                break
            seconds.append(taken)
            sparse.append(position)
            full.append(everything)
    except FloatingPointError:
        pass
    diverged = len(full) < frames
    held = trajectory.kinematic[:, None]
    result: dict[str, Any] = {"points": len(samples), "seconds": seconds, "diverged": diverged}
    if diverged:
        return result
    moved = torch.where(held, truth, torch.stack(full))
    total = trajectory.frame_count
    return result | {
        "full": float(squared_error_per_frame(moved, truth).sum()) / total,
        "sparse": float(squared_error_per_frame(torch.stack(sparse), truth[:, samples]).sum())
        / total,
    }


def _carrier(field: Simulator, trajectory: Trajectory, samples: Tensor, device: str) -> Decode:
    """The field on its device, for positions that come from the solver and go to the score."""
    decode = decoder(field, trajectory.to(device), samples.to(device))
    return lambda position: decode(position.to(device)).cpu()


def decoder(field: Simulator, trajectory: Trajectory, samples: Tensor) -> FieldDecoder:
    """The field of a model bound to the particles of a trajectory."""
    return field.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)


def _summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the trajectories that did not diverge; the median time of a frame of all."""
    sound = [result for result in results if not result["diverged"]]
    frames = [second for result in results for second in result["seconds"][1:]]
    return {
        "points": round(fmean(result["points"] for result in results)),
        "full_rollout_mse": fmean(r["full"] for r in sound) if sound else None,
        "sparse_rollout_mse": fmean(r["sparse"] for r in sound) if sound else None,
        "seconds_per_frame": median(frames) if frames else None,
        "diverged": len(results) - len(sound),
        "trajectories": len(results),
    }


def run_solver(
    field: Simulator,
    tests: list[Truth],
    check: Truth,
    *,
    coarsening: float,
    points: float,
    steps: str,
    floor: float,
    device: str,
) -> dict[str, Any]:
    """Error and time of the solver on larger cells.

    Args:
        field: Carries the material points to all particles.
        tests: Scored.
        check: Not scored; the largest stable step is found on it.
        coarsening: Cells of the full-order grid along one cell.
        points: Share of the particles that are material points; one: all.
        steps: ``rules``: the longest steps that the rules allow; ``largest``: that are stable.
        floor: Noise floor [m^2].
        device: ``cpu`` or ``cuda``.
    """
    options: dict[str, Any] = {"coarsening": coarsening}
    factor = 1.0
    if steps == "largest":
        plain = replace(check.solver, substeps=None)
        samples = _material_points(field, check, points)
        count = largest_stable_substeps(
            check.scene,
            plain,
            check.trajectory,
            samples=samples,
            floor=floor,
            device=device,
            **options,
        )
        if count is None:
            return {"full_rollout_mse": None, "seconds_per_frame": None, "problem": "unstable"}
        factor = count / rules_substeps(check.scene, plain, samples=samples, **options)
    rows = []
    for test in tests:
        samples = _material_points(field, test, points)
        plain = replace(test.solver, substeps=None)
        rules = rules_substeps(test.scene, plain, samples=samples, **options)
        substeps = max(1, math.ceil(factor * rules - 1e-9))
        run = run_coarse(
            test.scene, plain, samples=samples, substeps=substeps, device=device, **options
        )
        decode = None if samples is None else _carrier(field, test.trajectory, samples, device)
        rows.append(score_coarse(run, test.trajectory, samples=samples, decode=decode))
    sound = [row for row in rows if row["diverged_at"] is None]
    return {
        "points": round(fmean(row["points"] for row in rows)),
        "grid_cells": rows[0]["grid_cells"],
        "cell": rows[0]["cell"],
        "substeps": median([row["substeps"] for row in rows]),
        "full_rollout_mse": fmean(r["full_rollout_mse"] for r in sound) if sound else None,
        "sparse_rollout_mse": fmean(r["sparse_rollout_mse"] for r in sound) if sound else None,
        "seconds_per_frame": median([row["seconds_per_frame"] for row in rows]),
        "upscale_seconds": median([row["upscale_seconds"] for row in rows]),
        "diverged": len(rows) - len(sound),
        "trajectories": len(rows),
    }


def _material_points(field: Simulator, truth: Truth, points: float) -> Tensor | None:
    """Farthest point samples of a share of the particles; none where all are meant."""
    if points >= 1.0:
        return None
    least = truth.trajectory.position.shape[2] + 1
    count = max(least, round(points * len(truth.scene.position)))
    return field.sample(truth.scene.position, count=count)


def full_order_seconds(tests: list[Truth], *, device: str) -> float:
    """Median time of a frame of the full-order solver [s]."""
    seconds: list[float] = []
    for test in tests:
        solver = replace(test.solver, frames=min(test.solver.frames, TIMED_FRAMES + 1))
        scene = replace(test.scene, switch=None)
        run = run_coarse(scene, solver, substeps=solver.substeps, device=device)
        seconds += run.seconds[1:]
    return median(seconds)


def noise_floor(tests: list[Truth], *, device: str) -> float | None:
    """Error of the full-order solver against itself, its particles seeded elsewhere [m^2].

    Mean over all frames and the trajectories that broke no guard; none if all did.
    """
    found = []
    for number, test in enumerate(tests):
        change = {"seed": number, "device": device}
        try:
            errors = deviation(seed_elsewhere, test.scene, test.solver, test.trajectory, **change)
        except (SimulationError, ValueError):
            continue
        found.append(float(errors.mean()))
    return fmean(found) if found else None


def without_model(tests: list[Truth], *, history: int) -> dict[str, float]:
    """Errors on all particles of what is predicted without a model [m^2], by name."""
    sums: dict[str, list[float]] = {}
    for test in tests:
        trajectory = test.trajectory
        around = surroundings_of(trajectory)
        everything = torch.arange(trajectory.position.shape[1])
        state = start_from_trajectory(trajectory, everything, history=history)
        truth = trajectory.position[history:]
        found = trivial_predictions(state, truth, gravity=around.gravity, body=around.body)
        for name in ("static", "constant_velocity", "free_fall"):
            error = squared_error_per_frame(found[name], truth).sum() / trajectory.frame_count
            sums.setdefault(name, []).append(float(error))
    return {name: fmean(values) for name, values in sums.items()}
