"""Score a simulator on trajectories it was not trained on.

Three questions are kept apart: how good the time-stepper is on the samples, how good the field is
with true samples (the projection floor), and how good both are together. The trivial predictions
stand beside each. Kinematic particles follow the data in every prediction: they have no error, and
the means are over all particles, as in the paper.
"""

import copy
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from giorom.evaluation.comparison import Comparison, surroundings_of, trivial_predictions
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.rollout import roll_out
from giorom.pipeline import Decode, start_from_trajectory
from giorom.simulator import Simulator
from giorom.state import Trajectory

ONE_STEP_STRIDE = 5
"""Every how many frames the one-step error is measured."""


def evaluate_trajectory(
    simulator: Simulator,
    trajectory: Trajectory,
    *,
    frames: int | None = None,
    sparse_points: int | None = None,
    full: bool = True,
) -> dict[str, Any]:
    """Roll one held-out trajectory out from its first frames and compare.

    Args:
        simulator: The model.
        trajectory: Full-order truth.
        frames: Frames to predict; by default all there are.
        sparse_points: Number of samples; by default the trained reduction.
        full: Whether all particles are recovered and scored, and single steps. The rollout of the
            samples is a small part of the work; without the rest there are no ``full`` scores.

    Returns:
        ``sparse`` and ``full`` scores, sizes, and the frame of divergence, if any.

    Raises:
        ValueError: If the trajectory has no frame to predict.
    """
    history = simulator.config.features.history
    available = trajectory.frame_count - history
    if available < 1:
        raise ValueError(
            f"the model starts from {history} given frames and needs one more to compare, but the "
            f"trajectory has {trajectory.frame_count}. Use longer trajectories."
        )
    frames = available if frames is None else min(frames, available)
    samples = simulator.sample(trajectory.position[0], count=sparse_points)
    state = start_from_trajectory(trajectory, samples, history=history)
    truth = trajectory.position[history : history + frames]
    sparse = roll_out(
        state,
        frames,
        connect=simulator.connect,
        step=simulator.dynamics.step,
        prescribed=truth[:, samples],
    )
    sparse_scores, full_scores = (
        _scores(trajectory, samples, sparse.position, history=history),
        None,
    )
    if full:
        full_scores = _full_scores(simulator, trajectory, samples, sparse.position)
        sparse_scores["one_step_mse"], full_scores["one_step_mse"] = one_step_errors(
            simulator, trajectory, samples, frames=frames
        )
        for scores in (sparse_scores, full_scores):
            scores["one_step_mse_axis_mean"] = scores["one_step_mse"] / truth.shape[2]
    return {
        "points": trajectory.position.shape[1],
        "sparse_points": len(samples),
        "frames": frames,
        "diverged_at": sparse.diverged_at,
        "shape": trajectory.attributes.get("shape"),
        "sparse": sparse_scores,
        "full": full_scores,
    }


def _full_scores(
    simulator: Simulator, trajectory: Trajectory, samples: Int[Tensor, " q"], predicted: Tensor
) -> dict[str, Any]:
    """Scores of all particles, recovered from predicted and from true samples."""
    history = simulator.config.features.history
    truth = trajectory.position[history : history + len(predicted)]
    decode = simulator.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)
    full = decoded(decode, predicted, trajectory.kinematic, truth)
    everything = torch.arange(trajectory.position.shape[1], device=samples.device)
    scores = _scores(trajectory, everything, full, history=history)
    decode.restart()
    floor = decoded(decode, truth[:, samples], trajectory.kinematic, truth)
    floor_error = squared_error_per_frame(floor, truth)
    scores["projection_floor_mse"] = float(floor_error.sum()) / (len(truth) + history)
    return scores


def one_step_errors(
    simulator: Simulator, trajectory: Trajectory, samples: Int[Tensor, " q"], *, frames: int
) -> tuple[float, float]:
    """Mean squared error of one frame from the true state, on the samples and on all points.

    What a time-stepper remembers beside positions is carried from frame to frame while the
    positions it sees are the true ones.

    Source:
        The official definition (arXiv:2407.03925v2, appendix F): squared distance after one Euler
        step, without training noise.
    """
    history = simulator.config.features.history
    decode = simulator.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)
    start = start_from_trajectory(trajectory, samples, history=history)
    sparse_errors, full_errors, memory = [], [], None
    for number in range(frames):
        is_due = number % ONE_STEP_STRIDE == 0
        if decode.remembers:
            decode(trajectory.position[number + history - 1, samples])
        if not is_due and memory is None:
            continue
        window = trajectory.position[number : number + history, samples]
        state = replace(start, history=window.transpose(0, 1).contiguous(), memory=memory)
        truth = trajectory.position[number + history : number + history + 1]
        with torch.no_grad():
            later = simulator.dynamics.step(state, simulator.connect(state), truth[0, samples])
        memory = later.memory
        if is_due:
            moved = later.position[None]
            sparse_errors.append(squared_error_per_frame(moved, truth[:, samples]))
            full = decoded(copy.copy(decode), moved, trajectory.kinematic, truth)
            full_errors.append(squared_error_per_frame(full, truth))
    return float(torch.cat(sparse_errors).mean()), float(torch.cat(full_errors).mean())


