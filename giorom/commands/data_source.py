"""What ``giorom import`` and ``giorom inspect`` share: the source, its options, its progress."""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from giorom.commands.shared import print_table, progress_bar, say
from giorom.data.conversion import UNITS, Conversion
from giorom.data.importing import Progress
from giorom.data.metadata import DataError
from giorom.data.own_dataset import is_own, own_trajectories
from giorom.data.readers import READERS, detect_format, require_place
from giorom.data.readers.source import ForeignTrajectory
from giorom.data.report import Report
from giorom.data.report_text import overview_rows, statistics_rows
from giorom.data.statistics import Statistics
from giorom.records import nearest

COUNTING_SECONDS = 2.0
"""Longest time spent on counting frames for the progress bar [s]."""

METADATA_BYTES = 1 << 20
"""Longest metadata file that is read."""

Read = Callable[[], Iterator[ForeignTrajectory]]
"""Starts to read the motions of a source."""


def add_source(parser: argparse.ArgumentParser) -> None:
    """Options that say what is read and how it is turned into metres and seconds."""
    parser.add_argument("source", type=Path, help="file or folder; its format is told from it")
    parser.add_argument("--format", metavar="NAME", help="format, where it is not recognised")
    parser.add_argument("--frame-dt", type=float, metavar="SECONDS", help="time between frames")
    parser.add_argument(
        "--bounds",
        type=float,
        nargs="+",
        metavar="LOW HIGH",
        help="walls of each axis in turn [m], as they are after the import",
    )
    parser.add_argument("--particle-type", type=int, metavar="N", help="type of every particle")
    parser.add_argument("--stride", type=int, default=1, metavar="N", help="keep every n-th frame")
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="drop the first n frames")
    unit = parser.add_mutually_exclusive_group()
    unit.add_argument("--unit", choices=tuple(UNITS), help="unit of length of the source")
    unit.add_argument("--scale", type=float, help="metres per unit of length of the source")
    parser.add_argument(
        "--axes", help="axes of the source that become ours, such as x,z,-y where z points up"
    )
    parser.add_argument("--limit", type=int, metavar="N", help="take n trajectories at most")


def chosen_conversion(arguments: argparse.Namespace) -> Conversion:
    """How the arguments turn a source into our data."""
    scale = arguments.scale
    if scale is None:
        scale = UNITS[arguments.unit or "m"]
    return Conversion(
        frame_dt=arguments.frame_dt,
        bounds=None if arguments.bounds is None else tuple(arguments.bounds),
        particle_type=arguments.particle_type,
        stride=arguments.stride,
        skip=arguments.skip,
        scale=scale,
        axes=arguments.axes,
    )


def open_source(arguments: argparse.Namespace) -> tuple[str, Read]:
    """The name of the format and a function that reads the source.

    Raises:
        DataError: If the source does not exist or nobody can read it.
    """
    path, name = arguments.source, arguments.format
    require_place(path)
    if name == "giorom" or (name is None and is_own(path)):
        return "giorom", lambda: own_trajectories(path)
    readers = {reader.name: reader for reader in READERS}
    if name is not None and name not in readers:
        raise DataError(f"there is no format {name!r}. {nearest(name, ['giorom', *readers])}")
    reader = detect_format(path) if name is None else readers[name]
    return reader.name, lambda: reader.read(path)


def file_statistics(path: Path, *, scale: float, axes: str | None) -> Statistics | None:
    """Per-frame statistics of the metadata beside a source, in metres, where they can be used.

    Args:
        path: The source.
        scale: Metres per unit of length of the source.
        axes: Changed axes, after which nothing can be compared any more.
    """
    file = (path if path.is_dir() else path.parent) / "metadata.json"
    try:
        if axes is not None or not file.is_file() or file.stat().st_size > METADATA_BYTES:
            return None
        found = Statistics.from_metadata(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    values = [getattr(found, name) for name in vars(found)]
    if not all(v.shape in ((2,), (3,)) and bool(torch.isfinite(v).all()) for v in values):
        return None
    return replace(found, **{name: getattr(found, name) * scale for name in vars(found)})


@contextmanager
def frame_progress(
    arguments: argparse.Namespace, read: Read, conversion: Conversion, *, text: str
) -> Iterator[Progress]:
    """A progress bar over frames; with time left where they can be counted quickly."""
    total = None if arguments.quiet else _count_frames(read, conversion, arguments.limit)
    with progress_bar(arguments, total=total, unit="frame", text=text) as bar:

        def progress(name: str, frames: int) -> None:
            bar.set_postfix_str(name, refresh=False)
            bar.update(frames)

        yield progress


def print_report(arguments: argparse.Namespace, report: Report, *, title: str) -> None:
    """Tables, suspicions and notes."""
    print_table(arguments, title, overview_rows(report), ("", ""))
    header, rows = statistics_rows(report)
    if rows:
        print_table(arguments, "statistics of the training part", rows, header)
    for text in report.suspicious:
        say(arguments, f"suspicious: {text}")
    for text in report.notes:
        say(arguments, f"note: {text}")


def _count_frames(read: Read, conversion: Conversion, limit: int | None) -> int | None:
    """Number of frames that will be kept, if all trajectories say theirs quickly."""
    start, total = time.perf_counter(), 0
    for number, trajectory in enumerate(read()):
        if limit is not None and number >= limit:
            break
        if trajectory.frame_count is None or time.perf_counter() - start > COUNTING_SECONDS:
            return None
        total += max(0, -(-(trajectory.frame_count - conversion.skip) // conversion.stride))
    return total


def report_files(folder: Path) -> list[str]:
    """Paths of everything in a folder of results."""
    return sorted(str(path) for path in folder.rglob("*") if path.is_file())


def json_result(report: Report, files: list[str]) -> dict[str, Any]:
    """The keys of ``giorom import --json`` and ``giorom inspect --json``."""
    return {**report.as_json(), "files": files}
