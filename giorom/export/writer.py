"""The contract of every writer: open it with what is known, hand it frames as they arrive.

A ``MotionHeader`` says what is known of a motion before its first frame; a ``MotionWriter`` takes
the positions of one frame after the other. A writer is opened as a context
(``giorom.export.open_writer``): when the block ends well the file is completed and put in place
under its name, when it fails nothing is left. No writer keeps more than a few frames in memory.
Positions are metres, times seconds.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from giorom.state import KINEMATIC, PARTICLE_TYPE_COUNT, Trajectory

__all__ = ["RESERVED_FIELDS", "MotionHeader", "MotionWriter", "PointWriter"]

RESERVED_FIELDS = ("x", "y", "z", "speed", "particle_type")
"""Names of numbers that the writers make themselves."""


@dataclass(frozen=True, kw_only=True)
class MotionHeader:
    """What is known of a motion before its first frame."""

    particle_type: Int[Tensor, " p"]
    """GNS particle types."""

    frame_dt: float
    """Time between frames [s]."""

    bounds: Float[Tensor, "d 2"]
    """Lower and upper wall of the domain on each axis [m]."""

    attributes: dict[str, Any] = field(default_factory=dict)
    """What made it (JSON values)."""

    fields: tuple[str, ...] = ()
    """Names of the further numbers of each particle that come with every frame."""

    def __post_init__(self) -> None:
        """Reject what no format can hold."""
        if not self.frame_dt > 0.0:
            raise ValueError(f"MotionHeader.frame_dt must be > 0 s, got {self.frame_dt!r}.")
        if len(self.particle_type) == 0:
            raise ValueError("a motion needs at least one particle, but its header names none.")
        if self.dimension not in (2, 3):
            raise ValueError(f"MotionHeader.bounds has {self.dimension} axes; it must have 2 or 3.")
        low, high = int(self.particle_type.min()), int(self.particle_type.max())
        if low < 0 or high >= PARTICLE_TYPE_COUNT:
            raise ValueError(
                f"the particle types lie between {low} and {high}, but there are only 0 to "
                f"{PARTICLE_TYPE_COUNT - 1} (GNS convention). Renumber them."
            )
        taken = sorted(set(self.fields) & set(RESERVED_FIELDS))
        if taken or len(set(self.fields)) < len(self.fields):
            raise ValueError(
                f"the field names {', '.join(self.fields)} repeat or are taken; choose others than "
                f"{', '.join(RESERVED_FIELDS)}."
            )

    @property
    def dimension(self) -> int:
        """Space dimension, 2 or 3."""
        return len(self.bounds)

    @property
    def particle_count(self) -> int:
        """Number of particles."""
        return len(self.particle_type)

    @property
    def kinematic(self) -> Bool[Tensor, " p"]:
        """Mask of the prescribed particles."""
        return self.particle_type == KINEMATIC

    @classmethod
    def of(cls, trajectory: Trajectory, *, fields: tuple[str, ...] = ()) -> "MotionHeader":
        """The header of a motion that is already known.

        Args:
            trajectory: The motion.
            fields: Names of the further numbers that will come with its frames.
        """
        return cls(
            particle_type=trajectory.particle_type,
            frame_dt=trajectory.frame_dt,
            bounds=trajectory.bounds,
            attributes=trajectory.attributes,
            fields=fields,
        )


class MotionWriter(ABC):
    """Takes the frames of one motion.

    Args:
        header: What is known before the first frame.
    """

    def __init__(self, header: MotionHeader) -> None:
        self.header = header
        self.frame_count = 0

    def append(self, position: Float[Tensor, "p d"], **fields: Tensor) -> None:
        """Add a frame.

        Args:
            position: Positions of all particles [m]; rounded to float32.
            fields: The numbers that the header announces, by name, shape (p).

        Raises:
            ValueError: If the shape is not the header's, a field is missing or unknown, or a
                position is not finite.
        """
        header = self.header
        shape = (header.particle_count, header.dimension)
        if tuple(position.shape) != shape:
            raise ValueError(
                f"frame {self.frame_count} has the shape {tuple(position.shape)}, but the motion "
                f"has {shape[0]} particles in {shape[1]} dimensions. All frames need that shape."
            )
        if set(fields) != set(header.fields):
            raise ValueError(
                f"frame {self.frame_count} brings the fields {sorted(fields)}; the header "
                f"announces {sorted(header.fields)}."
            )
        for name, values in fields.items():
            if tuple(values.shape) != shape[:1]:
                raise ValueError(
                    f"field {name!r} of frame {self.frame_count} has the shape "
                    f"{tuple(values.shape)}; it must have one number for each of the {shape[0]} "
                    f"particles."
                )
        kept = {name: _single(values) for name, values in fields.items()}
        stored = _single(position)
        if not bool(torch.isfinite(stored).all()):
            raise ValueError(
                f"frame {self.frame_count} holds a position that is not a finite float32 number of "
                f"metres. Repair or drop the trajectory."
            )
        self._append(stored, kept)
        self.frame_count += 1

    def finish(self) -> None:
        """Write what is left; called once, after the last frame.

        Raises:
            ValueError: If there was no frame.
        """
        if self.frame_count == 0:
            raise ValueError("the motion has no frame; nothing is written.")
        self._finish()

    @abstractmethod
    def _append(self, position: Tensor, fields: dict[str, Tensor]) -> None:
        """Take a checked frame in float32 on the CPU."""

    @abstractmethod
    def _finish(self) -> None:
        """Write what is left."""


class PointWriter(MotionWriter):
    """A writer of points in space that carry their speed.

    The speed of a frame is that of the step that ends at it. The first frame, which no step ends
    at, has that of the second and is therefore held back until the second arrives.
    """

    def __init__(self, header: MotionHeader) -> None:
        super().__init__(header)
        self._first: tuple[Tensor, dict[str, Tensor]] | None = None
        self._previous: Tensor | None = None

    def _append(self, position: Tensor, fields: dict[str, Tensor]) -> None:
        if self._previous is None:
            self._first = position, fields
        else:
            speed = (position - self._previous).norm(dim=1) / self.header.frame_dt
            self._put_first(speed)
            self._put(position, {"speed": speed, **fields})
        self._previous = position

    def _finish(self) -> None:
        self._put_first(torch.zeros(self.header.particle_count))
        self._complete()

    def _put_first(self, speed: Tensor) -> None:
        if self._first is not None:
            position, fields = self._first
            self._first = None
            self._put(position, {"speed": speed, **fields})

    @abstractmethod
    def _put(self, position: Tensor, numbers: dict[str, Tensor]) -> None:
        """Store a frame with its speed and fields."""

    @abstractmethod
    def _complete(self) -> None:
        """Write what is left."""


def _single(values: Tensor) -> Tensor:
    """A copy in float32 on the CPU; the caller may reuse his own array."""
    return values.detach().to("cpu", torch.float32, copy=True)
