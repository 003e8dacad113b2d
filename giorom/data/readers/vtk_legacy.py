"""Parse legacy VTK files: the points, identities and types, without VTK itself.

A stranger's damaged file must not reach VTK's C++ reader, where it could end the process. Only
``POLYDATA`` and ``UNSTRUCTURED_GRID`` are read; cells and other numbers are passed over. Binary
numbers are big-endian, as the format says.

Source:
    "VTK File Formats", docs.vtk.org: simple legacy formats, versions 1.0 to 5.1.
"""

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import (
    LINE_BYTES,
    Cloud,
    check_byte_order,
    check_count,
    cloud_of,
    reading,
    role_of,
)
from giorom.data.readers.source import DataError

__all__ = ["is_legacy_vtk", "read_legacy_vtk"]

MAGIC = b"# vtk DataFile Version"

NUMBER_TYPES = {
    "bit": "bit", "char": "i1", "signed_char": "i1", "unsigned_char": "u1",
    "short": "i2", "unsigned_short": "u2", "int": "i4", "unsigned_int": "u4",
    "long": "i8", "unsigned_long": "u8", "long_long": "i8", "unsigned_long_long": "u8",
    "vtktypeint64": "i8", "vtktypeuint64": "u8", "vtkidtype": "i4",
    "float": "f4", "double": "f8",
}  # fmt: skip
"""NumPy's letters for the types of the format; a vtkIdType is written as an int."""

CELL_BLOCKS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS")

WIDTHS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1,
          "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}  # fmt: skip
"""Numbers per point or cell of the attributes that have a fixed width."""


def is_legacy_vtk(start: bytes) -> bool:
    """Whether a file that begins so is a legacy VTK file.

    Args:
        start: Its first bytes.

    Returns:
        Whether they are the format's mark.
    """
    return start.startswith(MAGIC)


def read_legacy_vtk(path: Path) -> Cloud:
    """Read the points of one legacy VTK file.

    Args:
        path: The file.

    Returns:
        The points.

    Raises:
        DataError: If the file is damaged, truncated or holds another kind of data.
    """
    with reading(path), path.open("rb") as stream:
        parser = _Parser(stream, path)
        parser.read_all()
        if parser.position is None:
            raise DataError(f"{path} holds no POINTS. Export the particles as PolyData.")
        if parser.binary:
            check_byte_order(parser.position, path=path)
        return cloud_of(parser.position, parser.fields, path=path, time=parser.time)


