"""Decode the arrays of VTK's XML files from any of the format's encodings.

An array is text, base64 in its element, or appended (raw or base64), each plain or compressed
with zlib or LZMA. A block is unpacked to the size that its header declares and no further; the
sizes of all blocks must add up to the array, and the array must be in proportion to the file.

Source:
    "VTK XML file formats", docs.vtk.org, and the layout of compressed arrays described there:
    [blocks][block size][size of the last block][packed size of each block] blocks.
"""

import binascii
import lzma
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.source import DataError

__all__ = ["COMPRESSORS", "ArrayDecoder", "DataArray", "unpacked_limit", "whole_attribute"]

NUMBER_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip

COMPRESSORS = {"": None, "vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}

UNPACKED_FLOOR, UNPACKED_RATIO = 1 << 26, 100
"""Unpacked arrays of a file may take this many bytes, or this many times its size if that is more.
Positions pack a few times over; a thousand times is a bomb."""

LZMA_MEMORY = 1 << 28
"""Most memory that unpacking LZMA may take; the strongest preset needs a quarter of it."""

APPENDED_LEAD = 4096
"""Where the underscore before appended data must stand at the latest."""


@dataclass(kw_only=True)
class DataArray:
    """A ``DataArray`` element."""

    attributes: dict[str, str]
    place: str
    pieces: list[str] = field(default_factory=list)


def unpacked_limit(size: int) -> int:
    """Most bytes that the unpacked arrays of a file may take.

    Args:
        size: Size of the file in bytes.

    Returns:
        The limit in bytes.
    """
    return max(UNPACKED_FLOOR, UNPACKED_RATIO * size)


def whole_attribute(attributes: dict[str, str], name: str, path: Path) -> int:
    """A count in an attribute."""
    text = attributes.get(name, "").strip()
    if not text.isdecimal() or len(text) > 15:
        raise DataError(f"{path} has {name}={text[:40]!r}; it must be a count. Remake the file.")
    return int(text)


class ArrayDecoder:
    """Turns the arrays of one file into numbers."""

    def __init__(
        self, stream: Any, path: Path, root: dict[str, str], appended: tuple[int, str] | None
    ) -> None:
        self.stream, self.path = stream, path
        self.size = path.stat().st_size
        self.left = unpacked_limit(self.size)
        self.order = "<" if root["byte_order"] == "LittleEndian" else ">"
        head = "u8" if root.get("header_type") == "UInt64" else "u4"
        self.head = np.dtype(self.order + head)
        self.packing = COMPRESSORS[root.get("compressor", "")]
        self.base, self.appended_base64 = 0, False
        if appended is not None:
            at, encoding = appended
            self.appended_base64 = encoding != "raw"
            stream.seek(at)
            lead = stream.read(APPENDED_LEAD)
            mark = lead.find(b"_", lead.find(b">"))
            if mark < 0:
                raise DataError(f"{self.path} has no '_' before its appended data. Remake it.")
            self.base = at + mark + 1

    def numbers(self, array: DataArray, count: int) -> np.ndarray:
        """The numbers of an array, after checking their size against the file's."""
        letters = NUMBER_TYPES.get(array.attributes.get("type", ""))
        if letters is None:
            raise DataError(
                f"{self.path} has an array of the type {array.attributes.get('type')!r}; known: "
                f"{', '.join(NUMBER_TYPES)}. Remake the file."
            )
        dtype = np.dtype(self.order + letters)
        self.left -= count * dtype.itemsize
        if self.left < 0:
            raise DataError(
                f"{self.path} announces arrays of more than {unpacked_limit(self.size)} bytes, out "
                f"of proportion to its {self.size} bytes. It is damaged; copy it again."
            )
        form = array.attributes.get("format", "ascii")
        if form == "ascii":
            return self._text(array, count, dtype)
        source = self._source(array, form)
        data = self._unpacked(source, count * dtype.itemsize)
        return np.frombuffer(data, dtype=dtype)

    def _text(self, array: DataArray, count: int, dtype: np.dtype) -> np.ndarray:
        """Numbers written as text."""
        words = "".join(array.pieces).split()
        array.pieces.clear()
        if len(words) != count:
            raise DataError(
                f"{self.path} has {len(words)} numbers in '{array.attributes.get('Name')}', where "
                f"{count} must stand. It is truncated or damaged; copy it again."
            )
        number = float if dtype.kind == "f" else int
        return np.array([number(word) for word in words], dtype=dtype)

    def _source(self, array: DataArray, form: str) -> "_Source":
        """Where the bytes of an array stand."""
        if form == "appended":
            start = self.base + whole_attribute(array.attributes, "offset", self.path)
            if not self.base or start >= self.size:
                raise DataError(f"{self.path} ends before its appended data. Copy it again.")
            return _Source(
                self.stream, start=start, end=self.size, base64=self.appended_base64, path=self.path
            )
        if form != "binary":
            raise DataError(f"{self.path} has an array in the format {form[:40]!r}. Remake it.")
        text = "".join(array.pieces)
        array.pieces.clear()
        text = "".join(text.split()).encode("ascii")
        return _Source(text, start=0, end=len(text), base64=True, path=self.path)

    def _unpacked(self, source: "_Source", size: int) -> bytes | bytearray:
        """The bytes of an array, which must be ``size`` many."""
        width = self.head.itemsize
        if self.packing is None:
            found, at = self._plain_header(source)
            if found != size:
                raise self._other_size(found, size)
            return source.read(at, size + (width if at == 0 else 0))[width if at == 0 else 0 :]
        count, full, last = (
            int(number) for number in np.frombuffer(source.read(0, 3 * width), dtype=self.head)
        )
        if count * width > source.room or count < 1:
            raise self._other_size(count * full, size)
        found = (count - 1) * full + (last or full)
        if found != size or last > full:
            raise self._other_size(found, size)
        header = np.frombuffer(source.read(0, (3 + count) * width), dtype=self.head)
        packed = [int(length) for length in header[3:]]
        data = source.read(source.length((3 + count) * width), sum(packed))
        blocks, first = bytearray(), 0
        for index, length in enumerate(packed):
            room = full if index < count - 1 or not last else last
            blocks += self._block(data[first : first + length], room)
            first += length
        return blocks

    def _plain_header(self, source: "_Source") -> tuple[int, int]:
        """Size of plain data, and where they begin; 0 if they share a base64 run with the size."""
        width = self.head.itemsize
        size = int(np.frombuffer(source.read(0, width), dtype=self.head)[0])
        if not source.base64:
            return size, width
        return size, source.length(width) if source.is_padded(width) else 0

    def _block(self, packed: bytes, size: int) -> bytes:
        """One block, unpacked to its declared size and no further."""
        if self.packing == "zlib":
            unpack = zlib.decompressobj()
        else:
            unpack = lzma.LZMADecompressor(memlimit=LZMA_MEMORY)
        block = unpack.decompress(packed, size + 1)
        if len(block) != size:
            raise self._other_size(len(block), size)
        return block

    def _other_size(self, found: int, size: int) -> DataError:
        """Error of an array or block that is shorter or longer than announced."""
        return DataError(
            f"{self.path} has an array or block of {found} bytes where {size} must stand. It is "
            f"damaged or its byte order or header type is wrong; copy it again."
        )


@dataclass(frozen=True)
class _Source:
    """A run of bytes in a file or a text, plain or as base64."""

    data: Any
    start: int = field(kw_only=True)
    end: int = field(kw_only=True)
    base64: bool = field(kw_only=True)
    path: Path = field(kw_only=True)

    @property
    def room(self) -> int:
        """Bytes from the start to the end of the source."""
        return self.end - self.start

    def length(self, size: int) -> int:
        """Bytes that ``size`` bytes take here."""
        return (size + 2) // 3 * 4 if self.base64 else size

    def is_padded(self, size: int) -> bool:
        """Whether the first ``size`` bytes are a base64 run of their own."""
        return b"=" in self._raw(0, self.length(size))

    def read(self, at: int, size: int) -> bytes:
        """Decode ``size`` bytes from a place."""
        raw = self._raw(at, self.length(size))
        data = binascii.a2b_base64(raw, strict_mode=True) if self.base64 and raw else raw
        if len(data) < size:
            raise DataError(f"{self.path} ends within an array. It is truncated; copy it again.")
        return data[:size]

    def _raw(self, at: int, length: int) -> bytes:
        """Bytes as they stand."""
        if at + length > self.room:
            raise DataError(
                f"{self.path} has an array of {length} bytes where {max(self.room - at, 0)} are "
                f"left. It is truncated or damaged; copy it again."
            )
        if isinstance(self.data, bytes):
            return self.data[self.start + at : self.start + at + length]
        self.data.seek(self.start + at)
        return self.data.read(length)
