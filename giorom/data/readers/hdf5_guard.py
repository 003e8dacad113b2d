"""Open HDF5 files of strangers: only plain arrays of numbers that lie in the file itself.

The HDF5 library follows links into other files, maps virtual arrays, reads raw external files and
loads filters by name; a stranger's file gets none of this. Types, shapes and sizes are compared
with the size of the file before anything is read, and packed blocks are unpacked once by zlib with
a limit before the library may unpack them without one. Whatever the library raises becomes a
``DataError``.
"""

import itertools
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.source import DataError
from giorom.data.readers.vtk_arrays import unpacked_limit

__all__ = ["check_storage", "guarded_file", "member", "numbers_of", "rows_of"]

DEFLATE, SHUFFLE, FLETCHER, LZF = 1, 2, 3, 32000

PIPELINES = {
    (),
    (SHUFFLE,),
    (DEFLATE,),
    (LZF,),
    (FLETCHER,),
    (SHUFFLE, DEFLATE),
    (SHUFFLE, LZF),
    (SHUFFLE, FLETCHER),
    (DEFLATE, FLETCHER),
    (LZF, FLETCHER),
    (SHUFFLE, DEFLATE, FLETCHER),
    (SHUFFLE, LZF, FLETCHER),
}
"""Filters that are read, in the order in which they are applied: those that h5py has itself."""

MOST_BLOCKS = 200_000
"""Most blocks that one reading may touch."""


@contextmanager
def guarded_file(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading and turn what the library raises into ``DataError``.

    Args:
        path: The file.

    Yields:
        The open ``h5py.File``.

    Raises:
        DataError: If the file is missing, damaged or no HDF5 file.
    """
    import h5py

    if not path.is_file():
        raise DataError(f"{path} is no file. Check the path.")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except DataError:
        raise
    except Exception as error:  # the library raises nearly every kind for a damaged file
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"{path} is truncated, damaged or no HDF5 file ({reason[:200]}). Copy it again or "
            f"remake it."
        ) from None


def member(group: Any, name: str, *, path: Path) -> Any | None:
    """What a group holds under a name, if it lies in the file itself.

    Args:
        group: An open group.
        name: A single name.
        path: The file, for the message.

    Returns:
        The group or array, or None if there is none of this name.

    Raises:
        DataError: If the name is a link to another place or file.
    """
    import h5py

    if not isinstance(group, h5py.Group) or name not in group.keys():
        return None
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise DataError(
            f"{path} has '{name}' as a link to another place or file, which is not followed. Copy "
            f"the data into one file (h5repack or h5copy)."
        )
    return group[name]


def numbers_of(group: Any, name: str, *, path: Path, dims: int) -> Any | None:
    """An array of numbers, unread, after checking that reading it is harmless.

    Args:
        group: An open group.
        name: Name of the array.
        path: The file, for messages.
        dims: Number of axes it must have.

    Returns:
        The ``h5py.Dataset``, or None if there is nothing of this name.

    Raises:
        DataError: If it is something else, lies elsewhere, is packed in an unknown way or is out
            of proportion to the file.
    """
    import h5py

    data = member(group, name, path=path)
    if data is None:
        return None
    if not isinstance(data, h5py.Dataset) or data.shape is None or data.dtype.kind not in "fiu":
        raise DataError(f"{path}: '{name}' is no array of numbers. Remake the file.")
    if len(data.shape) != dims or data.dtype.itemsize > 8 or 0 in data.shape:
        raise DataError(
            f"{path}: '{name}' is {data.dtype} of shape {data.shape}; it must have {dims} axes, "
            f"numbers of at most 8 bytes, and not be empty. Remake the file."
        )
    check_storage(data, path=path, limit=unpacked_limit(path.stat().st_size))
    return data


def check_storage(data: Any, *, path: Path, limit: int) -> None:
    """Refuse an array that lies elsewhere, is packed in an unknown way, or is too large.

    Args:
        data: An ``h5py.Dataset`` of numbers.
        path: The file, for messages.
        limit: Most bytes that the array and each of its blocks may announce.

    Raises:
        DataError: If reading it could do harm.
    """
    if data.is_virtual or data.external:
        raise DataError(
            f"{path}: '{data.name}' lies in other files, which are not read. Copy the data into "
            f"one file (h5repack)."
        )
    if _filters(data) not in PIPELINES:
        raise DataError(
            f"{path}: '{data.name}' is packed with the HDF5 filters {list(_filters(data))}; read "
            f"are gzip, lzf, shuffle and fletcher32. Repack it (h5repack -f GZIP=4)."
        )
    block = math.prod(data.chunks or (1,)) * data.dtype.itemsize
    size = math.prod(data.shape) * data.dtype.itemsize
    if max(block, size) > limit:
        raise DataError(
            f"{path}: '{data.name}' announces {max(block, size)} bytes, out of proportion to a "
            f"file of {path.stat().st_size} bytes. It is damaged; copy it again."
        )


def rows_of(data: Any, first: int, last: int, *, path: Path) -> np.ndarray:
    """Read some rows of an array that ``numbers_of`` gave.

    Args:
        data: The array.
        first: First row.
        last: Row after the last.
        path: The file, for messages.

    Returns:
        The numbers in the machine's byte order.

    Raises:
        DataError: If the array has no such rows, or a packed block unpacks to another size.
    """
    if not 0 <= first <= last <= data.shape[0]:
        raise DataError(
            f"{path}: '{data.name}' has {data.shape[0]} rows, but rows {first} to {last} are asked "
            f"for by the file. It is truncated or damaged; copy it again."
        )
    if DEFLATE in _filters(data):
        _check_blocks(data, first, last, path=path)
    values = data[first:last]
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _filters(data: Any) -> tuple[int, ...]:
    """Codes of the filters of an array, in the order in which they are applied."""
    plan = data.id.get_create_plist()
    return tuple(int(plan.get_filter(index)[0]) for index in range(plan.get_nfilters()))


def _check_blocks(data: Any, first: int, last: int, *, path: Path) -> None:
    """Unpack the blocks of some rows with a limit; each must have its declared size."""
    size = math.prod(data.chunks) * data.dtype.itemsize
    axes = [range(first - first % data.chunks[0], last, data.chunks[0])]
    pairs = zip(data.shape[1:], data.chunks[1:], strict=True)
    axes += [range(0, length, step) for length, step in pairs]
    if math.prod(len(axis) for axis in axes) > MOST_BLOCKS:
        raise DataError(
            f"{path}: '{data.name}' is cut into more than {MOST_BLOCKS} blocks. Repack it with "
            f"larger ones (h5repack -l CHUNK=...)."
        )
    skipped = 1 << _filters(data).index(DEFLATE)
    for place in itertools.product(*axes):
        if data.id.get_chunk_info_by_coord(place).byte_offset is None:
            continue
        mask, packed = data.id.read_direct_chunk(place)
        if mask & skipped:
            continue
        found = len(zlib.decompressobj().decompress(packed, size + 1))
        if found != size:
            raise DataError(
                f"{path}: a block of '{data.name}' unpacks to {'more' if found > size else found} "
                f"instead of {size} bytes. It is damaged; copy it again."
            )
