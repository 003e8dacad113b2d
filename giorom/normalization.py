"""Between physical and dimensionless quantities.

The one place that leaves SI units. A ``Normalization`` is fitted on training trajectories only;
the spread of the training noise is part of it and stays part of it when the model is used
(arXiv:2002.09405, as in the official code of arXiv:2407.03925).
"""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Normalization:
    """Offsets and scales of velocity and acceleration."""

    velocity_mean: tuple[float, ...]
    """Mean velocity per axis [m/s]."""

    velocity_std: tuple[float, ...]
    """Spread of the velocity per axis, training noise included [m/s]."""

    acceleration_mean: tuple[float, ...]
    """Mean acceleration per axis [m/s^2]."""

    acceleration_std: tuple[float, ...]
    """Spread of the acceleration per axis, training noise included [m/s^2]."""

    def __post_init__(self) -> None:
        """Reject scales nothing can be divided by."""
        for name in ("velocity_std", "acceleration_std"):
            values = getattr(self, name)
            if not all(math.isfinite(value) and value > 0.0 for value in values):
                raise ValueError(
                    f"Normalization.{name} must be finite and > 0 on every axis, got {values}. "
                    f"Check that the training data move on every axis."
                )

    @classmethod
    def fit(
        cls,
        *,
        velocity_mean: tuple[float, ...],
        velocity_std: tuple[float, ...],
        acceleration_mean: tuple[float, ...],
        acceleration_std: tuple[float, ...],
        noise_std: float,
        frame_dt: float,
        isotropic: bool,
        gravity: tuple[float, ...] | None = None,
    ) -> "Normalization":
        """Combine the statistics of the training data with the training noise.

        Args:
            velocity_mean: Of the training data, per axis [m/s].
            velocity_std: Of the training data, per axis [m/s].
            acceleration_mean: Of the training data, per axis [m/s^2].
            acceleration_std: Of the training data, per axis [m/s^2].
            noise_std: Spread of the noise on the last velocity, as displacement per frame [m].
            frame_dt: Time between frames [s].
            isotropic: One scale for all axes and no offset, which keeps rotations rotations.
            gravity: Take this for the offset of the acceleration, whose scale is then the spread
                about it [m/s^2].
        """
        if gravity is not None:
            pairs = zip(acceleration_mean, gravity, acceleration_std, strict=True)
            acceleration_std = tuple(math.hypot(mean - g, s) for mean, g, s in pairs)
        if isotropic:
            axes = len(velocity_std)
            velocity_std = (math.sqrt(sum(s * s for s in velocity_std) / axes),) * axes
            acceleration_std = (math.sqrt(sum(s * s for s in acceleration_std) / axes),) * axes
            velocity_mean = acceleration_mean = (0.0,) * axes
        velocity_noise, acceleration_noise = noise_std / frame_dt, noise_std / frame_dt**2
        if gravity is not None:
            acceleration_mean = gravity
        return cls(
            velocity_mean=velocity_mean,
            velocity_std=tuple(math.hypot(s, velocity_noise) for s in velocity_std),
            acceleration_mean=acceleration_mean,
            acceleration_std=tuple(math.hypot(s, acceleration_noise) for s in acceleration_std),
        )

    def velocity(self, value: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Dimensionless velocity from [m/s]."""
        mean, std = value.new_tensor(self.velocity_mean), value.new_tensor(self.velocity_std)
        return (value - mean) / std

    def acceleration(self, value: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Dimensionless acceleration from [m/s^2]."""
        mean = value.new_tensor(self.acceleration_mean)
        return (value - mean) / value.new_tensor(self.acceleration_std)

    def physical_acceleration(self, value: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Acceleration [m/s^2] from the dimensionless one; inverse of ``acceleration``."""
        mean = value.new_tensor(self.acceleration_mean)
        return value * value.new_tensor(self.acceleration_std) + mean
