"""Read trajectories that are records of a ``.npy`` array: the pickle-free form of GNS's .npz.

``giorom export`` writes motions of one shape so (``giorom.export.gns``): an array of one axis whose
records have the fields ``positions`` (float32, frames x particles x axes) and ``particle_type``
(int64, particles). The header is matched against that form, not evaluated.
"""

import math
import re
import struct
from collections.abc import Iterator

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource
from giorom.data.readers.lazy_array import LazyArray, Slice, c_order

__all__ = ["read_records"]

MOST_HEADER_BYTES = 1 << 16

NUMBER = r"([0-9]{1,15})"

HEADER = re.compile(
    r"\{'descr': \[\('positions', '<f4', "
    rf"\({NUMBER}, {NUMBER}, {NUMBER}\)\), \('particle_type', '<i8', \({NUMBER},\)\)\], "
    rf"'fortran_order': False, 'shape': \({NUMBER},\), \}}\s*"
)


def read_records(source: ByteSource) -> Iterator[tuple[LazyArray, LazyArray]] | None:
    """Positions and particle types of every trajectory of an array of records.

    Args:
        source: The ``.npy`` member.

    Returns:
        The trajectories, unread; None if the member is another array.

    Raises:
        DataError: If the records are not all there.
    """
    start = source.read_at(0, min(10, source.size))
    if len(start) < 10 or start[:8] != b"\x93NUMPY\x01\x00":
        return None
    length = struct.unpack("<H", start[8:10])[0]
    if length > min(MOST_HEADER_BYTES, source.size - 10):
        return None
    found = HEADER.fullmatch(source.read_at(10, length).decode("latin-1"))
    if found is None:
        return None
    *shape, types, count = (int(text) for text in found.groups())
    size = 4 * math.prod(shape)
    record = size + 8 * types
    begin = 10 + length
    if shape[1] != types or record == 0 or begin + count * record != source.size:
        raise DataError(
            f"{source.name} announces {count} trajectories of shape {tuple(shape)} with {types} "
            f"particle types, which {source.size} bytes do not hold. It is damaged."
        )
    return (
        (
            LazyArray("<f4", tuple(shape), c_order(3), Slice(source, first, size)),
            LazyArray("<i8", (types,), c_order(1), Slice(source, first + size, 8 * types)),
        )
        for first in range(begin, source.size, record)
    )
