"""``giorom export``: a motion, or a whole data set, for another program."""

import argparse
import time
from pathlib import Path
from typing import Any

from giorom.commands.shared import check_output, progress_bar, say
from giorom.data.trajectory_file import SPLITS
from giorom.export import EXTENSIONS, check_room, open_writer, written_path
from giorom.export.dataset import LAYOUTS, export_dataset
from giorom.export.source import open_source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("source", type=Path, metavar="FILE", help="trajectory file or data set")
    parser.add_argument(
        "out", type=Path, metavar="OUT", help=f"file to write: {', '.join(EXTENSIONS)}"
    )
    parser.add_argument("--trajectory", type=int, help="its number; by default 0")
    parser.add_argument("--split", choices=SPLITS, help="part of a data set; by default test")
    parser.add_argument("--stride", type=int, help="write every so manyth frame")
    parser.add_argument(
        "--frame-dt", type=float, help="time between the stored frames [s], if the file is silent"
    )
    parser.add_argument("--format", metavar="NAME", help="format of FILE, if it is not recognised")
    parser.add_argument(
        "--layout",
        choices=LAYOUTS,
        help="write the whole data set FILE into the folder OUT, in the layout of another program",
    )


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Read frame by frame, write frame by frame."""
    if arguments.layout is not None:
        return _run_dataset(arguments)
    start = time.perf_counter()
    written = check_motion_output(arguments.out)
    _check_apart(arguments.source, written)
    source = open_source(
        arguments.source,
        split=arguments.split or "test",
        index=arguments.trajectory or 0,
        stride=1 if arguments.stride is None else arguments.stride,
        frame_dt=arguments.frame_dt,
        format_name=arguments.format,
    )
    check_room(arguments.out, source.header, frames=source.frame_count or 0)
    bar = progress_bar(arguments, total=source.frame_count or 0, unit="frame", text="export")
    with bar, open_writer(arguments.out, source.header) as writer:
        for position in source.frames:
            writer.append(position)
            bar.update()
    header = source.header
    say(
        arguments,
        f"{written}: {source.name}, {header.particle_count} particles, {writer.frame_count} frames "
        f"of {1e3 * header.frame_dt:g} ms",
    )
    return {
        "source": source.name,
        "points": header.particle_count,
        "dimension": header.dimension,
        "frames": writer.frame_count,
        "frame_dt": header.frame_dt,
        "seconds": time.perf_counter() - start,
        "files": [str(written)],
    }


def check_motion_output(out: Path) -> Path:
    """Refuse a place where no motion can be written, before any work is done for it.

    Args:
        out: Path whose extension names the format.

    Returns:
        What will be written: the file, or the folder of a sequence.
    """
    written = written_path(out)
    return check_output(written, folder=written != out)


def _run_dataset(arguments: argparse.Namespace) -> dict[str, Any]:
    """Write a whole data set."""
    single = ("trajectory", "split", "stride", "frame_dt", "format")
    given = [
        f"--{name.replace('_', '-')}" for name in single if getattr(arguments, name) is not None
    ]
    if given:
        raise ValueError(
            f"{given[0]} chooses from a single motion, but --layout writes the whole data set. "
            f"Leave one of them out."
        )
    if arguments.out.suffix.lower() in EXTENSIONS:
        raise ValueError(
            f"--layout makes a folder, but {arguments.out} is named like a file. Leave "
            f"{arguments.out.suffix} out."
        )
    if not arguments.source.is_dir():
        raise ValueError(f"--layout needs the folder of a data set; {arguments.source} is none.")
    check_output(arguments.out, folder=True)
    _check_apart(arguments.source, arguments.out)
    with progress_bar(arguments, total=len(SPLITS), unit="split", text="export") as bar:
        result = export_dataset(
            arguments.source, arguments.out, layout=arguments.layout, report=bar.update
        )
    counts = ", ".join(f"{count} {name}" for name, count in result["trajectories"].items())
    pickled = "; they need allow_pickle, their shapes differ" if result.get("pickle") else ""
    say(arguments, f"{arguments.out}: {counts} trajectories for {arguments.layout}{pickled}")
    return result | {"layout": arguments.layout}


def _check_apart(source: Path, written: Path) -> None:
    """Refuse to write over what is read or a part of it."""
    read, write = source.resolve(), written.resolve()
    if read == write or write in read.parents or (read in write.parents and written.exists()):
        raise ValueError(
            f"{written} is, holds or is part of what is read, {source}. Choose another place for "
            f"the result."
        )
