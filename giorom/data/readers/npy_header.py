"""The header of a ``.npy`` member: type, order and shape of an array, without ``numpy.load``.

A header is the text of a small Python dict. It is matched against the form NumPy writes, not
evaluated.
"""

import re
import struct
from dataclasses import dataclass

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource
from giorom.data.readers.lazy_array import LazyArray, Slice, c_order

__all__ = ["NpyHeader", "read_npy_header"]

MOST_HEADER_BYTES = 1 << 16

PATTERNS = {
    "descr": r"""['"]descr['"]\s*:\s*['"]([<>|=]?[A-Za-z]\d{0,3})['"]""",
    "fortran_order": r"""['"]fortran_order['"]\s*:\s*(True|False)""",
    "shape": r"""['"]shape['"]\s*:\s*\(([0-9L,\s]*)\)""",
}
"""The three entries of a header."""


@dataclass(frozen=True, slots=True)
class NpyHeader:
    """What a header says."""

    source: ByteSource
    dtype: str
    shape: tuple[int, ...]
    is_fortran: bool
    start: int
    """First byte of the content."""

    @property
    def holds_objects(self) -> bool:
        """Whether the content is a pickle."""
        return self.dtype.endswith("O")

    def array(self) -> LazyArray:
        """The array of numbers.

        Returns:
            The array.

        Raises:
            DataError: If its elements are no plain numbers or its bytes are not all there.
        """
        dtype = self.dtype if self.dtype[0] in "<>|" else "<" + self.dtype.lstrip("=")
        if not re.fullmatch(r"[<>|](f[248]|[iu][1248]|b1)", dtype):
            raise DataError(
                f"{self.source.name} holds elements of the type {self.dtype!r}; plain numbers are "
                f"read here. Store float32."
            )
        order = c_order(len(self.shape))
        length = self.source.size - self.start
        array = LazyArray(
            dtype,
            self.shape,
            order[::-1] if self.is_fortran else order,
            Slice(self.source, self.start, length),
        )
        if array.byte_count != length:
            raise DataError(
                f"{self.source.name}: an array of shape {self.shape} and type {dtype} needs "
                f"{array.byte_count} bytes, but {length} are there. It is damaged."
            )
        return array


def read_npy_header(source: ByteSource) -> NpyHeader:
    """Read the header of a ``.npy`` member.

    Args:
        source: The member.

    Returns:
        What it says.

    Raises:
        DataError: If it is damaged or of an unknown version.
    """
    start = source.read_at(0, min(12, source.size))
    if len(start) < 12 or start[:6] != b"\x93NUMPY" or start[6] not in (1, 2, 3):
        raise DataError(f"{source.name} is no .npy array of a known version. It is damaged.")
    short = start[6] == 1
    length = struct.unpack("<H" if short else "<I", start[8:10] if short else start[8:12])[0]
    begin = 10 if short else 12
    if length > MOST_HEADER_BYTES:
        raise DataError(f"{source.name} announces a header of {length} bytes. It is damaged.")
    text = source.read_at(begin, length).decode("latin-1")
    found = {key: re.search(pattern, text) for key, pattern in PATTERNS.items()}
    if not all(found.values()):
        raise DataError(f"{source.name} has a header that no plain array has: {text[:60]!r}.")
    descr, fortran, shape = (match.group(1) for match in found.values() if match)
    lengths = [part.strip(" L\n") for part in shape.split(",") if part.strip()]
    if len(lengths) > 8 or any(not re.fullmatch(r"[0-9]{1,15}", part) for part in lengths):
        raise DataError(f"{source.name} has an absurd shape ({shape[:60]!r}). It is damaged.")
    return NpyHeader(
        source, descr, tuple(map(int, lengths)), fortran == "True", begin + int(length)
    )
