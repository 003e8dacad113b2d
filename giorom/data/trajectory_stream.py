"""Read a stored trajectory block by block, so that memory does not depend on its length.

``giorom.data.trajectory_file`` reads what training needs, windows and whole trajectories; this
module gives the frames of one trajectory in order, a block of about a MiB at a time. Files are
checked as there, and what is wrong is said by ``DataError``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from giorom.data.metadata import read_metadata
from giorom.data.readers.hdf5_guard import rows_of
from giorom.data.trajectory_file import (
    CHUNK_BYTES,
    SPLITS,
    no_such_trajectory,
    opened,
    split_path,
    trajectory_names,
)
from giorom.data.trajectory_group import group_header

__all__ = ["StoredTrajectory", "find_stored", "is_ours", "stored_trajectories"]


@dataclass(frozen=True, kw_only=True)
class StoredTrajectory:
    """A trajectory in a file of ours, not read yet."""

    path: Path
    """The file."""

    name: str
    """Its group in the file."""

    particle_type: Int[np.ndarray, " p"]
    """GNS particle types, int64."""

    frame_count: int
    """Number of frames."""

    frame_dt: float
    """Time between frames [s]."""

    bounds: Float[np.ndarray, "d 2"]
    """Lower and upper wall of each axis [m]."""

    attributes: dict[str, Any]
    """What made it (JSON values)."""

    def frames(self, *, stride: int = 1, count: int | None = None) -> Iterator[np.ndarray]:
        """Read the frames in order.

        Args:
            stride: Take every so manyth frame.
            count: Look only at this many of the stored frames; at all by default.

        Yields:
            Positions of one frame, float32 of shape (p, d) [m].

        Raises:
            DataError: If the file is damaged.
        """
        end = self.frame_count if count is None else min(count, self.frame_count)
        with opened(self.path) as file:
            position = file[self.name]["position"]
            size = position.dtype.itemsize * int(np.prod(position.shape[1:]))
            block = max(1, CHUNK_BYTES // size // stride) * stride
            for start in range(0, end, block):
                stop = min(start + block, end)
                if stride >= block:
                    stop = start + 1
                yield from rows_of(position, start, stop, path=self.path)[::stride]


def is_ours(path: Path) -> bool:
    """Whether a file was written by this package, or a folder holds such split files.

    Files of LagrangeBench have the same layout but number their walls otherwise. Never raises.

    Args:
        path: The file or folder.
    """
    import h5py

    if path.is_dir():
        return any(is_ours(split_path(path, split)) for split in SPLITS)
    if not path.is_file():  # the library would wait at a pipe for ever
        return False
    try:
        with h5py.File(path, "r") as file:
            return "giorom_format_version" in file.attrs
    except (OSError, KeyError, RuntimeError):
        return False


def find_stored(path: Path, *, split: str, index: int) -> StoredTrajectory:
    """Find one trajectory in a file or a data set.

    Args:
        path: A trajectory file, or the folder of a finished data set.
        split: Part of a data set: ``train``, ``valid`` or ``test``.
        index: Number of the trajectory in the file or the split.

    Raises:
        DataError: If there is no such trajectory or the file is damaged.
    """
    if path.is_dir():
        metadata, path = read_metadata(path), split_path(path, split)
    else:
        beside = path.parent / "metadata.json"
        metadata = read_metadata(path.parent) if beside.is_file() else None
    with opened(path) as file:
        names = trajectory_names(file)
        if not 0 <= index < len(names):
            raise no_such_trajectory(path, index, count=len(names))
        return _stored(file, names[index], path=path, metadata=metadata)


def stored_trajectories(folder: Path, split: str) -> list[StoredTrajectory]:
    """All trajectories of a split, not read yet.

    Args:
        folder: A finished data set.
        split: ``train``, ``valid`` or ``test``.

    Raises:
        DataError: If the data set is unfinished or the file is damaged.
    """
    metadata, path = read_metadata(folder), split_path(folder, split)
    if not path.exists():
        return []
    with opened(path) as file:
        names = trajectory_names(file)
        return [_stored(file, name, path=path, metadata=metadata) for name in names]


def _stored(
    file: Any, name: str, *, path: Path, metadata: dict[str, Any] | None
) -> StoredTrajectory:
    """Check a trajectory without reading its positions."""
    header = group_header(file, name, path=path, metadata=metadata)
    return StoredTrajectory(
        path=path,
        name=name,
        particle_type=header.particle_type,
        frame_count=int(header.position.shape[0]),
        frame_dt=header.frame_dt,
        bounds=header.bounds.astype(np.float32),
        attributes=header.attributes,
    )
