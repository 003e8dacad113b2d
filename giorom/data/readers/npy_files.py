"""Read NumPy arrays: a file (t, p, d) is a motion, files (p, d) are the frames of one.

The row is the particle; the last axis has two or three numbers. Headers are matched and never run,
and arrays of objects are refused, because they are pickles.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from giorom.data.readers.byte_source import FileSource
from giorom.data.readers.cloud import Cloud, check_count, cloud_of, reading
from giorom.data.readers.frame_files import is_first_file, series_of
from giorom.data.readers.lazy_array import LazyArray
from giorom.data.readers.npy_header import read_npy_header
from giorom.data.readers.sequence import FLAT_NOTE, in_plane, is_flat, sequence_trajectory
from giorom.data.readers.source import MOST_PARTICLES, DataError, ForeignTrajectory, Reader
from giorom.state import WATER

__all__ = ["NPY"]

EXTENSIONS = (".npy",)


def _array(path: Path) -> LazyArray:
    """The array of a file, unread, of a shape that positions can have."""
    with reading(path):
        array = read_npy_header(FileSource(path)).array()
    if len(array.shape) not in (2, 3) or array.shape[-1] not in (2, 3) or 0 in array.shape:
        raise DataError(
            f"{path} has the shape {array.shape}; it must be (frames, particles, 2 or 3), or "
            f"(particles, 2 or 3) in a file per frame. Reshape it."
        )
    check_count(array.shape[-2], array.byte_count, 1, path=path)
    return array


def _read_frame(path: Path) -> Cloud:
    """The points of a file of one frame."""
    array = _array(path)
    if len(array.shape) != 2:
        raise DataError(
            f"{path} holds several frames, the first file of its folder one. Put motions and "
            f"single frames into different folders."
        )
    with reading(path):
        values = array.read(most_bytes=8 * 3 * MOST_PARTICLES)
        return cloud_of(values, {}, path=path)


def _read_motion(path: Path, split: str | None) -> ForeignTrajectory:
    """The motion in a file of several frames."""
    array = _array(path)
    if len(array.shape) != 3:
        raise DataError(
            f"{path} holds one frame, the first file of its folder several. Put motions and "
            f"single frames into different folders."
        )
    flat = is_flat(next(_frames(array, path, flat=False)))
    return ForeignTrajectory(
        name=path.name,
        particle_type=np.full(array.shape[1], WATER, dtype=np.int64),
        frames=partial(_frames, array, path, flat=flat),
        frame_count=array.shape[0],
        split=split,
        notes=(FLAT_NOTE,) if flat else (),
    )


def _frames(array: LazyArray, path: Path, *, flat: bool) -> Iterator[np.ndarray]:
    """Frames of a motion, in floating point, without z if all of it is 0."""
    for index, frame in enumerate(array.frames(time_axis=0)):
        position = frame if array.is_float else frame.astype(np.float64)
        yield in_plane(position, name=f"{path}[{index}]") if flat else position


def _has_axes(file: Path) -> bool:
    """Whether an array has the shape of positions."""
    return bool(_array(file).shape)


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each file of several frames, or each series of files of one, as a motion."""
    found = False
    for series in series_of(path, EXTENSIONS):
        found = True
        if len(_array(series.files[0]).shape) == 2:
            yield sequence_trajectory(series, _read_frame)
        else:
            yield from map(partial(_read_motion, split=series.split), series.files)
    if not found:
        raise DataError(f"{path} holds no file that ends in .npy. Check the path.")


NPY = Reader(
    name="npy",
    title="NumPy arrays (frames, particles, axes), or one per frame",
    detect=lambda path: is_first_file(path, EXTENSIONS, _has_axes),
    read=_read,
)
"""Reader of NumPy's arrays."""
