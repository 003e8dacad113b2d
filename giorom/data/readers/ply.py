"""Read PLY files, one per frame: ASCII and binary of either byte order.

The element ``vertex`` may stand anywhere; other elements, with lists or not, are skipped. Of
the vertex properties x, y, z (or x, y), an identity and a type are used.

Source:
    G. Turk, "The PLY Polygon File Format", 1994: header, elements, scalar and list properties.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import (
    Cloud,
    check_byte_order,
    check_count,
    cloud_of,
    reading,
    role_of,
    text_lines,
)
from giorom.data.readers.frame_files import is_first_file
from giorom.data.readers.sequence import read_sequences
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader

__all__ = ["PLY", "read_ply_frame"]

EXTENSIONS = (".ply",)

NUMBER_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
"""NumPy's letters for the types of the format, by both of their names."""

BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

HEADER_LINES = 10_000
"""Most lines of a header."""

BLOCK_LINES = 1 << 14
"""Lines of an ASCII file that are taken apart at once."""


@dataclass(frozen=True, kw_only=True)
class Property:
    """One column of an element."""

    name: str
    kind: str
    length_kind: str | None = None


@dataclass(frozen=True, kw_only=True)
class Element:
    """One table of the file."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(column.length_kind is not None for column in self.properties)

    def row(self, order: str) -> np.dtype:
        """Record of one row without lists."""
        return np.dtype([(column.name, order + column.kind) for column in self.properties])


@dataclass(frozen=True, kw_only=True)
class Header:
    """What stands before the numbers."""

    order: str
    text: bool
    elements: tuple[Element, ...]
    time: float | None


def read_ply_frame(path: Path) -> Cloud:
    """Read the points of one PLY file.

    Args:
        path: The file.

    Returns:
        The points.

    Raises:
        DataError: If the file is damaged, truncated or has no points.
    """
    with reading(path), path.open("rb") as stream:
        header = _header(stream, path)
        size = path.stat().st_size
        for element in header.elements:
            if element.name == "vertex":
                columns = _vertices(stream, element, header, path=path, size=size)
                break
            _skip(stream, element, header, path=path, size=size)
        position = np.stack([columns[axis] for axis in ("x", "y", "z") if axis in columns], axis=1)
        if not header.text:
            check_byte_order(position, path=path)
        return cloud_of(position, columns, path=path, time=header.time)


def _header(stream: Any, path: Path) -> Header:
    """Read the lines up to ``end_header``; leave the stream behind them."""
    if stream.read(3) != b"ply" or stream.readline(8).strip():
        raise DataError(f"{path} does not begin with 'ply'; it is no PLY file. Check the path.")
    encoding, time, elements = None, None, []
    for number, raw in enumerate(text_lines(stream, path=path)):
        words = raw.decode("latin-1").split()
        if words[:1] == ["end_header"] or number > HEADER_LINES:
            break
        if words[:1] == ["format"]:
            encoding = words[1] if len(words) == 3 else None
        elif words[:1] == ["element"]:
            elements.append(_element(words, path))
        elif words[:1] == ["property"]:
            if not elements:
                raise DataError(f"{path} has a property before any element. Remake the file.")
            name, count, columns = elements[-1]
            elements[-1] = (name, count, [*columns, _property(words, path)])
        elif words[:1] == ["comment"]:
            time = _time(words) if time is None else time
    else:
        raise DataError(f"{path} ends within its header. It is truncated; copy it again.")
    if encoding not in BYTE_ORDERS or words[:1] != ["end_header"]:
        raise DataError(
            f"{path} has the format {encoding!r}; it must be one of {', '.join(BYTE_ORDERS)}, and "
            f"the header must end in 'end_header'. Remake the file."
        )
    tables = tuple(
        Element(name=name, count=count, properties=tuple(columns))
        for name, count, columns in elements
    )
    _check_vertex(tables, path)
    return Header(order=BYTE_ORDERS[encoding], text=encoding == "ascii", elements=tables, time=time)


def _element(words: list[str], path: Path) -> tuple[str, int, list[Property]]:
    """An ``element NAME COUNT`` line."""
    if len(words) != 3 or not re.fullmatch(r"\d{1,18}", words[2]):
        raise DataError(
            f"{path} has the header line {' '.join(words)[:80]!r}; it must be 'element NAME "
            f"COUNT'. Remake the file."
        )
    return words[1], int(words[2]), []


def _property(words: list[str], path: Path) -> Property:
    """A ``property TYPE NAME`` or ``property list TYPE TYPE NAME`` line."""
    kinds = words[2:4] if words[1:2] == ["list"] else words[1:2]
    if len(words) != len(kinds) + (3 if len(kinds) == 2 else 2) or not all(
        kind in NUMBER_TYPES for kind in kinds
    ):
        raise DataError(
            f"{path} has the header line {' '.join(words)[:80]!r}, which is no property of a known "
            f"type. Known: {', '.join(NUMBER_TYPES)}."
        )
    length = NUMBER_TYPES[kinds[0]] if len(kinds) == 2 else None
    if length is not None and length[0] == "f":
        raise DataError(f"{path} counts list {words[-1]!r} in a floating-point type. Remake it.")
    return Property(name=words[-1], kind=NUMBER_TYPES[kinds[-1]], length_kind=length)


def _time(words: list[str]) -> float | None:
    """The time in a ``comment time 0.5 s`` line."""
    if len(words) < 3 or words[1].lower().rstrip(":=") != "time":
        return None
    try:
        return float(words[2])
    except ValueError:
        return None


def _check_vertex(elements: tuple[Element, ...], path: Path) -> None:
    """Refuse a file without readable vertices."""
    vertex = next((element for element in elements if element.name == "vertex"), None)
    names = [] if vertex is None else [column.name for column in vertex.properties]
    if vertex is None or not {"x", "y"} <= set(names):
        raise DataError(
            f"{path} has no element 'vertex' with the properties x, y and z, which are the "
            f"particles. Export it as points."
        )
    if vertex.has_lists or len(set(names)) != len(names):
        raise DataError(
            f"{path} has vertices with a list or with two properties of one name; only distinct "
            f"plain numbers are read. Export the points alone."
        )


def _vertices(
    stream: Any, element: Element, header: Header, *, path: Path, size: int
) -> dict[str, np.ndarray]:
    """The wanted columns of the vertices."""
    names = [column.name for column in element.properties]
    wanted = [name for name in names if name in ("x", "y", "z") or role_of(name)]
    room = size - stream.tell()
    if not header.text:
        row = element.row(header.order)
        check_count(element.count, room, row.itemsize, path=path)
        table = np.frombuffer(stream.read(element.count * row.itemsize), dtype=row)
        return {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in wanted}
    check_count(element.count, room + 1, 2 * len(names), path=path)
    table = _table(stream, element.count, path)
    if table.shape[1] != len(names):
        raise DataError(
            f"{path} has a vertex of {table.shape[1]} numbers; it must have {len(names)} "
            f"({', '.join(names)}). The file is damaged; remake it."
        )
    kinds = {column.name: column.kind for column in element.properties}
    return {
        name: table[:, names.index(name)].astype(kinds[name] if kinds[name][0] == "f" else "f8")
        for name in wanted
    }


def _table(stream: Any, count: int, path: Path) -> np.ndarray:
    """The numbers of the next ``count`` rows; rows of different lengths are an error.

    Whole numbers of this format have at most 32 bits, which a double holds exactly.
    """
    blocks = []
    rows = _rows(stream, count, path)
    for first in range(0, count, BLOCK_LINES):
        block = islice(rows, min(BLOCK_LINES, count - first))
        blocks.append(np.loadtxt(block, dtype=np.float64, comments=None, ndmin=2))
    return np.concatenate(blocks)


def _rows(stream: Any, count: int, path: Path) -> Iterator[str]:
    """The next ``count`` lines that are not blank."""
    lines = (line for line in text_lines(stream, path=path) if line.strip())
    for _ in range(count):
        line = next(lines, None)
        if line is None:
            raise DataError(f"{path} ends within its numbers. It is truncated; copy it again.")
        yield line.decode("latin-1")


def _skip(stream: Any, element: Element, header: Header, *, path: Path, size: int) -> None:
    """Pass over an element that stands before the vertices."""
    if element.count == 0 or not element.properties:
        return
    room = size - stream.tell()
    if header.text:
        check_count(element.count, room + 1, 2, path=path, what=f"rows of '{element.name}'")
        for _ in _rows(stream, element.count, path):
            pass
        return
    widths = [np.dtype(column.length_kind or column.kind).itemsize for column in element.properties]
    check_count(element.count, room, sum(widths), path=path, what=f"rows of '{element.name}'")
    if not element.has_lists:
        stream.seek(element.count * sum(widths), 1)
        return
    for _ in range(element.count):
        for column, width in zip(element.properties, widths, strict=True):
            passed = stream.read(width)
            if len(passed) < width:
                raise DataError(f"{path} ends within '{element.name}'. Copy it again.")
            if column.length_kind is None:
                continue
            signed = column.length_kind[0] == "i"
            order = "little" if header.order == "<" else "big"
            length = int.from_bytes(passed, order, signed=signed)
            step = length * np.dtype(column.kind).itemsize
            if not 0 <= step <= size - stream.tell():
                raise DataError(
                    f"{path} has a list of {length} items in '{element.name}', more than the file "
                    f"holds. It is damaged or of the other byte order; copy it again."
                )
            stream.seek(step, 1)


def _is_ply(file: Path) -> bool:
    """Whether a file begins like one of this format."""
    with file.open("rb") as stream:
        return re.match(rb"ply[ \t]*\r?\n", stream.read(16)) is not None


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each series of PLY files as a motion."""
    yield from read_sequences(path, EXTENSIONS, read_ply_frame)


PLY = Reader(
    name="ply",
    title="PLY files, one per frame",
    detect=lambda path: is_first_file(path, EXTENSIONS, _is_ply),
    read=_read,
)
"""Reader of folders of PLY files."""