class _Parser:
    """Walks through the blocks of one file and keeps what is wanted."""

    def __init__(self, stream: Any, path: Path) -> None:
        self.stream, self.path = stream, path
        self.size = path.stat().st_size
        self.position: np.ndarray | None = None
        self.fields: dict[str, np.ndarray] = {}
        self.time: float | None = None
        self.owner, self.owned = "", 0
        if not is_legacy_vtk(self._line()):
            raise self._wrong("does not begin like a legacy VTK file")
        self._line()
        self.binary = self._words()[0].upper() == b"BINARY"

    def read_all(self) -> None:
        """Read block after block to the end of the file."""
        blocks = {
            "DATASET": self._check_kind,
            "POINT_DATA": partial(self._own, "POINT_DATA"),
            "CELL_DATA": partial(self._own, "CELL_DATA"),
            "POINTS": self._read_points,
            "METADATA": self._skip_metadata,
            "FIELD": self._read_fields,
            "CELL_TYPES": lambda arguments: self._numbers(self._count(arguments), "int"),
            **dict.fromkeys(CELL_BLOCKS, self._skip_cells),
        }
        while words := self._words():
            keyword = words[0].decode("latin-1").upper()
            arguments = [word.decode("latin-1") for word in words[1:]]
            if keyword in blocks:
                blocks[keyword](arguments)
            elif not self.owner or not self._attribute(keyword, arguments):
                raise self._wrong(f"has a block {keyword[:40]!r} that is not known")

    def _own(self, owner: str, arguments: list[str]) -> None:
        """A ``POINT_DATA n`` or ``CELL_DATA n`` line: whose the next numbers are."""
        self.owner, self.owned = owner, self._count(arguments)

    def _check_kind(self, arguments: list[str]) -> None:
        """Refuse grids that hold no particles."""
        kind = (arguments or ["nothing"])[0].upper()
        if kind not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise DataError(
                f"{self.path} holds a {kind[:40]}; particles are read from POLYDATA and "
                f"UNSTRUCTURED_GRID. Export the points as PolyData."
            )

    def _read_points(self, arguments: list[str]) -> None:
        """A ``POINTS n type`` block."""
        count = self._count(arguments)
        check_count(count, self.size, 3 * (1 if self.binary else 2), path=self.path)
        kind = arguments[1] if len(arguments) > 1 else ""
        self.position = self._numbers(3 * count, kind).reshape(count, 3)

    def _skip_cells(self, arguments: list[str]) -> None:
        """Cells: one block of ints, or since version 5.1 offsets and connectivity."""
        offsets, numbers = self._count(arguments), self._count(arguments[1:])
        at = self.stream.tell()
        following = self._words()
        if following[:1] != [b"OFFSETS"]:
            self.stream.seek(at)
            self._numbers(numbers, "int")
            return
        self._numbers(offsets, following[1].decode("latin-1"))
        following = self._words()
        if following[:1] != [b"CONNECTIVITY"]:
            raise self._wrong("has cells without CONNECTIVITY")
        self._numbers(numbers, following[1].decode("latin-1"))

    def _attribute(self, keyword: str, arguments: list[str]) -> bool:
        """An attribute of the points or cells; False for an unknown keyword."""
        if keyword == "LOOKUP_TABLE":
            self._numbers(
                4 * self._count(arguments[1:]), "unsigned_char" if self.binary else "float"
            )
            return True
        if keyword == "COLOR_SCALARS":
            kind = "unsigned_char" if self.binary else "float"
            self._numbers(self.owned * self._count(arguments[1:]), kind)
            return True
        if keyword == "TEXTURE_COORDINATES":
            self._numbers(self.owned * self._count(arguments[1:]), arguments[2])
            return True
        if keyword == "SCALARS":
            width = self._count(arguments[2:]) if len(arguments) > 2 else 1
            at = self.stream.tell()
            if self._words()[:1] != [b"LOOKUP_TABLE"]:
                self.stream.seek(at)
        elif keyword in WIDTHS:
            width = WIDTHS[keyword]
        else:
            return False
        name = "GlobalPointIds" if keyword == "GLOBAL_IDS" else arguments[0]
        self._keep(name, self._numbers(self.owned * width, arguments[1]), width)
        return True

    def _read_fields(self, arguments: list[str]) -> None:
        """A ``FIELD name count`` block: arrays of points, of cells, or of the whole data set."""
        for _ in range(self._count(arguments[1:])):
            words = self._words()
            while words[:1] == [b"METADATA"]:
                self._skip_metadata([])
                words = self._words()
            if len(words) != 4:
                raise self._wrong("has a FIELD array without name, width, length and type")
            name, width, length, kind = (word.decode("latin-1") for word in words)
            if kind == "string":
                self._skip_strings(self._count([width]) * self._count([length]))
                continue
            values = self._numbers(self._count([width]) * self._count([length]), kind)
            if self.owner:
                self._keep(name, values, self._count([width]))
            elif name.lower() in ("time", "timevalue") and len(values) == 1:
                self.time = float(values[0])

    def _keep(self, name: str, values: np.ndarray, width: int) -> None:
        """Keep a number per point whose name means something."""
        if self.owner == "POINT_DATA" and width == 1 and role_of(name):
            self.fields[name] = values

    def _numbers(self, count: int, kind: str) -> np.ndarray:
        """The next numbers, after comparing them with what is left of the file."""
        letters = NUMBER_TYPES.get(kind.lower())
        if letters is None:
            raise self._wrong(f"has numbers of the type {kind[:40]!r}, which is not known")
        room = self.size - self.stream.tell()
        if not self.binary:
            letters = "i8" if letters == "bit" else letters
            return self._text_numbers(count, np.dtype(letters), room)
        dtype = np.dtype("u1" if letters == "bit" else ">" + letters)
        size = (count + 7) // 8 if letters == "bit" else count * dtype.itemsize
        if size > room:
            raise self._short(size, room)
        values = np.frombuffer(self.stream.read(size), dtype=dtype)
        if letters == "bit":
            return np.unpackbits(values)[:count]
        return values

    def _text_numbers(self, count: int, dtype: np.dtype, room: int) -> np.ndarray:
        """Numbers written as text, over any number of lines."""
        if 2 * count - 1 > room:
            raise self._short(2 * count - 1, room)
        values, first, rest = np.empty(count, dtype=dtype), 0, b""
        number = float if dtype.kind == "f" else int
        while first < count:
            piece = self.stream.readline(LINE_BYTES)
            if not piece:
                raise self._short(2 * (count - first), 0)
            text = rest + piece
            words, rest = text.split(), b""
            if not text[-1:].isspace() and self.stream.tell() < self.size:
                rest = words.pop() if words else b""
                if len(rest) >= LINE_BYTES:
                    raise self._wrong("has a number of a million digits")
            if first + len(words) > count:
                raise self._wrong(f"has more numbers in a row than the {count} it announces")
            values[first : first + len(words)] = [number(word) for word in words]
            first += len(words)
        if rest:
            raise self._wrong(f"has more numbers in a row than the {count} it announces")
        return values

    def _skip_strings(self, count: int) -> None:
        """Pass over an array of strings; binary ones carry their length in two leading bits."""
        if count > self.size - self.stream.tell():
            raise self._short(count, self.size - self.stream.tell())
        for _ in range(count):
            if not self.binary:
                self._line()
                continue
            lead = self.stream.read(1)
            more = (7, 3, 1, 0)[lead[0] >> 6]
            length = int.from_bytes(bytes([lead[0] & 0x3F]) + self.stream.read(more), "big")
            room = self.size - self.stream.tell()
            if length > room:
                raise self._short(length, room)
            self.stream.seek(length, 1)

    def _skip_metadata(self, _: list[str]) -> None:
        """Pass over a block that ends in a blank line."""
        while self._line().strip():
            pass

    def _words(self) -> list[bytes]:
        """Words of the next line that is not blank; none at the end of the file."""
        while line := self.stream.readline(LINE_BYTES):
            if words := line.split():
                return words
        return []

    def _line(self) -> bytes:
        """The next line."""
        return self.stream.readline(LINE_BYTES)

    def _count(self, arguments: list[str]) -> int:
        """A number of things in a header line."""
        text = (arguments or [""])[0]
        if not re.fullmatch(r"\d{1,15}", text):
            raise self._wrong(f"has {text[:40]!r} where a number of things must stand")
        return int(text)

    def _wrong(self, what: str) -> DataError:
        """Error of a file whose words make no sense."""
        return DataError(
            f"{self.path} {what}; it is damaged or no legacy VTK file. Copy it again or write it "
            f"as .vtp."
        )

    def _short(self, size: int, room: int) -> DataError:
        """Error of a file that is too short for what it announces."""
        return DataError(
            f"{self.path} announces {size} bytes where {max(room, 0)} are left. It is truncated or "
            f"damaged; copy it again."
        )
