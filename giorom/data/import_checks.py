"""What every trajectory of an import has to be, whatever its format.

Checked before and while its frames are read: particles and types, the time between frames, axes
shared with the trajectories before, and numbers that float32 can hold.
"""

from collections.abc import Iterator

import numpy as np

from giorom.data.measure import MotionSummary
from giorom.data.metadata import DataError
from giorom.data.readers.source import MOST_PARTICLES, ForeignTrajectory
from giorom.state import PARTICLE_TYPE_COUNT

__all__ = ["check_like", "checked_frames"]


def check_like(
    motion: ForeignTrajectory, before: list[MotionSummary], *, frame_dt_needed: bool
) -> None:
    """Refuse a trajectory that cannot stand beside the others, before its frames are read.

    Args:
        motion: The trajectory, converted.
        before: Those already taken.
        frame_dt_needed: Whether the time between frames must be known and shared.

    Raises:
        DataError: Names what is wrong with particles, types or times.
    """
    kind = motion.particle_type
    if not 1 <= len(kind) <= MOST_PARTICLES:
        raise DataError(f"{motion.name} has {len(kind)} particles; it needs at least one.")
    wrong = kind[(kind < 0) | (kind >= PARTICLE_TYPE_COUNT)]
    if len(wrong):
        raise DataError(
            f"{motion.name} has a particle of type {wrong[0]}; types lie between 0 and "
            f"{PARTICLE_TYPE_COUNT - 1} (GNS convention). Set one type for all with "
            f"--particle-type."
        )
    if not frame_dt_needed:
        return
    if motion.frame_dt is None:
        raise DataError(
            f"{motion.name} does not say the time between its frames. Give it with --frame-dt "
            f"SECONDS."
        )
    if not 0.0 < motion.frame_dt < np.inf:
        raise DataError(
            f"{motion.name} says that its frames are {motion.frame_dt!r} s apart; that must be "
            f"> 0. Give the right time with --frame-dt SECONDS."
        )
    if before and motion.frame_dt != before[0].frame_dt:
        raise DataError(
            f"{motion.name} has a frame every {motion.frame_dt:g} s, {before[0].name} every "
            f"{before[0].frame_dt:g} s; the trajectories of a data set share it. Import them "
            f"apart, or set it with --frame-dt."
        )


def checked_frames(
    motion: ForeignTrajectory, before: list[MotionSummary], *, finite: bool
) -> Iterator[np.ndarray]:
    """The frames of a motion, their shapes checked and, if asked, their numbers.

    Args:
        motion: The trajectory, converted.
        before: Those already taken; all have the same axes.
        finite: Whether numbers that float32 cannot hold are refused.

    Yields:
        Positions of one frame after the other [m].

    Raises:
        DataError: Names the frame and what is wrong with it.
    """
    count = len(motion.particle_type)
    number, dimension = -1, None if not before else len(before[0].extent)
    for number, frame in enumerate(motion.frames()):
        dimension = frame.shape[1] if dimension is None else dimension
        if dimension not in (2, 3):
            raise DataError(f"{motion.name} has {dimension} axes; motions have 2 or 3.")
        if frame.shape != (count, dimension):
            raise DataError(
                f"{motion.name} has {frame.shape[0]} particles on {frame.shape[1]} axes at frame "
                f"{number}, where {count} on {dimension} are needed; particles may neither appear "
                f"nor vanish, and all trajectories need the same axes. Leave it out."
            )
        if motion.bounds is not None and len(motion.bounds) != dimension:
            raise DataError(
                f"{motion.name} has {dimension} axes, but bounds for {len(motion.bounds)}. Give "
                f"--bounds LOW HIGH for each axis."
            )
        if finite:
            _check_finite(frame, number, motion.name)
        yield frame
    if number < 0:
        raise DataError(f"{motion.name} has no frame to keep. Lower --skip or leave it out.")


def _check_finite(frame: np.ndarray, number: int, name: str) -> None:
    """Refuse numbers that float32 cannot hold."""
    sound = np.abs(frame) <= np.finfo(np.float32).max
    if not sound.all():
        particle = int((~sound.all(axis=1)).argmax())
        raise DataError(
            f"{name}: particle {particle} is at {frame[particle].tolist()} at frame {number}, "
            f"which is no place. Repair it, or leave such trajectories out with "
            f"--drop-bad-trajectories."
        )
