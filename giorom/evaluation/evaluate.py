"""Score a simulator on trajectories it was not trained on.

Three questions are kept apart: how good the time-stepper is on the samples, how good the field is
with true samples (the projection floor), and how good both are together. The trivial predictions
stand beside each. Kinematic particles follow the data in every prediction: they have no error, and
the means are over all particles, as in the paper.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.evaluation.metrics import (
    amplitude_ratio,
    displacement_correlation,
    relative_displacement_error,
    squared_error_per_frame,
)
from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import constant_velocity, free_fall, hold_still
from giorom.integrate import advance
from giorom.pipeline import Decode, start_from_trajectory
from giorom.simulator import Simulator
from giorom.state import SparseState, Trajectory

REPORT_FRAMES = (50, 100, 200, 400)
"""Frames at which the mean error so far is reported separately."""

ONE_STEP_STRIDE = 5
"""Every how many frames the one-step error is measured."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A true motion and what was predicted for it, on one set of points."""

    given: Float[Tensor, "g p d"]
    """True positions at the given frames [m]."""

    truth: Float[Tensor, "t p d"]
    """True positions at the predicted frames [m]."""

    predicted: Float[Tensor, "t p d"]
    """Positions the model predicted [m]."""

    trivial: dict[str, Float[Tensor, "t p d"]]
    """Positions the trivial predictions give [m]."""

    def scores(self) -> dict[str, Any]:
        """The keys of ``giorom evaluate --json`` for one trajectory and one set of points."""
        error = squared_error_per_frame(self.predicted, self.truth)
        frames, given = len(error), len(self.given)
        with_given = float(error.sum()) / (frames + given)
        first = self.given[:1]
        result: dict[str, Any] = {
            "rollout_mse": with_given,
            "rollout_mse_without_seed_frames": float(error.mean()),
            "rollout_mse_axis_mean": with_given / self.truth.shape[2],
            "relative_displacement_error": relative_displacement_error(
                torch.cat([first, self.predicted]), torch.cat([first, self.truth])
            ),
            "amplitude_ratio": amplitude_ratio(
                torch.cat([first, self.predicted]), torch.cat([first, self.truth])
            ),
            "displacement_correlation": displacement_correlation(
                torch.cat([first, self.predicted]), torch.cat([first, self.truth])
            ),
            "rollout_mse_at": {
                str(frame): float(error[: frame - given].sum()) / frame
                for frame in REPORT_FRAMES
                if given < frame <= frames + given
            },
            "error_per_frame": [0.0] * given + error.tolist(),
        }
        for name, positions in self.trivial.items():
            mean = squared_error_per_frame(positions, self.truth).sum()
            result[f"{name}_mse"] = float(mean) / (frames + given)
        return result


def evaluate_trajectory(
    simulator: Simulator, trajectory: Trajectory, *, frames: int | None = None
) -> dict[str, Any]:
    """Roll one held-out trajectory out from its first frames and compare.

    Args:
        simulator: The model.
        trajectory: Full-order truth.
        frames: Frames to predict; by default all there are.

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
    samples = simulator.sample(trajectory.position[0])
    state = start_from_trajectory(trajectory, samples, history=history)
    truth = trajectory.position[history : history + frames]
    sparse = roll_out(
        state,
        frames,
        connect=simulator.connect,
        acceleration=simulator.dynamics,
        prescribed=truth[:, samples],
    )
    gravity = _gravity(trajectory)
    decode = simulator.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)
    everything = torch.arange(trajectory.position.shape[1])
    full_state = start_from_trajectory(trajectory, everything, history=history)
    sparse_scores = Comparison(
        given=trajectory.position[:history, samples],
        truth=truth[:, samples],
        predicted=sparse.position,
        trivial=_trivial(state, truth[:, samples], gravity),
    ).scores()
    full_scores = Comparison(
        given=trajectory.position[:history],
        truth=truth,
        predicted=_decoded(decode, sparse.position, trajectory.kinematic, truth),
        trivial=_trivial(full_state, truth, gravity),
    ).scores()
    floor = _decoded(decode, truth[:, samples], trajectory.kinematic, truth)
    floor_error = squared_error_per_frame(floor, truth)
    full_scores["projection_floor_mse"] = float(floor_error.sum()) / (frames + history)
    sparse_scores["one_step_mse"], full_scores["one_step_mse"] = one_step_errors(
        simulator, trajectory, samples, frames=frames
    )
    return {
        "points": trajectory.position.shape[1],
        "sparse_points": len(samples),
        "frames": frames,
        "diverged_at": sparse.diverged_at,
        "shape": trajectory.attributes.get("shape"),
        "sparse": sparse_scores,
        "full": full_scores,
    }


def one_step_errors(
    simulator: Simulator, trajectory: Trajectory, samples: Int[Tensor, " q"], *, frames: int
) -> tuple[float, float]:
    """Mean squared error of one frame from the true state, on the samples and on all points.

    Source:
        The official definition (arXiv:2407.03925v2, appendix F): squared distance after one Euler
        step, without training noise.
    """
    history = simulator.config.features.history
    decode = simulator.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)
    sparse_errors, full_errors = [], []
    for frame in range(history - 1, history - 1 + frames, ONE_STEP_STRIDE):
        state = start_from_trajectory(trajectory, samples, history=history, frame=frame)
        with torch.no_grad():
            acceleration = simulator.dynamics(state, simulator.connect(state))
        truth = trajectory.position[frame + 1 : frame + 2]
        later = advance(state, acceleration, prescribed=truth[0, samples]).position[None]
        sparse_errors.append(squared_error_per_frame(later, truth[:, samples]))
        full = _decoded(decode, later, trajectory.kinematic, truth)
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
        scores = [result[where] for result in sound]
        summary[where] = _mean_of(scores) if scores else None
    return summary


def _mean_of(scores: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean over trajectories of every score; of curves, frame by frame."""
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
            result[key] = sum(values) / len(values)
    if len(scores) > 1:
        errors = torch.tensor([score["rollout_mse"] for score in scores], dtype=torch.float64)
        result["rollout_mse_std"] = float(errors.std())
    return result


def _trivial(state: SparseState, truth: Tensor, gravity: Tensor) -> dict[str, Tensor]:
    frames = len(truth)
    return {
        "constant_velocity": constant_velocity(state, frames, prescribed=truth),
        "free_fall": free_fall(state, frames, gravity=gravity, prescribed=truth),
        "static": hold_still(state, frames, prescribed=truth),
    }


def _decoded(decode: Decode, samples: Tensor, kinematic: Tensor, truth: Tensor) -> Tensor:
    """Positions of all particles at every frame; the kinematic ones where the data have them."""
    position = torch.stack([decode(frame) for frame in samples])
    return torch.where(kinematic[:, None], truth, position)


def _gravity(trajectory: Trajectory) -> Tensor:
    """Gravity of the scene [m/s^2]; axis 1 points up."""
    gravity = trajectory.position.new_zeros(trajectory.position.shape[2])
    gravity[1] = -float(trajectory.attributes.get("gravity", 9.8))
    return gravity
