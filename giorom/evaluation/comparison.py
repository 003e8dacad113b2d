"""A true motion beside what a model and what predictions without a model make of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.evaluation.distribution import (
    chamfer_distance,
    density_difference,
    sliced_wasserstein,
)
from giorom.evaluation.mechanics import (
    density_error,
    kinetic_energy_error,
    kinetic_energy_mse,
    momentum_error,
    number_density,
    smallest_distance,
    volume_ratio,
)
from giorom.evaluation.metrics import (
    amplitude_ratio,
    bounding_box_error,
    centroid_error,
    displacement_correlation,
    relative_displacement_error,
    squared_error_per_frame,
)
from giorom.evaluation.swing import compare_swings
from giorom.evaluation.transport import (
    earth_mover_distance,
    has_sinkhorn,
    sinkhorn_divergence,
    typical_spacing,
)
from giorom.evaluation.trivial import constant_velocity, free_fall, frozen_shape, hold_still
from giorom.state import SparseState, Trajectory

REPORT_FRAMES = (50, 100, 200, 400)
"""Frames at which the mean error so far is reported separately."""

DISTRIBUTION_STRIDE = 25
"""Every how many frames the distances between clouds are measured; the last frame always is."""

MOST_TRANSPORTED = 300
"""Most points between which transport is measured: 800 took longer than their rollout."""

DISTRIBUTION_BASELINES = ("static", "free_fall", "frozen_shape")
"""Trivial predictions whose distances between clouds are measured too."""


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

    bounds: Float[Tensor, "d 2"] | None = None
    """Walls of the domain [m]; with them, distances between the clouds are measured."""

    frame_dt: float | None = None
    """Time between frames [s]; with it, energy and momentum are compared."""

    swings: bool = False
    """Whether the body is held somewhere, so that it swings about its place."""

    def scores(self) -> dict[str, Any]:
        """The keys of ``giorom evaluate --json`` for one trajectory and one set of points.

        Given frames have no error and count in every mean that does not say otherwise.
        """
        error = squared_error_per_frame(self.predicted, self.truth)
        frames, given = len(error), len(self.given)
        with_given = float(error.sum()) / (frames + given)
        first = self.given[:1]
        predicted = torch.cat([first, self.predicted])
        truth = torch.cat([first, self.truth])
        result: dict[str, Any] = {
            "rollout_mse": with_given,
            "rollout_mse_without_seed_frames": float(error.mean()),
            "rollout_mse_axis_mean": with_given / self.truth.shape[2],
            "relative_displacement_error": relative_displacement_error(predicted, truth),
            "amplitude_ratio": amplitude_ratio(predicted, truth),
            "displacement_correlation": displacement_correlation(predicted, truth),
            "final_centroid_error": centroid_error(predicted[-1], truth[-1]),
            "final_bounding_box_error": bounding_box_error(predicted[-1], truth[-1]),
            "rollout_mse_at": self._means_until(error),
            "error_per_frame": [0.0] * given + error.tolist(),
        }
        for name, positions in self.trivial.items():
            trivial_error = squared_error_per_frame(positions, self.truth)
            result[f"{name}_mse"] = float(trivial_error.sum()) / (frames + given)
            result[f"{name}_mse_at"] = self._means_until(trivial_error)
        parts = (self._distribution(), self._packing(), self._mechanics())
        for part in parts:
            result |= part
        return result | self._swing(predicted, truth)

    def _means_until(self, error: Float[Tensor, " t"]) -> dict[str, float]:
        """Mean error so far at the frames of the report."""
        given = len(self.given)
        return {
            str(frame): float(error[: frame - given].sum()) / frame
            for frame in REPORT_FRAMES
            if given < frame <= len(error) + given
        }

    def _distribution(self) -> dict[str, Any]:
        """Distances between the clouds: means over some frames, and those of the last frame."""
        if self.bounds is None:
            return {}
        chosen, bounds = self._chosen_frames(), self.bounds
        measures: dict[str, Callable[[Tensor, Tensor], float]] = {
            "chamfer": chamfer_distance,
            "density_difference": lambda a, b: density_difference(a, b, bounds=bounds),
            "sliced_wasserstein": sliced_wasserstein,
        }
        result: dict[str, Any] = {}
        clouds = {"": self.predicted} | {
            f"{name}_": self.trivial[name]
            for name in DISTRIBUTION_BASELINES
            if name in self.trivial
        }
        for prefix, positions in clouds.items():
            for name, measure in measures.items():
                values = [measure(positions[frame], self.truth[frame]) for frame in chosen]
                result[f"{prefix}{name}"] = sum(values) / len(values)
                result[f"{prefix}final_{name}"] = values[-1]
        return result

    def _chosen_frames(self) -> list[int]:
        """Frames at which clouds are compared."""
        last = len(self.truth) - 1
        return sorted({*range(DISTRIBUTION_STRIDE - 1, last, DISTRIBUTION_STRIDE), last})

    def _packing(self) -> dict[str, Any]:
        """Transport between the clouds, their densities and their smallest distances.

        Means over the frames at which clouds are compared. None is what was not measured:
        transport between many points, the divergence without its library.
        """
        if self.bounds is None or self.truth.shape[1] < 2:
            return {}
        spacing = typical_spacing(self.given[-1])
        measured: dict[str, list[float]] = {}
        for frame in self._chosen_frames():
            values = _packing_at(self.predicted[frame], self.truth[frame], spacing=spacing)
            for name, value in values.items():
                measured.setdefault(name, []).append(value)
        names = (
            "earth_mover_distance",
            "sinkhorn_divergence",
            "density_error",
            "volume_error",
            "smallest_distance",
            "true_smallest_distance",
        )
        result: dict[str, Any] = {}
        for name in names:
            values = measured.get(name)
            result[name] = None if values is None else sum(values) / len(values)
            result[f"final_{name}"] = None if values is None else values[-1]
        return result

    def _mechanics(self) -> dict[str, Any]:
        """Errors of kinetic energy and momentum; none where the time between frames is unknown."""
        if self.frame_dt is None:
            return {}
        start, options = self.given[-1:], {"frame_dt": self.frame_dt}
        predicted, truth = (torch.cat([start, m]) for m in (self.predicted, self.truth))
        return {
            "kinetic_energy_mse": kinetic_energy_mse(predicted, truth, **options),
            "kinetic_energy_error": kinetic_energy_error(predicted, truth, **options),
            "momentum_error": momentum_error(predicted, truth, **options),
        }

    def _swing(self, predicted: Tensor, truth: Tensor) -> dict[str, Any]:
        """Period and amplitude of a swinging body; none where less than a period is seen."""
        if not self.swings:
            return {}
        swing = compare_swings(predicted, truth)
        names = ("true_period", "period_ratio", "amplitude_ratio")
        values = [None if swing is None else getattr(swing, name) for name in names]
        deviations = [None if swing is None else abs(value - 1.0) for value in values[1:]]
        return {
            "swing_seen": 0.0 if swing is None else 1.0,
            "swing_period": values[0],
            "swing_period_ratio": values[1],
            "swing_amplitude_ratio": values[2],
            "swing_period_deviation": deviations[0],
            "swing_amplitude_deviation": deviations[1],
        }


def _packing_at(predicted: Tensor, truth: Tensor, *, spacing: float) -> dict[str, float]:
    """Transport, density and smallest distance of two clouds of the same points.

    Args:
        predicted: One cloud [m].
        truth: The other [m].
        spacing: Distance between neighbours at the start [m]; zero where points coincide.
    """
    result = {
        "smallest_distance": smallest_distance(predicted),
        "true_smallest_distance": smallest_distance(truth),
    }
    if len(truth) <= MOST_TRANSPORTED:
        result["earth_mover_distance"] = earth_mover_distance(predicted, truth)
    if spacing > 0.0:
        one, two = (number_density(cloud, spacing=spacing) for cloud in (predicted, truth))
        result["density_error"] = density_error(one, two)
        result["volume_error"] = abs(volume_ratio(one, two) - 1.0)
        if len(truth) <= MOST_TRANSPORTED and has_sinkhorn():
            result["sinkhorn_divergence"] = sinkhorn_divergence(predicted, truth, spacing=spacing)
    return result


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What predictions without a model need to know of a scene."""

    gravity: Float[Tensor, " d"]
    """Gravity [m/s^2]; axis 1 points up."""

    body: Int[Tensor, " p"]
    """Number of the body of each particle."""


