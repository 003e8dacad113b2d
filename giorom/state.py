"""What flows through the pipeline: full-order trajectories and sparse states.

Axis letters used in every annotation of the package:

====== =========================================
``t``  stored frames
``p``  particles of the full-order body
``q``  sampled (sparse) particles
``d``  space dimension, 2 or 3; axis 1 points up
``e``  edges of the interaction graph
``b``  samples of a batch
====== =========================================

Positions are metres, times are seconds. Records are frozen: a stage returns a new one.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

KINEMATIC = 3
"""Particle type of prescribed particles (GNS convention): they follow the scene, not the model."""

WATER, SAND, GOOP, ELASTIC = 5, 6, 7, 8
"""Particle types of the materials; 5 to 7 are the GNS ids, 8 is ours."""

PARTICLE_TYPE_COUNT = 9
"""Size of the type embedding (GNS convention)."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """The motion of every particle of one body, at equally spaced frames."""

    position: Float[Tensor, "t p d"]
    """Positions [m]."""

    particle_type: Int[Tensor, " p"]
    """GNS particle types; ``KINEMATIC`` marks the clamped region."""

    frame_dt: float
    """Time between frames [s]."""

    bounds: Float[Tensor, "d 2"]
    """Lower and upper wall of the domain on each axis [m]."""

    attributes: dict[str, Any] = field(default_factory=dict)
    """What made it: material, its parameters, seed, shape, initial velocity (JSON values)."""

    def __post_init__(self) -> None:
        """Reject what no stage can use."""
        if not self.frame_dt > 0.0:
            raise ValueError(f"Trajectory.frame_dt must be > 0 s, got {self.frame_dt!r}.")
        finite = torch.isfinite(self.position).flatten(1).all(dim=1)
        if not bool(finite.all()):
            frame = int((~finite).nonzero()[0])
            raise ValueError(
                f"frame {frame} of the trajectory holds a position that is not finite; every "
                f"position must be a finite number of metres. Repair or drop the trajectory."
            )

    @property
    def frame_count(self) -> int:
        """Number of stored frames."""
        return self.position.shape[0]

    @property
    def kinematic(self) -> Tensor:
        """Boolean mask of the prescribed particles, shape (p)."""
        return self.particle_type == KINEMATIC

    def subset(self, index: Int[Tensor, " q"]) -> Self:
        """The same motion of the particles ``index`` alone."""
        return replace(
            self, position=self.position[:, index], particle_type=self.particle_type[index]
        )
