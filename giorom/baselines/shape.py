"""What the data and the features say about a network: its ends, not its insides."""

import math
from dataclasses import dataclass

from giorom.state import PARTICLE_TYPE_COUNT


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """Values that every network gets from features and data and nobody sets."""

    dimension: int
    """Space dimension, 2 or 3."""

    node_width: int
    """Channels of ``Features.node``."""

    edge_width: int
    """Channels of ``Features.edge``; the first dimension + 1 are the relative position."""

    particle_types: int = PARTICLE_TYPE_COUNT
    """Number of particle types."""

    bounds: list[list[float]]
    """Padded bounds of the training positions, low and high on each axis [m]."""

    def __post_init__(self) -> None:
        """Reject ends that nothing can be attached to."""
        if self.dimension not in (2, 3):
            raise ValueError(f"NetworkShape.dimension must be 2 or 3, got {self.dimension!r}.")
        for name in ("node_width", "particle_types"):
            if getattr(self, name) < 1:
                raise ValueError(f"NetworkShape.{name} must be >= 1, got {getattr(self, name)!r}.")
        if self.edge_width < self.dimension + 1:
            raise ValueError(
                f"NetworkShape.edge_width={self.edge_width} has no room for the relative position "
                f"and its length; it must be >= dimension + 1 = {self.dimension + 1}."
            )
        ordered = all(len(b) == 2 and -math.inf < b[0] < b[1] < math.inf for b in self.bounds)
        if len(self.bounds) != self.dimension or not ordered:
            raise ValueError(
                f"NetworkShape.bounds must be {self.dimension} pairs [low, high] in metres with "
                f"low < high, got {self.bounds!r}. Give the padded bounds of the data."
            )