def surroundings_of(trajectory: Trajectory) -> Surroundings:
    """Gravity and bodies of a trajectory, from its attributes.

    Without ``gravity`` it is 9.8 m/s^2. The particles of our own scenes are stored body after body,
    each with its number of points; where that is missing or does not add up, all are one body.
    """
    gravity = trajectory.position.new_zeros(trajectory.position.shape[2])
    gravity[1] = -float(trajectory.attributes.get("gravity", 9.8))
    body = torch.zeros_like(trajectory.particle_type, dtype=torch.long)
    bodies = trajectory.attributes.get("bodies", [])
    counts = [entry.get("points") for entry in bodies if isinstance(entry, dict)]
    if counts and all(isinstance(count, int) for count in counts) and sum(counts) == len(body):
        repeats = torch.tensor(counts, device=body.device)
        body = torch.arange(len(counts), device=body.device).repeat_interleave(repeats)
    return Surroundings(gravity=gravity, body=body)


def trivial_predictions(
    state: SparseState,
    truth: Float[Tensor, "t q d"],
    *,
    gravity: Float[Tensor, " d"],
    body: Int[Tensor, " q"] | None = None,
) -> dict[str, Float[Tensor, "t q d"]]:
    """What is predicted without a model, and by the oracle of the frozen shape [m].

    ``constant_velocity`` and ``free_fall`` stop at the walls and always have; the names
    ``clamped_constant_velocity`` and ``ballistic_clamped`` say so and hold the same positions.

    Args:
        state: The given frames.
        truth: True positions at the frames to come; the kinematic ones are followed [m].
        gravity: Gravity [m/s^2].
        body: Number of the body of each particle; by default all are one.
    """
    frames = len(truth)
    straight = constant_velocity(state, frames, prescribed=truth)
    falling = free_fall(state, frames, gravity=gravity, prescribed=truth)
    return {
        "constant_velocity": straight,
        "clamped_constant_velocity": straight,
        "free_fall": falling,
        "ballistic_clamped": falling,
        "static": hold_still(state, frames, prescribed=truth),
        "frozen_shape": frozen_shape(state, truth, body=body),
    }
