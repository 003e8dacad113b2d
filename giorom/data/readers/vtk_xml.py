"""Parse VTK's XML files (.vtu, .vtp) and collections (.pvd) without VTK and without entities.

The arrays of points, identities and types are found here and decoded by ``vtk_arrays``. Parsing
stops where appended data begin, because raw ones are no XML.

Source:
    "VTK XML file formats", docs.vtk.org.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from giorom.data.readers.cloud import (
    Cloud,
    check_byte_order,
    check_count,
    cloud_of,
    reading,
    role_of,
)
from giorom.data.readers.source import DataError
from giorom.data.readers.vtk_arrays import COMPRESSORS, ArrayDecoder, DataArray, whole_attribute

__all__ = ["is_vtk_xml", "parse_xml", "read_vtk_xml"]

PIECE_BYTES = 1 << 16


def is_vtk_xml(start: bytes) -> bool:
    """Whether a file that begins so is one of VTK's XML files.

    Args:
        start: Its first bytes.

    Returns:
        Whether the root element is VTK's.
    """
    return start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") and b"<VTKFile" in start


def parse_xml(
    stream: Any,
    path: Path,
    *,
    start: Callable[[str, dict[str, str], int], bool],
    end: Callable[[str], None],
    text: Callable[[str], None],
) -> None:
    """Feed an XML file to three functions, piece by piece.

    Args:
        stream: The file, open for reading bytes.
        path: The file, for messages.
        start: Called with the name, attributes and byte position of an element; True stops.
        end: Called with the name of an element that ends.
        text: Called with text between.

    Raises:
        DataError: If the file has a document type or entities, which could read other files or
            grow without bound, or is no XML.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True

    parser.StartDoctypeDeclHandler = partial(_refuse, path)
    parser.EntityDeclHandler = partial(_refuse, path)
    parser.StartElementHandler = partial(_begin, parser, start)
    parser.EndElementHandler = end
    parser.CharacterDataHandler = text
    try:
        while piece := stream.read(PIECE_BYTES):
            parser.Parse(piece, False)
        parser.Parse(b"", True)
    except _Stop:
        return
    finally:
        parser.StartElementHandler = None  # a cycle would keep the whole text for a while


def _refuse(path: Path, *_: Any) -> None:
    """Handler of a document type or an entity."""
    raise DataError(f"{path} has a DOCTYPE, which VTK's files do not have. It is refused.")


def _begin(
    parser: Any,
    start: Callable[[str, dict[str, str], int], bool],
    name: str,
    attributes: dict[str, str],
) -> None:
    """Handler of the start of an element."""
    if start(name, attributes, parser.CurrentByteIndex):
        raise _Stop


class _Stop(Exception):  # noqa: N818  (no error: the wanted part of the file is read)
    """Ends parsing where the appended data begin."""


@dataclass(kw_only=True)
class _Scan:
    """What the XML of one file says."""

    path: Path
    file: dict[str, str] = field(default_factory=dict)
    parts: list[tuple[int, list[DataArray]]] = field(default_factory=list)
    loose: list[DataArray] = field(default_factory=list)
    appended: tuple[int, str] | None = None
    stack: list[str] = field(default_factory=list)
    current: DataArray | None = None

    def start(self, name: str, attributes: dict[str, str], at: int) -> bool:
        """An element begins; True where the appended data do."""
        if not self.stack:
            self.file = attributes
            _check_file(name, attributes, self.path)
        place = self.stack[-1] if self.stack else ""
        self.stack.append(name)
        if name == "AppendedData":
            self.appended = (at, attributes.get("encoding", "base64"))
            return True
        if name == "Piece":
            self.parts.append((whole_attribute(attributes, "NumberOfPoints", self.path), []))
        elif name == "DataArray" and _is_wanted(place, attributes):
            self.current = DataArray(attributes=attributes, place=place)
            arrays = self.parts[-1][1] if self.parts and place != "FieldData" else self.loose
            arrays.append(self.current)
        return False

    def end(self, name: str) -> None:
        """An element ends."""
        self.stack.pop()
        if name == "DataArray":
            self.current = None

    def text(self, text: str) -> None:
        """Text of an element, kept where it belongs to a wanted array itself."""
        if self.current is not None and self.stack[-1] == "DataArray":
            self.current.pieces.append(text)


