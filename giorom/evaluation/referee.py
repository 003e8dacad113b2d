"""One scene, simulated twice: by the surrogate and by the material point method.

The material point method is the referee: same body, same initial velocity, same frames. Both are
timed, stage by stage, and their motions compared on all points.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from giorom.evaluation.comparison import Comparison, surroundings_of, trivial_predictions
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.stopwatch import Stopwatch, synchronize
from giorom.mpm import Scene, SceneConfig, simulate
from giorom.pipeline import rollout, start_from_velocity
from giorom.simulator import Simulator, check_frames
from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Surrogate and referee on one scene."""

    predicted: Trajectory
    """Motion of all points by the surrogate."""

    truth: Trajectory
    """Motion of all points by the material point method."""

    scores: dict[str, Any]
    """The keys of ``giorom demo --json``."""


def judge(
    simulator: Simulator, scene: Scene, *, frames: int, sparse_points: int | None = None
) -> Verdict:
    """Simulate ``scene`` with both and compare.

    Args:
        simulator: The surrogate.
        scene: Body and initial velocity.
        frames: Frames after the initial one.
        sparse_points: Number of samples; by default the trained reduction.
    """
    check_frames(frames, scene.position)
    samples, sparse, predicted, seconds = _timed_rollout(
        simulator, scene, frames=frames, sparse_points=sparse_points
    )
    device = str(next(simulator.parameters()).device)
    solver = replace(simulator.config.solver, frames=frames + 1)
    truth = simulate(_within(scene, frames), solver, device=device)
    scores = _compare(simulator.to("cpu"), scene, samples, predicted, truth)
    simulator.to(device)
    solver_seconds = float(truth.attributes["seconds"]) / frames
    scores |= {
        "points": len(scene.position),
        "sparse_points": len(samples),
        "reduction": len(scene.position) / len(samples),
        "frames": frames,
        "frame_dt": simulator.config.frame_dt,
        "seconds_per_frame": {name: value / frames for name, value in seconds.items()},
        "solver_seconds_per_frame": solver_seconds,
        "speedup": solver_seconds * frames / seconds["total"],
        "threads": torch.get_num_threads(),
        "solver_threads": 1,
        "device": device,
        "shape": scene.attributes.get("shape"),
        "sparse_rollout_mse": float(
            squared_error_per_frame(sparse, truth.position[1:, samples]).mean()
        ),
    }
    motion = replace(truth, position=torch.cat([scene.position[None], predicted]))
    return Verdict(predicted=motion, truth=truth, scores=scores)


def scene_with_points(config: SceneConfig, *, points: int | None, found: int) -> SceneConfig:
    """The scene family with a filling that gives about ``points`` particles.

    Args:
        config: The family.
        points: Wanted number; none keeps the filling.
        found: Number that ``config`` gives.
    """
    if points is None:
        return config
    if points < 1:
        raise ValueError(f"the number of points must be >= 1, got {points}.")
    if config.points is not None:
        return replace(config, points=max(1, round(config.points * points / found)))
    factor = (found / points) ** (1.0 / config.dimension)
    return replace(config, spacing=config.spacing * factor)


def _within(scene: Scene, frames: int) -> Scene:
    """The scene without a change of material that so short a run does not reach."""
    is_reached = scene.switch is None or scene.switch.frame < frames
    return scene if is_reached else replace(scene, switch=None)


def _timed_rollout(
    simulator: Simulator, scene: Scene, *, frames: int, sparse_points: int | None
) -> tuple[Tensor, Tensor, Tensor, dict[str, float]]:
    """Samples, sparse and full positions, and the time of each stage, adding up to ``total`` [s].

    Everything is computed on the device of the simulator and returned on the CPU.
    """
    device = next(simulator.parameters()).device
    arguments = [part.to(device) for part in (scene.position, scene.velocity, scene.particle_type)]
    watch = Stopwatch()
    samples = watch.timed("sample", simulator.sample)(arguments[0], count=sparse_points)
    decoder = watch.timed("upscale", simulator.decoder)(
        arguments[0], scene.kinematic.to(device), samples=samples
    )
    decode = watch.timed("upscale", decoder)
    connect = watch.timed("graph", simulator.connect)
    network = watch.timed("network", simulator.dynamics.step)
    state = simulator.start(*arguments, samples=samples)
    with torch.no_grad():
        simulator.dynamics.step(state, simulator.connect(state))  # warm-up
    synchronize()
    setup, start = sum(watch.seconds.values()), time.perf_counter()
    sparse, full = [], []
    for later in rollout(state, frames, connect=connect, step=network):
        sparse.append(later.position)
        full.append(decode(later.position))
    synchronize()
    total = setup + time.perf_counter() - start
    seconds = dict(watch.seconds)
    seconds["integrate"] = max(0.0, total - sum(seconds.values()))
    moved = torch.stack(sparse).cpu(), torch.stack(full).cpu()
    return samples.cpu(), *moved, seconds | {"total": total}


def _compare(
    simulator: Simulator, scene: Scene, samples: Tensor, predicted: Tensor, truth: Trajectory
) -> dict[str, Any]:
    """Errors of surrogate, field alone and trivial predictions on all points."""
    frames = len(predicted)
    everything = start_from_velocity(
        scene.position,
        scene.velocity,
        particle_type=scene.particle_type,
        bounds=truth.bounds,
        frame_dt=truth.frame_dt,
        history=2,
    )
    gravity = torch.zeros(scene.position.shape[1])
    gravity[1] = -scene.gravity
    result = Comparison(
        given=scene.position[None],
        truth=truth.position[1:],
        predicted=predicted,
        trivial=trivial_predictions(
            everything,
            truth.position[1:],
            gravity=gravity,
            body=surroundings_of(truth).body,
        ),
        frame_dt=truth.frame_dt,
        swings=bool(scene.kinematic.any()),
    ).scores()
    decode = simulator.decoder(scene.position, scene.kinematic, samples=samples)
    floor = torch.stack([decode(position) for position in truth.position[1:, samples]])
    floor_error = squared_error_per_frame(floor, truth.position[1:])
    result["projection_floor_mse"] = float(floor_error.sum()) / (frames + 1)
    if not math.isfinite(result["rollout_mse"]):
        raise FloatingPointError("the rollout is not finite; the model does not fit this scene.")
    return result
