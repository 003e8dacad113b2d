"""Read sequences of VTK files: legacy .vtk, .vtu, .vtp, collections .pvd, and temporal .vtkhdf.

The parsers are our own (``vtk_legacy``, ``vtk_xml``, ``vtk_hdf``); VTK is not needed and never sees
the files. A collection says the order and the times of its files; it may only name files of its own
folder.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from giorom.data.readers.cloud import Cloud, reading
from giorom.data.readers.frame_files import FileSeries, even_step, first_file, series_of
from giorom.data.readers.sequence import read_sequences, sequence_trajectory
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader
from giorom.data.readers.vtk_hdf import HDF_EXTENSIONS, is_vtk_hdf, read_vtk_hdf
from giorom.data.readers.vtk_legacy import is_legacy_vtk, read_legacy_vtk
from giorom.data.readers.vtk_xml import is_vtk_xml, parse_xml, read_vtk_xml

__all__ = ["VTK"]

FRAME_EXTENSIONS = (".vtk", ".vtu", ".vtp")

COLLECTION_EXTENSIONS = (".pvd",)

PARALLEL_EXTENSIONS = (".pvtu", ".pvtp")

START_BYTES = 4096
"""Bytes by which a format is told."""

MOST_FRAMES = 1_000_000
"""Most files a collection may name."""


def read_vtk_frame(path: Path) -> Cloud:
    """Read the points of one .vtk, .vtu or .vtp file, by its content.

    Args:
        path: The file.

    Returns:
        The points.

    Raises:
        DataError: If it is damaged or none of these.
    """
    with reading(path):
        start = _start(path)
    if is_legacy_vtk(start):
        return read_legacy_vtk(path)
    if is_vtk_xml(start):
        return read_vtk_xml(path)
    raise DataError(
        f"{path} is neither a legacy nor an XML file of VTK. It is damaged or misnamed; copy it "
        f"again."
    )


def _start(path: Path) -> bytes:
    """First bytes of a file."""
    with path.open("rb") as stream:
        return stream.read(START_BYTES)


def _is_frame(path: Path) -> bool:
    """Whether a file is one of the formats of one frame, or a collection."""
    start = _start(path)
    return is_legacy_vtk(start) or is_vtk_xml(start)


def _detect(path: Path) -> bool:
    """Whether a file, or the first fitting file of a folder, is VTK's."""
    try:
        file = first_file(path, (*FRAME_EXTENSIONS, *COLLECTION_EXTENSIONS, *PARALLEL_EXTENSIONS))
        if file is not None:
            return _is_frame(file)
        file = first_file(path, HDF_EXTENSIONS)
        return file is not None and is_vtk_hdf(file)
    except (OSError, DataError):
        return False


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each motion of a file or folder: of collections, else of files, else of HDF5 files."""
    if first_file(path, PARALLEL_EXTENSIONS) is not None:
        raise DataError(
            f"{path} holds parallel files ({' or '.join(PARALLEL_EXTENSIONS)}), which are not "
            f"read. Merge the pieces of each frame and write them as .vtp."
        )
    collections = list(series_of(path, COLLECTION_EXTENSIONS))
    if collections:
        for series in collections:
            for file in series.files:
                yield _read_collection(file, split=series.split)
        return
    if first_file(path, FRAME_EXTENSIONS) is None and first_file(path, HDF_EXTENSIONS) is not None:
        for series in series_of(path, HDF_EXTENSIONS):
            yield from read_vtk_hdf(series)
        return
    yield from read_sequences(path, FRAME_EXTENSIONS, read_vtk_frame)


def _read_collection(path: Path, *, split: str | None) -> ForeignTrajectory:
    """The motion that a .pvd file lists."""
    entries = _entries(path)
    times = sorted({time for time, _ in entries})
    if len(entries) > len(times):
        raise DataError(
            f"{path} lists several files for one time; a frame must be one file. Merge the parts "
            f"of each frame."
        )
    files = tuple(file for _, file in sorted(entries, key=lambda entry: entry[0]))
    frame_dt, notes = even_step(np.array(times))
    series = FileSeries(name=path.name, files=files, split=split, notes=notes)
    return sequence_trajectory(series, read_vtk_frame, frame_dt=frame_dt)


def _entries(path: Path) -> list[tuple[float, Path]]:
    """Times and files of a collection."""
    entries: list[tuple[float, Path]] = []
    kinds: list[str] = []
    folder = path.parent.resolve()

    def start(name: str, attributes: dict[str, str], _: int) -> bool:
        if name == "VTKFile":
            kinds.append(attributes.get("type", ""))
        elif name == "DataSet":
            time = float(attributes.get("timestep", "nan"))
            file = folder / attributes.get("file", "")
            if not np.isfinite(time) or not file.resolve().is_relative_to(folder):
                raise DataError(
                    f"{path} lists {attributes.get('file', '')[:80]!r} at the time "
                    f"{attributes.get('timestep', '')[:40]!r}; an entry needs a finite timestep "
                    f"and a file in the collection's own folder. Correct it."
                )
            entries.append((time, file))
        return len(entries) > MOST_FRAMES

    with reading(path), path.open("rb") as stream:
        parse_xml(stream, path, start=start, end=lambda _: None, text=lambda _: None)
    if kinds != ["Collection"] or not entries or len(entries) > MOST_FRAMES:
        raise DataError(
            f"{path} is no collection of 1 to {MOST_FRAMES} files ({len(entries)} found). Remake "
            f"it."
        )
    return entries


VTK = Reader(
    name="vtk",
    title="VTK files (.vtk, .vtu, .vtp, .pvd, .vtkhdf)",
    detect=_detect,
    read=_read,
)
"""Reader of VTK's point files."""
