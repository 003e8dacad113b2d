"""Motions stored as one file per frame: what must stay the same from file to file.

A format only has to turn a file into a ``Cloud``; this module turns the files of a series into a
motion whose rows are the same particles in every frame. One file is in memory at a time.

Invariants checked here, each broken one a ``DataError``: the number of points, the set of
identities, the dimension, and the topology of a mesh.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import Cloud
from giorom.data.readers.frame_files import FileSeries, series_of
from giorom.data.readers.source import DataError, ForeignTrajectory
from giorom.state import WATER

__all__ = ["FLAT_NOTE", "in_plane", "is_flat", "read_sequences", "sequence_trajectory"]

FLAT_NOTE = "z is 0 in every frame, so the motion is read as 2-D."


def read_sequences(
    path: Path,
    extensions: Collection[str],
    read_frame: Callable[[Any], Cloud],
) -> Iterator[ForeignTrajectory]:
    """Read every motion below a path.

    Args:
        path: A file, or a folder of files or of such folders.
        extensions: Endings of the format in lower case, with their dot.
        read_frame: Reads one file.

    Yields:
        One motion per series of files.

    Raises:
        DataError: If there is no such file, or a file is damaged.
    """
    found = False
    for series in series_of(path, extensions):
        found = True
        yield sequence_trajectory(series, read_frame)
    if not found:
        raise DataError(
            f"{path} holds no file that ends in {' or '.join(extensions)}. Check the path."
        )


def sequence_trajectory(
    series: FileSeries,
    read_frame: Callable[[Any], Cloud],
    *,
    frame_dt: float | None = None,
    identity_kept: bool | None = None,
) -> ForeignTrajectory:
    """Turn the files of one motion into a trajectory.

    The first, second and last file are read at once: they say the types, the dimension and the
    times.

    Args:
        series: The files.
        read_frame: Reads one of them.
        frame_dt: Time between frames where something else than the files says it [s].
        identity_kept: What the format says about the order of the points.

    Returns:
        The motion.

    Raises:
        DataError: If one of those files is damaged or does not fit the first.
    """
    first = read_frame(series.files[0])
    order = _order(first, path=series.files[0])
    start = Cloud(
        position=first.position if order is None else first.position[order],
        identity=None if order is None else first.identity[order],
        particle_type=_first_types(first, order),
        topology=first.topology,
    )
    flat = is_flat(first.position)
    notes = [*first.notes, *series.notes]
    ends = [first.time]
    for index in sorted({1, len(series.files) - 1} - {0}):
        if index < len(series.files):
            cloud = read_frame(series.files[index])
            _matched(cloud, start, path=series.files[index], first=series.files[0])
            flat = flat and is_flat(cloud.position)
            ends.append(cloud.time)
    if frame_dt is None:
        frame_dt, more = _frame_dt(ends, len(series.files))
        notes += more
    if flat:
        notes.append(FLAT_NOTE)
    if order is not None:
        notes.append("The points of each frame are put in the order of their identities.")
    known = order is not None or start.topology is not None
    return ForeignTrajectory(
        name=series.name,
        particle_type=start.particle_type,
        frames=partial(_frames, series.files, read_frame, start, flat=flat),
        frame_count=len(series.files),
        split=series.split,
        frame_dt=frame_dt,
        identity_kept=identity_kept or known or None,
        notes=tuple(notes),
    )


def _frames(
    files: Sequence[Any], read_frame: Callable[[Any], Cloud], start: Cloud, *, flat: bool
) -> Iterator[np.ndarray]:
    """Positions of each file in the first one's order of particles."""
    for file in files:
        position = _matched(read_frame(file), start, path=file, first=files[0])
        yield in_plane(position, name=str(file)) if flat else position


