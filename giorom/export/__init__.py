"""Motions as files for other programs: HDF5, GNS, VTKHDF, USD, PLY, pictures and films.

``open_writer`` takes a motion frame by frame, ``write_trajectory`` one that is in memory; the
extension of the path picks the format. Every file is written under a temporary name and renamed, so
that nothing half-written is left behind.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from shutil import disk_usage

from giorom.export.gns import gns_writer
from giorom.export.hdf5 import hdf5_writer
from giorom.export.ply import ply_folder, ply_writer
from giorom.export.usd import usd_writer
from giorom.export.video import picture_writer, write_contact_sheet, write_film
from giorom.export.vtkhdf import vtkhdf_writer
from giorom.export.writer import MotionHeader, MotionWriter
from giorom.state import Trajectory

__all__ = [
    "EXTENSIONS",
    "MotionHeader",
    "MotionWriter",
    "check_extension",
    "check_room",
    "open_writer",
    "write_contact_sheet",
    "write_film",
    "write_trajectory",
    "written_path",
]

EXTENSIONS = {
    ".h5": "trajectory file (HDF5)",
    ".npz": "motion for GNS (geoelements/gns)",
    ".vtkhdf": "animated points for ParaView",
    ".usd": "animated points for Blender, Houdini, Omniverse",
    ".usda": "the same as text",
    ".usdc": "the same, binary",
    ".ply": "folder of PLY files, one per frame",
    ".mp4": "film",
    ".png": "contact sheet",
}
"""Formats that can be written, by extension."""

_PICTURES = (".mp4", ".png")

_WITH_FIELDS = (".vtkhdf", ".ply", ".usd", ".usda", ".usdc")

_WRITERS: dict[str, Callable[[Path, MotionHeader], AbstractContextManager[MotionWriter]]] = {
    ".h5": hdf5_writer,
    ".npz": gns_writer,
    ".vtkhdf": vtkhdf_writer,
    ".usd": usd_writer,
    ".usda": usd_writer,
    ".usdc": usd_writer,
    ".ply": ply_writer,
    ".mp4": picture_writer,
    ".png": picture_writer,
}


def check_extension(path: Path) -> str:
    """Tell the format of a path, before any work is done for it.

    Args:
        path: Where a motion is to be written.

    Returns:
        The extension, in lower case.

    Raises:
        ValueError: If no format has that extension.
    """
    extension = path.suffix.lower()
    if extension not in EXTENSIONS:
        known = ", ".join(f"{key} ({what})" for key, what in EXTENSIONS.items())
        raise ValueError(
            f"{path} ends in {extension or 'no extension'}, which names no format. Known: {known}."
        )
    return extension


def check_room(path: Path, header: MotionHeader, *, frames: int) -> None:
    """Refuse a motion that would not fit on the disk, before any work is done for it.

    Args:
        path: Where it is to be written.
        header: What is known before the first frame.
        frames: Number of frames.

    Raises:
        ValueError: If its numbers alone, before any compression, take more than is free.
    """
    above = next(parent for parent in path.absolute().parents if parent.exists())
    size, disk = 4 * frames * header.particle_count * header.dimension, disk_usage(above)
    if size > disk.free and disk.total > 0:  # file systems of the kernel have no size at all
        raise ValueError(
            f"{frames} frames of {header.particle_count} particles would take {size / 2**30:.3g} "
            f"GiB, but {above} has {disk.free / 2**30:.3g} GiB free. Ask for fewer frames, or for "
            f"another place."
        )


def written_path(path: Path) -> Path:
    """What a writer leaves behind for a path: the path, or for ``.ply`` the folder beside it.

    Args:
        path: Where a motion is to be written.
    """
    return ply_folder(path) if check_extension(path) == ".ply" else path


@contextmanager
def open_writer(path: Path, header: MotionHeader) -> Iterator[MotionWriter]:
    """Open a file for one motion in the format that its extension names.

    If the block ends well the file is completed and put in place; if it fails nothing is left.

    Args:
        path: File to create or replace (for ``.ply`` a folder of that name without extension).
        header: What is known before the first frame.

    Yields:
        The writer; call its ``append`` once for each frame.

    Raises:
        ValueError: If the extension is unknown, there was no frame, or a frame does not fit.
    """
    with _WRITERS[check_extension(path)](path, header) as writer:
        yield writer
        writer.finish()


def write_trajectory(
    trajectory: Trajectory, path: Path, *, truth: Trajectory | None = None
) -> Path:
    """Write a motion that is in memory in the format that the extension of ``path`` names.

    Args:
        trajectory: The motion.
        path: File to create or replace (for ``.ply`` a folder of that name without extension).
        truth: The motion it should have been; shown beside it in pictures and films, and in
            ``.vtkhdf``, ``.usd`` and ``.ply`` files turned into the field ``error`` [m].

    Returns:
        What was written.

    Raises:
        ValueError: If the extension is unknown, or ``truth`` has other frames or particles.
    """
    extension = check_extension(path)
    if extension in _PICTURES:
        draw = write_film if extension == ".mp4" else write_contact_sheet
        return draw(trajectory, path, truth=truth)
    fields = ("error",) if truth is not None and extension in _WITH_FIELDS else ()
    if fields and truth is not None and truth.position.shape != trajectory.position.shape:
        raise ValueError(
            f"the error needs the same frames and particles in both motions, got "
            f"{tuple(trajectory.position.shape)} and {tuple(truth.position.shape)}."
        )
    with open_writer(path, MotionHeader.of(trajectory, fields=fields)) as writer:
        for frame, position in enumerate(trajectory.position):
            if fields and truth is not None:
                writer.append(position, error=(position - truth.position[frame]).norm(dim=1))
            else:
                writer.append(position)
    return written_path(path)
