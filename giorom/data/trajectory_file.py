"""Read and write trajectories: one HDF5 file, or a data set folder.

The file layout is LagrangeBench's: groups ``00000``, ``00001``, ... each with ``position``
(float32, frames x particles x dim, gzip with shuffle) and ``particle_type`` (int32). The
attributes ``frame_dt`` [s], ``bounds`` [m] and ``attributes`` (JSON: material, parameters,
seed, shape ...) of a group are ours; other loaders ignore them. A *data set* is a folder with
``train.h5``, ``valid.h5``, ``test.h5`` and a ``metadata.json`` that GNS and LagrangeBench
loaders understand. The metadata file is written last: a folder without it is unfinished.

Everything read is checked. What is wrong is said in one line by ``DataError``; an exception
of the HDF5 library never leaves this module. Positions are metres and are stored in float32.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from giorom.data.atomic import disk_is_full, replacing
from giorom.data.hdf5_output import hdf5_output
from giorom.data.metadata import FORMAT_VERSION, DataError, read_metadata
from giorom.data.trajectory_group import group_header
from giorom.state import Trajectory

__all__ = [
    "FORMAT_VERSION",
    "SPLITS",
    "DataError",
    "iterate_trajectories",
    "no_such_trajectory",
    "read_metadata",
    "read_trajectory",
    "read_trajectory_file",
    "trajectory_count",
    "write_trajectory_file",
]

SPLITS = ("train", "valid", "test")
"""Names of the parts of a data set, in the order in which they are made."""

CHUNK_BYTES = 1 << 20
"""Aimed size of a compressed block: small enough that a window reads little else."""

ATTRIBUTE_BYTES = 60_000
"""Most bytes of JSON per trajectory; HDF5 stores an attribute in one 64 KiB header."""


def write_trajectory_file(trajectory: Trajectory, path: Path) -> None:
    """Write one trajectory to its own file, atomically.

    Args:
        trajectory: What to store; positions are rounded to float32.
        path: File to create or replace.

    Raises:
        DataError: If the attributes are not JSON.
    """
    with replacing(path) as temporary, new_trajectory_file(temporary) as file:
        _write_group(file, "00000", trajectory)


def read_trajectory_file(path: Path) -> Trajectory:
    """Read the only trajectory of a file made by ``write_trajectory_file``.

    Args:
        path: The file.

    Returns:
        The trajectory, positions in float32.

    Raises:
        DataError: If the file is missing, damaged, foreign or holds several trajectories.
    """
    with opened(path) as file:
        names = trajectory_names(file)
        if names != ["00000"]:
            raise DataError(
                f"{path} holds {len(names)} trajectories, but one is needed here. "
                f"Choose one with read_trajectory(folder, split, index)."
            )
        return _read_group(file, "00000", path=path, metadata=None, frames=slice(None))


def read_trajectory(
    folder: Path, split: str, index: int, *, frames: slice = slice(None)
) -> Trajectory:
    """Read one trajectory of a data set.

    Args:
        folder: A finished data set.
        split: ``train``, ``valid`` or ``test``.
        index: Number of the trajectory within the split.
        frames: Which frames; all by default. The step must be one.

    Returns:
        The trajectory, positions in float32.

    Raises:
        DataError: If the data set is unfinished or damaged, or has no such trajectory.
    """
    metadata = read_metadata(folder)
    path = split_path(folder, split)
    with opened(path) as file:
        count = len(trajectory_names(file))
        if not 0 <= index < count:
            raise no_such_trajectory(path, index, count=count)
        return _read_group(file, f"{index:05d}", path=path, metadata=metadata, frames=frames)


def no_such_trajectory(path: Path, index: int, *, count: int) -> DataError:
    """The error that a file of ``count`` trajectories has none of that number."""
    remedy = f"Ask for a number below {count}." if count else "Take another part: --split train."
    return DataError(
        f"{path} has no trajectory {index}; it holds {count}, numbered from 0. {remedy}"
    )


def iterate_trajectories(folder: Path, split: str) -> Iterator[Trajectory]:
    """Read the trajectories of a split one after the other, holding one in memory.

    Args:
        folder: A finished data set.
        split: ``train``, ``valid`` or ``test``.

    Yields:
        Each trajectory, in the order of the file.

    Raises:
        DataError: As ``read_trajectory``.
    """
    for index in range(trajectory_count(folder, split)):
        yield read_trajectory(folder, split, index)


def trajectory_count(folder: Path, split: str) -> int:
    """Count the trajectories of a split without reading them.

    Args:
        folder: A finished data set.
        split: ``train``, ``valid`` or ``test``.

    Returns:
        The number of trajectories.

    Raises:
        DataError: If the data set is unfinished or the split's file is damaged.
    """
    read_metadata(folder)
    with opened(split_path(folder, split)) as file:
        return len(trajectory_names(file))


def split_path(folder: Path, split: str) -> Path:
    """Path of a split's file.

    Args:
        folder: The data set.
        split: ``train``, ``valid`` or ``test``.

    Returns:
        The path, whether or not the file exists.

    Raises:
        DataError: If there is no such split.
    """
    if split not in SPLITS:
        raise DataError(f"there is no split {split!r}; choose one of {', '.join(SPLITS)}.")
    return folder / f"{split}.h5"


@contextmanager
def new_trajectory_file(path: Path) -> Iterator[Any]:
    """Give an empty HDF5 file that is marked complete when the block ends well.

    Args:
        path: File to create; use a temporary name (``giorom.data.atomic.replacing``).

    Yields:
        The open ``h5py.File``.
    """
    with hdf5_output(path) as file:
        file.attrs["giorom_format_version"] = FORMAT_VERSION
        yield file
        file.flush()
        file.attrs["complete"] = True


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a trajectory file for reading, turning the library's exceptions into ``DataError``.

    Args:
        path: The file.

    Yields:
        The open ``h5py.File``.

    Raises:
        DataError: If the file is missing, truncated, not HDF5 or was never finished.
    """
    import h5py

    if not path.is_file():
        raise DataError(f"{path} does not exist. Check the path or make the data again.")
    try:
        with h5py.File(path, "r") as file:
            _check_header(file, path)
            yield file
    except DataError:
        raise
    except (OSError, KeyError, RuntimeError) as error:
        if disk_is_full(error):  # of the file that is being written meanwhile
            raise
        raise DataError(
            f"{path} is truncated, damaged or no HDF5 file ({_one_line(error)}). "
            f"Copy it again or remake it."
        ) from None


