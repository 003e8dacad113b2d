"""Our own data sets and trajectory files as motions that are read frame by frame.

The same record that the readers of foreign formats give, so that ``giorom inspect`` treats all
data alike.
"""

from collections.abc import Iterator
from pathlib import Path

from giorom.data.metadata import DataError, read_metadata
from giorom.data.readers.source import ForeignTrajectory
from giorom.data.trajectory_file import SPLITS, opened, split_path, trajectory_names
from giorom.data.trajectory_stream import (
    StoredTrajectory,
    find_stored,
    is_ours,
    stored_trajectories,
)

__all__ = ["is_own", "own_trajectories"]


def is_own(path: Path) -> bool:
    """Whether a folder is a finished data set of ours, or a file one of our trajectories."""
    try:
        if path.is_dir():
            read_metadata(path)
            # The metadata of an exported data set still name us; its files do not.
            return is_ours(path) and all(split_path(path, name).is_file() for name in SPLITS)
        if path.suffix != ".h5":
            return False
        with opened(path) as file:
            return "giorom_format_version" in file.attrs
    except DataError:
        return False


def own_trajectories(path: Path) -> Iterator[ForeignTrajectory]:
    """The motions of a data set folder, split after split, or of a trajectory file.

    Args:
        path: A path that ``is_own`` accepts.

    Raises:
        DataError: If a file is damaged.
    """
    if path.is_dir():
        for split in SPLITS:
            for stored in stored_trajectories(path, split):
                yield _motion(stored, split)
        return
    with opened(path) as file:
        count = len(trajectory_names(file))
    for index in range(count):
        yield _motion(find_stored(path, split="train", index=index), None)


def _motion(stored: StoredTrajectory, split: str | None) -> ForeignTrajectory:
    return ForeignTrajectory(
        name=f"{stored.path.name}[{stored.name}]",
        particle_type=stored.particle_type,
        frames=stored.frames,
        frame_count=stored.frame_count,
        split=split,
        frame_dt=stored.frame_dt,
        bounds=stored.bounds,
    )