def in_plane(position: np.ndarray, *, name: str) -> np.ndarray:
    """Drop the z of a frame of a motion that is read as 2-D.

    Args:
        position: Positions, shape (p, 3).
        name: The frame, for the message.

    Returns:
        Positions, shape (p, 2).

    Raises:
        DataError: If a point has another z than 0.
    """
    if not is_flat(position):
        raise DataError(
            f"{name} has points off the plane z = 0, by which the motion was taken for 2-D. If it "
            f"is in space, add a constant to z in every frame."
        )
    return np.ascontiguousarray(position[:, :2])


def is_flat(position: np.ndarray) -> bool:
    """Whether points of space all lie in the plane z = 0.

    Args:
        position: Positions, shape (p, d).

    Returns:
        False for points of a plane, which have no z.
    """
    with np.errstate(invalid="ignore"):
        return position.shape[1] == 3 and not bool(position[:, 2].any())


def _first_types(first: Cloud, order: np.ndarray | None) -> np.ndarray:
    """GNS types in the order of the rows; water where the file says none."""
    if first.particle_type is None:
        return np.full(len(first.position), WATER, dtype=np.int64)
    return first.particle_type if order is None else first.particle_type[order]


def _order(cloud: Cloud, *, path: Any) -> np.ndarray | None:
    """Rows sorted by identity; None without identities."""
    if cloud.identity is None:
        return None
    order = np.argsort(cloud.identity, kind="stable")
    ranked = cloud.identity[order]
    twice = ranked[1:] == ranked[:-1]
    if twice.any():
        raise DataError(
            f"{path} has several points of identity {int(ranked[1:][twice.argmax()])}; an identity "
            f"names one particle. Renumber the points, or leave the identities out."
        )
    return order


def _matched(cloud: Cloud, start: Cloud, *, path: Any, first: Any) -> np.ndarray:
    """Positions of a frame in the order of the first one, after checking that it fits."""
    if cloud.position.shape[1] != start.position.shape[1]:
        raise DataError(
            f"{path} is {cloud.position.shape[1]}-dimensional, but {first.name} is "
            f"{start.position.shape[1]}-dimensional. The files belong to different motions."
        )
    if len(cloud.position) != len(start.position):
        raise DataError(
            f"{path} holds {len(cloud.position)} points, but {first.name} holds "
            f"{len(start.position)}; a motion needs the same particles in every frame (inlets and "
            f"outlets are not supported). Keep only the particles that are in every frame, or "
            f"resample the body by identity."
        )
    if cloud.topology != start.topology:
        raise DataError(
            f"{path} has other faces than {first.name}: the mesh was made anew, so that its "
            f"vertices are not the same material points. Export the mesh that is deformed."
        )
    order = _order(cloud, path=path)
    if (order is None) != (start.identity is None):
        raise DataError(
            f"{path} {'has no' if order is None else 'has'} identities, but {first.name} "
            f"{'has' if order is None else 'has none'}. Write them in every frame or in none."
        )
    if order is None:
        return cloud.position
    lost = cloud.identity[order] != start.identity
    if lost.any():
        raise DataError(
            f"{path} lacks the point of identity {int(start.identity[lost.argmax()])} or has one "
            f"that {first.name} lacks; a motion needs the same particles in every frame. Keep only "
            f"the particles that are in every frame."
        )
    return cloud.position[order]


def _frame_dt(times: Sequence[float | None], count: int) -> tuple[float | None, list[str]]:
    """Time between frames from the times of the first, second and last file."""
    known = [time for time in times if time is not None and np.isfinite(time)]
    if len(known) != len(times) or len(times) < 2:
        return None, []
    step, mean = known[1] - known[0], (known[-1] - known[0]) / (count - 1)
    if not (step > 0.0 and mean > 0.0):
        return None, ["The times in the files do not grow; the time between frames is not known."]
    notes = ["The time between frames is taken from the times in the files."]
    if abs(step - mean) > 0.01 * mean:
        notes.append(
            f"The frames are not evenly spaced in time: the first step is {step:g} s, the mean "
            f"{mean:g} s. The mean is taken; resample to even times."
        )
    return float(mean), notes
