"""Motions as files for other programs: HDF5, VTKHDF, PLY, pictures and films.

``write_trajectory`` picks the format by the extension of the path. Every file is written
under a temporary name and renamed, so that nothing half-written is left behind.
"""

from pathlib import Path

from giorom.data.trajectory_file import write_trajectory_file
from giorom.export.ply import write_ply
from giorom.export.video import write_contact_sheet, write_film
from giorom.export.vtkhdf import write_vtkhdf
from giorom.state import Trajectory

__all__ = [
    "EXTENSIONS",
    "check_extension",
    "write_contact_sheet",
    "write_film",
    "write_ply",
    "write_trajectory",
    "write_vtkhdf",
]

EXTENSIONS = {
    ".h5": "trajectory file (HDF5)",
    ".vtkhdf": "animated points for ParaView",
    ".ply": "folder of PLY files, one per frame",
    ".mp4": "film",
    ".png": "contact sheet",
}
"""Formats that can be written, by extension."""


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


def write_trajectory(
    trajectory: Trajectory, path: Path, *, truth: Trajectory | None = None
) -> Path:
    """Write a motion in the format that the extension of ``path`` names.

    Args:
        trajectory: The motion.
        path: File to create or replace (for ``.ply`` a folder of that name without extension).
        truth: The motion it should have been; shown beside it in pictures and films, and in
            ``.vtkhdf`` and ``.ply`` files turned into the field ``error`` [m].

    Returns:
        What was written.

    Raises:
        ValueError: If the extension is unknown, or ``truth`` has other frames or particles.
    """
    extension = check_extension(path)
    if extension == ".h5":
        write_trajectory_file(trajectory, path)
        return path
    if extension in (".mp4", ".png"):
        draw = write_film if extension == ".mp4" else write_contact_sheet
        return draw(trajectory, path, truth=truth)
    write_points = write_vtkhdf if extension == ".vtkhdf" else write_ply
    if truth is None:
        return write_points(trajectory, path)
    if truth.position.shape != trajectory.position.shape:
        raise ValueError(
            f"the error needs the same frames and particles in both motions, got "
            f"{tuple(trajectory.position.shape)} and {tuple(truth.position.shape)}."
        )
    error = (trajectory.position - truth.position).norm(dim=2)
    return write_points(trajectory, path, fields={"error": error})