def summarize(results: list[dict[str, Any]], *, system: str) -> dict[str, Any]:
    """Means over trajectories, with their spread; diverged rollouts are counted and left out.

    Args:
        results: One entry of ``evaluate_trajectory`` per trajectory.
        system: Name of the physical system.

    Raises:
        ValueError: If there is no result.
    """
    if not results:
        raise ValueError("there is no trajectory to score; choose a split that holds some.")
    sound = [result for result in results if result["diverged_at"] is None]
    summary: dict[str, Any] = {
        "system": system,
        "trajectories": len(results),
        "frames": min(result["frames"] for result in results),
        "points": round(sum(r["points"] for r in results) / len(results)),
        "sparse_points": round(sum(r["sparse_points"] for r in results) / len(results)),
        "diverged": len(results) - len(sound),
    }
    for where in ("sparse", "full"):
        scores = [result[where] for result in sound if result[where] is not None]
        summary[where] = _mean_of(scores) if scores else None
    summary["per_trajectory"] = [_brief(result) for result in results]
    return summary


def _brief(result: dict[str, Any]) -> dict[str, Any]:
    """What is kept of each trajectory, so that no mean can hide one; MSE on all particles."""
    kept = ("rollout_mse", "static_mse", "free_fall_mse", "frozen_shape_mse")
    same = ("shape", "points", "sparse_points", "frames", "diverged_at")
    return {name: result.get(name) for name in same} | {
        "sparse_rollout_mse": result["sparse"]["rollout_mse"],
        **{name: (result["full"] or {}).get(name) for name in kept},
    }


SPREAD = (
    "one_step_mse",
    "rollout_mse",
    "static_mse",
    "constant_velocity_mse",
    "free_fall_mse",
    "frozen_shape_mse",
)
"""Scores whose standard deviation over trajectories is reported, as ``..._std``."""


def _mean_of(scores: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean over trajectories of every score; of curves, frame by frame.

    A score that some trajectories do not have (None) is the mean over the others.
    """
    result: dict[str, Any] = {}
    for key, value in scores[0].items():
        values = [score[key] for score in scores]
        if isinstance(value, dict):
            common = [name for name in value if all(name in v for v in values)]
            result[key] = {n: sum(v[n] for v in values) / len(values) for n in common}
        elif isinstance(value, list):
            length = min(len(v) for v in values)
            result[key] = [sum(v[i] for v in values) / len(values) for i in range(length)]
        else:
            known = [v for v in values if v is not None]
            result[key] = sum(known) / len(known) if known else None
    if len(scores) > 1:
        for key in SPREAD:
            if key in scores[0]:
                values = torch.tensor([score[key] for score in scores], dtype=torch.float64)
                result[f"{key}_std"] = float(values.std())
    return result


def _scores(
    trajectory: Trajectory, points: Int[Tensor, " q"], predicted: Tensor, *, history: int
) -> dict[str, Any]:
    """Scores of a prediction for some points of a trajectory, trivial ones beside it."""
    surroundings = surroundings_of(trajectory)
    truth = trajectory.position[history : history + len(predicted), points]
    state = start_from_trajectory(trajectory, points, history=history)
    trivial = trivial_predictions(
        state, truth, gravity=surroundings.gravity, body=surroundings.body[points]
    )
    return Comparison(
        given=trajectory.position[:history, points],
        truth=truth,
        predicted=predicted,
        trivial=trivial,
        bounds=trajectory.bounds,
        frame_dt=trajectory.frame_dt,
        swings=bool(trajectory.kinematic.any()),
    ).scores()


def decoded(decode: Decode, samples: Tensor, kinematic: Tensor, truth: Tensor) -> Tensor:
    """Positions of all particles at every frame; the kinematic ones where the data have them."""
    position = torch.stack([decode(frame) for frame in samples])
    return torch.where(kinematic[:, None], truth, position)
