"""Read sequences of CSV tables, one per frame, one particle per row, as ParaView writes them.

The first line names the columns; x, y, z (or x, y) and ParaView's ``Points:0`` are known, and the
names of identities and types. A table without names has two or three columns, which are the
positions. Columns are separated by commas, semicolons, tabs or blanks.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from giorom.data.readers.cloud import Cloud, check_count, cloud_of, reading, role_of, text_lines
from giorom.data.readers.frame_files import is_first_file
from giorom.data.readers.sequence import read_sequences
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader

__all__ = ["CSV", "read_csv_frame"]

EXTENSIONS = (".csv",)

AXES = "xyz"

AXIS_NAMES = {
    f"{prefix}{name}": axis
    for axis, letter in enumerate(AXES)
    for prefix, name in (
        ("", letter),
        ("position_", letter),
        ("pos_", letter),
        ("points:", axis),
        ("points_", axis),
        ("position:", axis),
        ("coordinates:", axis),
    )
}
"""Axis of a column, by its name in lower case."""

BLOCK_ROWS = 1 << 14
"""Rows that are taken apart at once."""

MOST_COLUMNS = 10_000


def read_csv_frame(path: Path) -> Cloud:
    """Read the points of one table.

    Args:
        path: The file.

    Returns:
        The points.

    Raises:
        DataError: If no column is x and y, a row has another length, or a word is no number.
    """
    with reading(path), path.open("rb") as stream:
        lines = (line for line in text_lines(stream, path=path) if line.strip())
        first = next(lines, None)
        if first is None:
            raise DataError(f"{path} is empty. Remove it, or write the frame again.")
        mark = _separator(first)
        names = _cells(first, mark)
        if all(_is_number(name) for name in names):
            lines = itertools.chain([first], lines)
            names = [AXES[axis] for axis in range(len(names))] if len(names) in (2, 3) else names
        wanted = _wanted(names, path)
        table = _table(lines, list(wanted.values()), mark)
        if not len(table):
            raise DataError(f"{path} has no rows below its names. Write the frame again.")
        check_count(len(table), path.stat().st_size, 2 * len(names) - 1, path=path)
        columns = {name: table[:, index] for index, name in enumerate(wanted)}
        axes = sorted((name for name in columns if _axis(name) is not None), key=_axis)
        position = np.stack([columns[name] for name in axes], axis=1)
        return cloud_of(position, columns, path=path)


def _separator(line: bytes) -> str | None:
    """What stands between the cells of a row; None for blanks."""
    return next((mark for mark in (",", ";", "\t") if mark.encode() in line), None)


def _cells(line: bytes, mark: str | None) -> list[str]:
    """The cells of a row."""
    text = line.decode("utf-8-sig", errors="replace").strip()
    return [cell.strip().strip('"').strip() for cell in text.split(mark)]


def _is_number(cell: str) -> bool:
    """Whether a cell holds a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _axis(name: str) -> int | None:
    """Axis of a column; a unit in brackets does not count."""
    return AXIS_NAMES.get(re.sub(r"\s*[\[(][^\])]*[\])]$", "", name).strip().lower())


def _wanted(names: list[str], path: Path) -> dict[str, int]:
    """Columns that are read, by name, and where they stand."""
    wanted = {
        name: index
        for index, name in enumerate(names)
        if _axis(name) is not None or role_of(name) is not None
    }
    axes = sorted(axis for name in names if (axis := _axis(name)) is not None)
    if axes not in ([0, 1], [0, 1, 2]) or len(names) > MOST_COLUMNS:
        raise DataError(
            f"{path} has the columns {', '.join(names)[:120]!r}; one x, one y and at most one z "
            f"must be among them. Name them x, y, z in the first line."
        )
    return wanted


def _table(lines: Iterator[bytes], columns: list[int], mark: str | None) -> np.ndarray:
    """The numbers of some columns, many rows at a time."""
    rows = (line.decode("utf-8-sig", errors="replace") for line in lines)
    options = {"delimiter": mark, "usecols": columns, "comments": None, "quotechar": '"'}
    blocks = []
    for first in rows:
        block = itertools.chain([first], itertools.islice(rows, BLOCK_ROWS - 1))
        blocks.append(np.loadtxt(block, dtype=np.float64, ndmin=2, **options))
    return np.concatenate(blocks) if blocks else np.empty((0, len(columns)))


def _is_table(file: Path) -> bool:
    """Whether a table names x and y, or has two or three numbers a row."""
    with file.open("rb") as stream:
        first = next((line for line in text_lines(stream, path=file) if line.strip()), None)
    if first is None:
        return False
    names = _cells(first, _separator(first))
    axes = {_axis(name) for name in names}
    return {0, 1} <= axes or (len(names) in (2, 3) and all(_is_number(name) for name in names))


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each series of tables as a motion."""
    yield from read_sequences(path, EXTENSIONS, read_csv_frame)


CSV = Reader(
    name="csv",
    title="CSV tables, one per frame, with columns x, y, z",
    detect=lambda path: is_first_file(path, EXTENSIONS, _is_table),
    read=_read,
)
"""Reader of sequences of tables."""
