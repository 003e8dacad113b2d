"""Which files of a folder are the frames of one motion.

Files are sorted as people count: frame 2 before frame 10. Nothing is opened here.
"""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.natural_order import natural_key
from giorom.data.readers.source import DataError
from giorom.data.readers.split_names import SPLIT_NAMES

__all__ = ["FileSeries", "even_step", "first_file", "is_first_file", "series_of"]

FOLDER_DEPTH = 3
"""Folders of folders that are searched; deeper ones are not."""


@dataclass(frozen=True, kw_only=True)
class FileSeries:
    """The files of one motion, in order."""

    name: str
    """Name of the motion, for messages."""

    files: tuple[Any, ...]
    """One per frame: a ``Path``, or a step of a file, with a name and a text."""

    split: str | None = None
    """Part of a data set, told from the folder."""

    notes: tuple[str, ...] = ()
    """What is odd about the names."""


def first_file(path: Path, extensions: Collection[str]) -> Path | None:
    """The file by which a format is told: the path itself or the first fitting one in a folder.

    Args:
        path: A file or folder.
        extensions: Endings in lower case, with their dot.

    Returns:
        A file, or None if there is none of these endings.
    """
    for series in series_of(path, extensions):
        return series.files[0]
    return None


def is_first_file(
    path: Path, extensions: Collection[str], is_format: Callable[[Path], bool]
) -> bool:
    """Whether a file, or the first fitting one of a folder, is of a format.

    Args:
        path: A file or folder.
        extensions: Endings in lower case, with their dot.
        is_format: Tells the format from the content; may raise if it cannot be read.

    Returns:
        Whether it is; never an exception for what a file holds.
    """
    try:
        file = first_file(path, extensions)
        return file is not None and is_format(file)
    except (OSError, DataError):
        return False


def series_of(path: Path, extensions: Collection[str]) -> Iterator[FileSeries]:
    """Find the motions below a path, in natural order.

    Files of one folder belong together when their names differ in the last number alone. The
    folders in a folder are searched only where it holds no fitting file itself.

    Args:
        path: A file, or a folder of files or of such folders.
        extensions: Endings in lower case, with their dot.

    Yields:
        The files of one motion after the other.
    """
    if path.is_file():
        if path.suffix.lower() in extensions:
            yield FileSeries(name=path.name, files=(path,))
        return
    yield from _folder_series(path, path.name, extensions, split=None, depth=0)


def _folder_series(
    folder: Path, name: str, extensions: Collection[str], *, split: str | None, depth: int
) -> Iterator[FileSeries]:
    """The motions of a folder, or else of its folders."""
    entries = _entries(folder)
    groups: dict[str, list[Path]] = {}
    for entry in entries:
        if entry.suffix.lower() in extensions and entry.is_file():
            groups.setdefault(_series_key(entry), []).append(entry)
    longest = max((len(files) for files in groups.values()), default=0)
    alone = [key for key, files in groups.items() if len(files) == 1 < longest]
    for key, unsorted in groups.items():
        if key in alone:
            continue
        title = name if len(groups) - len(alone) == 1 else f"{name}/{key}"
        files = sorted(unsorted, key=lambda file: (_last_number(file), natural_key(file)))
        notes = (*_gap_note(files), *(_alone_note(groups[other][0]) for other in alone))
        yield FileSeries(name=title, files=tuple(files), split=split, notes=notes)
    if groups or depth >= FOLDER_DEPTH:
        return
    for entry in entries:
        if entry.is_dir():
            part = SPLIT_NAMES.get(entry.name.lower(), split)
            below = f"{name}/{entry.name}"
            yield from _folder_series(entry, below, extensions, split=part, depth=depth + 1)


def _entries(folder: Path) -> list[Path]:
    """What a folder holds, in natural order, without hidden files (macOS leaves ``._a.ply``)."""
    try:
        return sorted(
            (entry for entry in folder.iterdir() if not entry.name.startswith(".")),
            key=natural_key,
        )
    except OSError as error:
        raise DataError(f"{folder} cannot be listed ({error.strerror}). Check it.") from None


def _alone_note(file: Path) -> str:
    """Say that a file beside the frames is none."""
    return f"{file.name} stands alone beside the frames and is left out."


def _series_key(file: Path) -> str:
    """The name without its last number: what the files of one motion share."""
    return re.sub(r"\d+(?=\D*$)", "#", file.stem) + file.suffix.lower()


def _last_number(file: Path) -> int:
    """The last number of a name; -1 without one."""
    found = re.findall(r"\d+", file.stem)
    return int(found[-1][:18]) if found else -1


def _gap_note(files: Sequence[Path]) -> tuple[str, ...]:
    """Say where the numbers of the files jump, because a frame may be missing there."""
    numbers = np.array([_last_number(file) for file in files])
    steps = np.diff(numbers)
    if len(steps) < 2 or (steps == steps[0]).all():
        return ()
    usual = int(np.median(steps))
    at = int((steps != usual).argmax())
    return (
        f"The numbers of the files are not evenly spaced: {files[at].name} is followed by "
        f"{files[at + 1].name}, while the usual step is {usual}. Frames may be missing; they are "
        f"read as if evenly spaced.",
    )


def even_step(times: np.ndarray) -> tuple[float | None, tuple[str, ...]]:
    """Time between frames, and a note if the times are not evenly spaced.

    Args:
        times: Time of each frame [s].

    Returns:
        The step [s], None if it is not known, and the note.
    """
    if len(times) < 2:
        return None, ()
    steps = np.diff(times)
    step = float(np.median(steps))
    if not (np.isfinite(steps).all() and step > 0.0):
        return None, ("The times of the frames do not grow; the time between them is not known.",)
    if np.abs(steps - step).max() <= 0.01 * step:
        return float(np.mean(steps)), ()
    return step, (
        f"The frames are not evenly spaced in time: steps from {steps.min():g} to "
        f"{steps.max():g} s. The median {step:g} s is taken; resample to even times.",
    )
