"""Read points from VTKHDF files, temporal or not: our own ``.vtkhdf`` and those VTK writes.

A temporal file is one motion, its steps are the frames; files of one step each are the frames of
one motion. Points of several parts stand one after the other.

Source:
    "VTKHDF File Format", docs.vtk.org: PolyData, UnstructuredGrid and temporal data.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import Cloud, check_count, cloud_of, role_of
from giorom.data.readers.frame_files import FileSeries, even_step
from giorom.data.readers.hdf5_guard import guarded_file, member, numbers_of, rows_of
from giorom.data.readers.sequence import sequence_trajectory
from giorom.data.readers.source import DataError, ForeignTrajectory

__all__ = ["HDF_EXTENSIONS", "is_vtk_hdf", "read_vtk_hdf"]

HDF_EXTENSIONS = (".vtkhdf", ".hdf", ".hdf5", ".h5")

SIGNATURE = b"\x89HDF\r\n\x1a\n"

MOST_STEPS = 1_000_000
"""Most steps of a temporal file."""


@dataclass(frozen=True)
class Step:
    """One frame of a temporal file."""

    path: Path
    index: int

    def __str__(self) -> str:
        """Name in messages."""
        return f"{self.path}[step {self.index}]"

    @property
    def name(self) -> str:
        """Short name in messages."""
        return f"step {self.index}"


def is_vtk_hdf(path: Path) -> bool:
    """Whether a file is VTKHDF.

    Args:
        path: The file.

    Returns:
        Whether it is HDF5 with a group ``VTKHDF``.
    """
    with path.open("rb") as stream:
        if stream.read(len(SIGNATURE)) != SIGNATURE:
            return False
    with guarded_file(path) as file:
        return member(file, "VTKHDF", path=path) is not None


def read_vtk_hdf(series: FileSeries) -> Iterator[ForeignTrajectory]:
    """Read temporal files, each a motion, or files of one frame each, together a motion.

    Args:
        series: The files.

    Yields:
        The motions.

    Raises:
        DataError: If a file is damaged or holds another kind of data.
    """
    if _times(series.files[0]) is None:
        yield sequence_trajectory(series, lambda path: _read_step(path, None))
        return
    for path in series.files:
        times = _times(path)
        if times is None:
            raise DataError(
                f"{path} has no steps, but {series.files[0].name} has. Put files of one frame and "
                f"temporal files into different folders."
            )
        frame_dt, notes = even_step(times)
        steps = FileSeries(
            name=path.name,
            files=tuple(Step(path, index) for index in range(len(times))),
            split=series.split,
            notes=notes,
        )
        yield sequence_trajectory(steps, _read_frame, frame_dt=frame_dt)


def _read_frame(step: Step) -> Cloud:
    """The points of a step."""
    return _read_step(step.path, step.index)


def _root(file: Any, path: Path) -> Any:
    """The group that holds everything, of a kind that holds particles."""
    root = member(file, "VTKHDF", path=path)
    kind = None if root is None else root.attrs.get("Type")
    kind = kind.decode("latin-1") if isinstance(kind, bytes) else kind
    if kind not in ("PolyData", "UnstructuredGrid"):
        raise DataError(
            f"{path} holds a {str(kind)[:40]}; particles are read from PolyData and "
            f"UnstructuredGrid. Export the points as PolyData."
        )
    return root


def _times(path: Path) -> np.ndarray | None:
    """Times of the steps; None for a file that is not temporal."""
    with guarded_file(path) as file:
        steps = member(_root(file, path), "Steps", path=path)
        if steps is None:
            return None
        times = numbers_of(steps, "Values", path=path, dims=1)
        if times is None or len(times) > MOST_STEPS:
            raise DataError(
                f"{path} has no Steps/Values or more than {MOST_STEPS} of them. Remake the file."
            )
        return rows_of(times, 0, len(times), path=path).astype(np.float64)


def _read_step(path: Path, index: int | None) -> Cloud:
    """The points of one step, or of a file without steps."""
    with guarded_file(path) as file:
        root = _root(file, path)
        steps = None if index is None else member(root, "Steps", path=path)
        points = numbers_of(root, "Points", path=path, dims=2)
        counts = numbers_of(root, "NumberOfPoints", path=path, dims=1)
        if points is None or counts is None or points.shape[1] != 3:
            raise DataError(f"{path} has no Points of three numbers. Remake the file.")
        part, parts = 0, len(counts)
        if steps is not None:
            part = _entry(steps, "PartOffsets", index, path, default=0)
            parts = _entry(steps, "NumberOfParts", index, path, default=1)
        count = int(rows_of(counts, part, part + parts, path=path).sum())
        check_count(count, len(points), 1, path=path)
        first = 0 if steps is None else _entry(steps, "PointOffsets", index, path, default=0)
        position = rows_of(points, first, first + count, path=path)
        fields = _fields(root, steps, index, (first, count), path=path)
        return cloud_of(position, fields, path=path)


def _fields(
    root: Any, steps: Any, index: int | None, rows: tuple[int, int], *, path: Path
) -> dict[str, np.ndarray]:
    """The numbers of the points that mean something; an array of one frame's length is fixed."""
    group = member(root, "PointData", path=path)
    offsets = None if steps is None else member(steps, "PointDataOffsets", path=path)
    fields = {}
    for name in [] if group is None else list(group):
        if role_of(name) is None:
            continue
        first, count = rows
        data = numbers_of(group, name, path=path, dims=1)
        if steps is not None:
            usual = 0 if len(data) == count else first
            first = _entry(offsets, name, index, path, default=usual)
        fields[name] = rows_of(data, first, first + count, path=path)
    return fields


def _entry(group: Any, name: str, index: int | None, path: Path, *, default: int) -> int:
    """A number of a step; the default where the file does not say it."""
    data = numbers_of(group, name, path=path, dims=1)
    if data is None or index is None:
        return default
    return int(rows_of(data, index, index + 1, path=path)[0])
