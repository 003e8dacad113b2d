"""Read sequences of CSV tables, one per frame, one particle per row, as ParaView writes them.

The first line names the columns; x, y, z (or x, y) and ParaView's ``Points:0`` are known, and the
names of identities and types. A table without names has two or three columns, which are the
positions. Columns are separated by commas, semicolons, tabs or blanks.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import Cloud, check_count, cloud_of, reading, role_of, text_lines
from giorom.data.readers.frame_files import first_file
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
        names = _cells(first)
        if all(_is_number(name) for name in names):
            lines = itertools.chain([first], lines)
            names = [AXES[axis] for axis in range(len(names))] if len(names) in (2, 3) else names
        wanted = _wanted(names, path)
        blocks = list(_blocks(lines, wanted, len(names), path))
        if not blocks:
            raise DataError(f"{path} has no rows below its names. Write the frame again.")
        columns = {name: np.concatenate([block[name] for block in blocks]) for name in wanted}
        axes = sorted((name for name in columns if _axis(name) is not None), key=_axis)
        position = np.stack([columns[name] for name in axes], axis=1)
        check_count(len(position), path.stat().st_size, 2 * len(names) - 1, path=path)
        return cloud_of(position, columns, path=path)


def _cells(line: bytes) -> list[str]:
    """The cells of a row."""
    text = line.decode("utf-8-sig", errors="replace").strip()
    mark = next((mark for mark in (",", ";", "\t") if mark in text), None)
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


def _blocks(
    lines: Iterator[bytes], wanted: dict[str, int], width: int, path: Path
) -> Iterator[dict[str, np.ndarray]]:
    """The wanted columns of many rows at a time."""
    while rows := [_cells(line) for line in itertools.islice(lines, BLOCK_ROWS)]:
        uneven = next((row for row in rows if len(row) != width), None)
        if uneven is not None:
            raise DataError(
                f"{path} has a row of {len(uneven)} cells, its first has {width}. The file is "
                f"truncated or damaged; write it again."
            )
        yield {name: _numbers([row[at] for row in rows], name) for name, at in wanted.items()}


def _numbers(cells: list[str], name: str) -> np.ndarray:
    """Numbers of a column; identities and types stay whole where they are."""
    number: Any = float
    if role_of(name) is not None and all(re.fullmatch(r"[+-]?\d{1,18}", cell) for cell in cells):
        number = int
    return np.array([number(cell) for cell in cells])


def _detect(path: Path) -> bool:
    """Whether the first table below a path names x and y, or has two or three numbers a row."""
    try:
        file = first_file(path, EXTENSIONS)
        if file is None:
            return False
        with file.open("rb") as stream:
            names = _cells(next(line for line in text_lines(stream, path=file) if line.strip()))
    except (OSError, DataError, StopIteration):
        return False
    axes = {_axis(name) for name in names}
    return {0, 1} <= axes or (len(names) in (2, 3) and all(_is_number(name) for name in names))


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each series of tables as a motion."""
    yield from read_sequences(path, EXTENSIONS, read_csv_frame)


CSV = Reader(
    name="csv",
    title="CSV tables, one per frame, with columns x, y, z",
    detect=_detect,
    read=_read,
)
"""Reader of sequences of tables."""
