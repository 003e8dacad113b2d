"""Mean and standard deviation of velocities and accelerations, exactly and in one pass.

Networks see velocities and accelerations divided by these numbers. They are taken from the
training trajectories only, over every particle that moves by itself (kinematic ones follow the
scene) and every frame, from sums in float64: the standard deviation of the data. (The published
code takes the deviation *of the per-trajectory deviations*, which is far too small.)

``Statistics`` is per frame, as in GNS's metadata: a velocity is x_{k+1} - x_k [m/frame], an
acceleration x_{k+1} - 2 x_k + x_{k-1} [m/frame^2]. ``in_si`` gives m/s and m/s^2.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import Trajectory

__all__ = ["Statistics", "StatisticsAccumulator", "measure_statistics"]

BLOCK_NUMBERS = 1 << 20
"""Coordinates that are differenced in float64 at a time: 8 MiB, however long a trajectory."""


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Mean and standard deviation per axis, in float64."""

    velocity_mean: Float[Tensor, " d"]
    """Mean velocity [m/frame]."""

    velocity_std: Float[Tensor, " d"]
    """Standard deviation of the velocity [m/frame]."""

    acceleration_mean: Float[Tensor, " d"]
    """Mean acceleration [m/frame^2]."""

    acceleration_std: Float[Tensor, " d"]
    """Standard deviation of the acceleration [m/frame^2]."""

    def in_si(self, *, frame_dt: float) -> "Statistics":
        """The same numbers per second.

        Args:
            frame_dt: Time between frames [s].

        Returns:
            Velocities in m/s, accelerations in m/s^2.
        """
        return self._scaled(1.0 / _checked(frame_dt))

    def per_frame(self, *, frame_dt: float) -> "Statistics":
        """The inverse of ``in_si``.

        Args:
            frame_dt: Time between frames [s].

        Returns:
            Velocities in m/frame, accelerations in m/frame^2.
        """
        return self._scaled(_checked(frame_dt))

    def to_metadata(self) -> dict[str, list[float]]:
        """The four GNS metadata entries (to be called on per-frame statistics)."""
        return {
            "vel_mean": self.velocity_mean.tolist(),
            "vel_std": self.velocity_std.tolist(),
            "acc_mean": self.acceleration_mean.tolist(),
            "acc_std": self.acceleration_std.tolist(),
        }

    @classmethod
    def from_metadata(cls, metadata: dict[str, Any]) -> "Statistics":
        """Per-frame statistics of a data set.

        Args:
            metadata: What ``giorom.data.trajectory_file.read_metadata`` returns.

        Returns:
            The statistics [m/frame, m/frame^2].

        Raises:
            ValueError: If an entry is missing.
        """
        names = ("vel_mean", "vel_std", "acc_mean", "acc_std")
        missing = [name for name in names if name not in metadata]
        if missing:
            raise ValueError(
                f"the metadata lacks {', '.join(missing)}; they are per-frame statistics of the "
                f"training split. Compute them with measure_statistics."
            )
        values = [torch.tensor(metadata[name], dtype=torch.float64) for name in names]
        return cls(
            velocity_mean=values[0],
            velocity_std=values[1],
            acceleration_mean=values[2],
            acceleration_std=values[3],
        )

    def _scaled(self, frequency: float) -> "Statistics":
        """Velocities times ``frequency``, accelerations times its square."""
        return replace(
            self,
            velocity_mean=self.velocity_mean * frequency,
            velocity_std=self.velocity_std * frequency,
            acceleration_mean=self.acceleration_mean * frequency**2,
            acceleration_std=self.acceleration_std * frequency**2,
        )


def measure_statistics(trajectories: Iterable[Trajectory]) -> Statistics:
    """Measure the statistics of a training split, reading each trajectory once.

    Args:
        trajectories: The training trajectories, all of one dimension.

    Returns:
        Per-frame statistics, population standard deviations.

    Raises:
        ValueError: If no free particle has three frames.
    """
    total = StatisticsAccumulator()
    for trajectory in trajectories:
        block = max(1, BLOCK_NUMBERS // max(1, trajectory.position[0].numel()))
        for first in range(0, trajectory.frame_count - 1, block):
            # Two frames more than steps, for the second differences.
            window = trajectory.position[first : first + block + 2]
            step = window[:, ~trajectory.kinematic].double().diff(dim=0)
            total.velocity.add(step[:block].flatten(0, 1))
            total.acceleration.add(step.diff(dim=0).flatten(0, 1))
    return total.statistics()


def _checked(frame_dt: float) -> float:
    """Reject a frame time that is not positive."""
    if not frame_dt > 0.0:
        raise ValueError(f"frame_dt is a time step in seconds and must be > 0, got {frame_dt!r}.")
    return frame_dt


class StatisticsAccumulator:
    """Statistics that grow with the data: add rows as they arrive, merge what others measured.

    ``velocity`` takes the displacements per frame of free particles, ``acceleration`` their second
    differences.
    """

    def __init__(self) -> None:
        self.velocity, self.acceleration = Moments(), Moments()

    def merge(self, other: "StatisticsAccumulator") -> None:
        """Take in what ``other`` has seen."""
        self.velocity.merge(other.velocity)
        self.acceleration.merge(other.acceleration)

    def statistics(self) -> Statistics:
        """Statistics of everything so far, per frame.

        Raises:
            ValueError: If no free particle had three frames.
        """
        if self.velocity.count == 0 or self.acceleration.count == 0:
            raise ValueError(
                "no acceleration can be measured: the training trajectories together hold no free "
                "particle with three frames. Give longer trajectories or more particles."
            )
        return Statistics(
            velocity_mean=self.velocity.mean,
            velocity_std=self.velocity.std(),
            acceleration_mean=self.acceleration.mean,
            acceleration_std=self.acceleration.std(),
        )


class Moments:
    """Running count, mean and squared deviation per axis.

    Source:
        Chan, Golub and LeVeque, "Updating Formulae and a Pairwise Algorithm for Computing
        Sample Variances", 1979: exact merging without the cancellation of E[v^2] - E[v]^2.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = torch.zeros(())
        self._squares = torch.zeros(())

    def add(self, rows: Float[Tensor, "n d"]) -> None:
        """Take in some vectors."""
        if len(rows):
            mean = rows.mean(dim=0)
            self._take(len(rows), mean, (rows - mean).square().sum(dim=0))

    def merge(self, other: "Moments") -> None:
        """Take in what ``other`` has seen."""
        if other.count:
            self._take(other.count, other.mean, other._squares)

    def _take(self, count: int, mean: Tensor, squares: Tensor) -> None:
        if self.count == 0:
            self.count, self.mean, self._squares = count, mean, squares
            return
        total = self.count + count
        shift = mean - self.mean
        self._squares = self._squares + squares + shift.square() * (self.count * count / total)
        self.mean = self.mean + shift * (count / total)
        self.count = total

    def std(self) -> Float[Tensor, " d"]:
        """Population standard deviation per axis."""
        return (self._squares / self.count).sqrt()
