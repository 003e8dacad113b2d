"""What flows through the pipeline: full-order trajectories and sparse states.

Axis letters used in every annotation of the package:

====== =========================================
``t``  stored frames
``p``  particles of the full-order body
``q``  sampled (sparse) particles
``d``  space dimension, 2 or 3; axis 1 points up
``e``  edges of the interaction graph
``b``  scenes of a batch
====== =========================================

Positions are metres, times are seconds. Records are frozen: a stage returns a new one.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

RIGID = 0
"""Particle type of rigid obstacles (GNS convention)."""

KINEMATIC = 3
"""Particle type of prescribed particles (GNS convention): they follow the scene, not the model."""

PLASTICINE, WATER, SAND, GOOP, ELASTIC = 4, 5, 6, 7, 8
"""Particle types of the materials; 5 to 7 are the GNS ids, 4 and 8 are ours."""

PARTICLE_TYPE_COUNT = 9
"""Size of the type embedding (GNS convention)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """All particles of a body before it deforms; two bodies are equal if they are the same one."""

    position: Float[Tensor, "p d"]
    """Undeformed positions [m]."""

    particle_type: Int[Tensor, " p"]
    """GNS particle types; ``KINEMATIC`` marks what is held."""

    @property
    def kinematic(self) -> Tensor:
        """Boolean mask of the prescribed particles, shape (p)."""
        return self.particle_type == KINEMATIC


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
        for frame, position in enumerate(self.position):  # one at a time: some live on the disk
            if not bool(torch.isfinite(position).all()):
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

    @cached_property
    def body(self) -> Body:
        """The body at the first frame, which is undeformed."""
        return Body(position=self.position[0].clone(), particle_type=self.particle_type)

    def subset(self, index: Int[Tensor, " q"]) -> "Trajectory":
        """The same motion of the particles ``index`` alone."""
        return replace(
            self, position=self.position[:, index], particle_type=self.particle_type[index]
        )

    def to(self, device: torch.device | str) -> "Trajectory":
        """The same record on ``device``."""
        return replace(
            self,
            position=self.position.to(device),
            particle_type=self.particle_type.to(device),
            bounds=self.bounds.to(device),
        )


@dataclass(frozen=True, kw_only=True)
class SparseState:
    """The sampled particles of one or several scenes, with the frames a model may look back on."""

    history: Float[Tensor, "q w d"]
    """Positions at the last ``w`` frames, oldest first [m]."""

    reference: Float[Tensor, "q d"]
    """Positions in the undeformed body [m]."""

    particle_type: Int[Tensor, " q"]
    """GNS particle types."""

    batch: Int[Tensor, " q"]
    """Index of the scene each particle belongs to, ascending."""

    batch_size: int
    """Number of scenes."""

    bounds: Float[Tensor, "d 2"]
    """Lower and upper wall of the domain on each axis [m]."""

    frame_dt: float
    """Time between frames [s]."""

    weight: Float[Tensor, " q"] | None = None
    """Full-order particles each sample stands for; ``None``: unknown, all alike."""

    bodies: tuple[Body, ...] | None = None
    """The full-order body of each scene; ``None``: unknown."""

    memory: Float[Tensor, "q m"] | tuple[Tensor, ...] | None = None
    """What a time-stepper keeps of the past beside positions, a row for each sample or a table
    for each scene; ``None`` at the start."""

    @property
    def position(self) -> Tensor:
        """Positions at the current frame, shape (q, d) [m]."""
        return self.history[:, -1]

    @property
    def velocity(self) -> Tensor:
        """Backward difference of the last two frames, shape (q, d) [m/s]."""
        return (self.history[:, -1] - self.history[:, -2]) / self.frame_dt

    @property
    def kinematic(self) -> Tensor:
        """Boolean mask of the prescribed particles, shape (q)."""
        return self.particle_type == KINEMATIC

    def to(self, device: torch.device | str) -> "SparseState":
        """The same record on ``device``; bodies stay where they are, and known by identity."""

        def moved(value: Any) -> Any:
            if isinstance(value, tuple):
                return tuple(map(moved, value))
            return None if value is None else value.to(device)

        tensors = ("history", "reference", "particle_type", "batch", "bounds", "weight", "memory")
        return replace(self, **{name: moved(getattr(self, name)) for name in tensors})


def concatenate_states(states: list[SparseState]) -> SparseState:
    """Put several scenes side by side in one batch.

    Raises:
        ValueError: If the scenes disagree on frame time or walls.
    """
    first = states[0]
    for state in states[1:]:
        if state.frame_dt != first.frame_dt or not torch.equal(state.bounds, first.bounds):
            raise ValueError(
                f"scenes of one batch must share frame_dt and bounds; found frame_dt "
                f"{first.frame_dt:g} s and {state.frame_dt:g} s. Batch them separately."
            )
    offsets = [0]
    for state in states:
        offsets.append(offsets[-1] + state.batch_size)
    return replace(
        first,
        history=torch.cat([state.history for state in states]),
        reference=torch.cat([state.reference for state in states]),
        particle_type=torch.cat([state.particle_type for state in states]),
        batch=torch.cat(
            [state.batch + offset for state, offset in zip(states, offsets, strict=False)]
        ),
        batch_size=offsets[-1],
        weight=_joined([state.weight for state in states]),
        bodies=_joined([state.bodies for state in states]),
        memory=_joined([state.memory for state in states]),
    )


def _joined(parts: list[Any]) -> Any:
    """Rows below each other, or scenes behind each other, or none where a part has none."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    if isinstance(known[0], tuple):
        return tuple(entry for part in known for entry in part)
    return torch.cat(known)