def _check_header(file: Any, path: Path) -> None:
    """Reject files of a later format and files whose writer did not finish."""
    version = file.attrs.get("giorom_format_version")
    if version is None:
        return
    if not isinstance(version, int | np.integer) or version > FORMAT_VERSION:
        raise DataError(
            f"{path} has format version {str(version)[:40]}, this program reads up to "
            f"{FORMAT_VERSION}. Install a newer giorom."
        )
    if not bool(file.attrs.get("complete", False)):
        raise DataError(f"{path} was not written to its end. Remove it and make it again.")


def trajectory_names(file: Any) -> list[str]:
    """Names of the trajectories, checked to be 00000, 00001, ...; a split of ours may be empty."""
    names = sorted(file.keys())
    expected = [f"{index:05d}" for index in range(len(names))]
    ours = "giorom_format_version" in file.attrs
    if names != expected or (not names and not ours):
        raise DataError(
            f"{file.filename} must hold groups 00000, 00001, ... without a gap, but its entries "
            f"are {', '.join(names[:5]) or 'none'}. It is no trajectory file or a damaged one."
        )
    return names


def _write_group(file: Any, name: str, trajectory: Trajectory) -> None:
    """Store one trajectory in an open file."""
    position = trajectory.position.detach().cpu().numpy().astype(np.float32)
    frames_per_chunk = max(1, CHUNK_BYTES // max(1, position[0].nbytes))
    group = file.create_group(name)
    group.create_dataset(
        "position",
        data=position,
        chunks=(min(frames_per_chunk, len(position)), *position.shape[1:]),
        compression="gzip",
        compression_opts=4,
        shuffle=True,
    )
    group["particle_type"] = trajectory.particle_type.cpu().numpy().astype(np.int32)
    group.attrs["frame_dt"] = trajectory.frame_dt
    group.attrs["bounds"] = trajectory.bounds.detach().cpu().numpy()
    group.attrs["attributes"] = attributes_text(trajectory.attributes)


def attributes_text(attributes: dict[str, Any]) -> str:
    """The free attributes of a trajectory as JSON.

    Args:
        attributes: JSON values.

    Raises:
        DataError: If they are no JSON, or too large for an HDF5 attribute.
    """
    try:
        text = json.dumps(attributes, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"Trajectory.attributes must hold JSON values with finite numbers, but {error}."
        ) from None
    if len(text.encode()) > ATTRIBUTE_BYTES:
        raise DataError(
            f"Trajectory.attributes takes {len(text.encode())} bytes as JSON, more than "
            f"{ATTRIBUTE_BYTES}. Keep large arrays out of it."
        )
    return text


def _read_group(
    file: Any, name: str, *, path: Path, metadata: dict[str, Any] | None, frames: slice
) -> Trajectory:
    """Read and check one trajectory of an open file."""
    header = group_header(file, name, path=path, metadata=metadata)
    try:
        return Trajectory(
            position=torch.from_numpy(header.position[frames]),
            particle_type=torch.from_numpy(header.particle_type),
            frame_dt=header.frame_dt,
            bounds=torch.from_numpy(header.bounds.astype(np.float32)),
            attributes=header.attributes,
        )
    except ValueError as error:
        raise DataError(f"{path}[{name}]: {error}") from None


def _one_line(error: Exception) -> str:
    """The first line of a library's message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