def read_vtk_xml(path: Path) -> Cloud:
    """Read the points of one .vtu or .vtp file, of all its pieces one after the other.

    Args:
        path: The file.

    Returns:
        The points.

    Raises:
        DataError: If the file is damaged, truncated, packed in an unknown way or holds another
            kind of data.
    """
    with reading(path), path.open("rb") as stream:
        scan = _Scan(path=path)
        parse_xml(stream, path, start=scan.start, end=scan.end, text=scan.text)
        decoder = ArrayDecoder(stream, path, scan.file, scan.appended)
        check_count(sum(count for count, _ in scan.parts), path.stat().st_size, 0, path=path)
        positions, fields = [], []
        for count, arrays in scan.parts:
            if count:
                position, numbers = _piece(decoder, count, arrays)
                positions.append(position)
                fields.append(numbers)
        common = set(fields[0]).intersection(*fields)
        joined = {name: np.concatenate([part[name] for part in fields]) for name in common}
        return cloud_of(np.concatenate(positions), joined, path=path, time=_time(decoder, scan))


def _piece(
    decoder: ArrayDecoder, count: int, arrays: list[DataArray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points and wanted numbers of one piece."""
    points = [array for array in arrays if array.place == "Points"]
    if len(points) != 1:
        raise DataError(
            f"{decoder.path} has a piece of {count} points with {len(points)} arrays of points; it "
            f"must have one. Remake the file."
        )
    position = decoder.numbers(points[0], 3 * count).reshape(count, 3)
    if points[0].attributes.get("format") != "ascii":
        check_byte_order(position, path=decoder.path)
    numbers = {
        array.attributes["Name"]: decoder.numbers(array, count)
        for array in arrays
        if array.place == "PointData"
    }
    return position, numbers


def _time(decoder: ArrayDecoder, scan: _Scan) -> float | None:
    """The number that VTK's writers leave for the time."""
    for array in scan.loose:
        return float(decoder.numbers(array, 1)[0])
    return None


def _check_file(name: str, attributes: dict[str, str], path: Path) -> None:
    """Refuse other kinds of file by the root element."""
    kind = attributes.get("type", "nothing")
    if name != "VTKFile" or kind not in ("PolyData", "UnstructuredGrid"):
        raise DataError(
            f"{path} holds a {kind[:40]}; particles are read from PolyData (.vtp) and "
            f"UnstructuredGrid (.vtu). Export the points as PolyData."
        )
    compressor = attributes.get("compressor", "")
    if compressor not in COMPRESSORS:
        raise DataError(
            f"{path} is packed with {compressor[:60]}, which is not read. Write it with the zlib "
            f"or LZMA compressor, or unpacked."
        )
    if attributes.get("byte_order") not in ("LittleEndian", "BigEndian") or attributes.get(
        "header_type", "UInt32"
    ) not in ("UInt32", "UInt64"):
        raise DataError(
            f"{path} has byte_order {attributes.get('byte_order')!r} and header_type "
            f"{attributes.get('header_type')!r}; they must be LittleEndian or BigEndian, and "
            f"UInt32 or UInt64. Remake the file."
        )


def _is_wanted(place: str, attributes: dict[str, str]) -> bool:
    """Whether an array holds points, identities, types or the time."""
    name = attributes.get("Name", "")
    if place == "PointData":
        width = attributes.get("NumberOfComponents", "1")
        return width in ("", "0", "1") and role_of(name) is not None
    if place == "FieldData":
        return name == "TimeValue" and attributes.get("NumberOfTuples", "1") == "1"
    return place == "Points" and attributes.get("NumberOfComponents", "3") == "3"
