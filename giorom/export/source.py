"""Open a motion to export it: from a file of ours, or from a foreign one through its reader.

Frames are read in order and one block at a time. What a foreign format does not say has to be said
by the caller (the time between frames) or is measured (the bounds).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from giorom.data.metadata import DataError
from giorom.data.readers import (
    READERS,
    ForeignTrajectory,
    Reader,
    detect_format,
    require_place,
)
from giorom.data.trajectory_file import SPLITS
from giorom.data.trajectory_stream import find_stored, is_ours
from giorom.export.writer import MotionHeader
from giorom.records import nearest

__all__ = ["MotionSource", "open_source"]


@dataclass(frozen=True, kw_only=True)
class MotionSource:
    """A motion to be read once."""

    name: str
    """Where it comes from, for messages."""

    header: MotionHeader
    """What is known before the first frame."""

    frame_count: int | None
    """Number of frames, where it is known before they are read."""

    frames: Iterator[Tensor]
    """Positions of one frame after the other, shape (p, d) [m]."""


def open_source(
    path: Path,
    *,
    split: str,
    index: int,
    stride: int = 1,
    frame_dt: float | None = None,
    format_name: str | None = None,
) -> MotionSource:
    """Open one motion of a file or folder.

    Args:
        path: A trajectory file, the folder of a data set, or a foreign file or folder.
        split: Part of a data set.
        index: Number of the trajectory.
        stride: Take every so manyth frame.
        frame_dt: Time between the stored frames [s], over what the file says.
        format_name: Name of a foreign format; told from the content by default.

    Raises:
        DataError: If there is no such motion, or the file is damaged or of no known format.
        ValueError: If the stride leaves no motion, or nobody says the time between frames.
    """
    if stride < 1:
        raise ValueError(f"the stride must be >= 1, got {stride}.")
    if frame_dt is not None and not 0.0 < frame_dt < float("inf"):
        raise ValueError(f"the time between frames must be > 0 s, got {frame_dt!r}.")
    require_place(path)
    if format_name is None and is_ours(path):
        return _ours(path, split=split, index=index, stride=stride, frame_dt=frame_dt)
    reader = detect_format(path) if format_name is None else _named(format_name)
    motion = _pick(path, reader, split=split, index=index)
    return _foreign(motion, stride=stride, frame_dt=frame_dt)


def _ours(
    path: Path, *, split: str, index: int, stride: int, frame_dt: float | None
) -> MotionSource:
    stored = find_stored(path, split=split, index=index)
    name = f"{stored.path}[{stored.name}]"
    _check_stride(stride, stored.frame_count, name)
    header = MotionHeader(
        particle_type=torch.tensor(stored.particle_type),
        frame_dt=stride * (stored.frame_dt if frame_dt is None else frame_dt),
        bounds=torch.from_numpy(stored.bounds),
        attributes=stored.attributes,
    )
    return MotionSource(
        name=name,
        header=header,
        frame_count=-(-stored.frame_count // stride),
        frames=(torch.from_numpy(frame) for frame in stored.frames(stride=stride)),
    )


def _foreign(motion: ForeignTrajectory, *, stride: int, frame_dt: float | None) -> MotionSource:
    step = motion.frame_dt if frame_dt is None else frame_dt
    if step is None:
        raise ValueError(
            f"{motion.name} does not say the time between its frames. Give it with --frame-dt."
        )
    if motion.frame_count is not None:
        _check_stride(stride, motion.frame_count, motion.name)
    bounds = _measured_bounds(motion) if motion.bounds is None else motion.bounds
    header = MotionHeader(
        particle_type=torch.tensor(motion.particle_type),
        frame_dt=stride * step,
        bounds=torch.from_numpy(bounds.astype(np.float32)),
        attributes={"source": motion.name},
    )
    count = motion.frame_count
    return MotionSource(
        name=motion.name,
        header=header,
        frame_count=None if count is None else -(-count // stride),
        frames=(
            torch.from_numpy(np.array(frame)) for frame in islice(motion.frames(), 0, None, stride)
        ),
    )


def _named(name: str) -> Reader:
    """The reader of that name."""
    readers = {reader.name: reader for reader in READERS}
    if name not in readers:
        raise DataError(f"there is no format {name!r}. {nearest(name, readers)}")
    return readers[name]


def _pick(path: Path, reader: Reader, *, split: str, index: int) -> ForeignTrajectory:
    """The trajectory of that number; in a folder, of that split where the source has splits."""
    wanted = {None, split} if path.is_dir() else {None, *SPLITS}
    counts: dict[str | None, int] = {}
    for motion in reader.read(path):
        if motion.split in wanted and sum(counts.get(name, 0) for name in wanted) == index:
            return motion
        counts[motion.split] = counts.get(motion.split, 0) + 1
    held = ", ".join(f"{count} {name or 'trajectories'}" for name, count in counts.items())
    raise DataError(
        f"{path} has no trajectory {index}{f' of {split}' if path.is_dir() else ''}; it holds "
        f"{held or 'none'}, numbered from 0. Ask for a lower number, or for another split."
    )


def _measured_bounds(motion: ForeignTrajectory) -> np.ndarray:
    """The box around all frames [m]."""
    low = high = None
    for frame in motion.frames():
        least, most = frame.min(axis=0), frame.max(axis=0)
        low = least if low is None else np.minimum(low, least)
        high = most if high is None else np.maximum(high, most)
    if low is None or high is None:
        raise DataError(f"{motion.name} has no frame; nothing can be exported.")
    return np.stack([low, high], axis=1)


def _check_stride(stride: int, frames: int, name: str) -> None:
    """Refuse a stride that leaves one frame of several."""
    if 1 < frames <= stride:
        raise ValueError(
            f"every {stride}th frame of the {frames} of {name} is the first one alone. Use a "
            f"stride below {frames}."
        )
