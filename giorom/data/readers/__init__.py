"""Readers of foreign formats, one file each; all give ``ForeignTrajectory`` records."""

from pathlib import Path

from giorom.data.readers.arrays import from_arrays
from giorom.data.readers.crom import CROM
from giorom.data.readers.csv_files import CSV
from giorom.data.readers.gns_npz import GNS_NPZ
from giorom.data.readers.gns_tfrecord import GNS_TFRECORD
from giorom.data.readers.lagrangebench import LAGRANGEBENCH
from giorom.data.readers.mpm_verse import MPM_VERSE
from giorom.data.readers.nclaw import NCLAW
from giorom.data.readers.npy_files import NPY
from giorom.data.readers.obj import OBJ
from giorom.data.readers.ply import PLY
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader
from giorom.data.readers.vtk_files import VTK

__all__ = [
    "READERS",
    "DataError",
    "ForeignTrajectory",
    "Reader",
    "detect_format",
    "from_arrays",
    "require_place",
]

READERS: tuple[Reader, ...] = (
    GNS_TFRECORD,
    MPM_VERSE,
    GNS_NPZ,
    NCLAW,
    CROM,
    LAGRANGEBENCH,
    VTK,
    PLY,
    OBJ,
    CSV,
    NPY,
)
"""Every reader, the most particular format first."""


def require_place(path: Path) -> None:
    """Refuse what can be no source, before anything is opened: a pipe would be waited for.

    Args:
        path: What to read.

    Raises:
        DataError: If it does not exist, or is neither a file nor a folder.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist. Check the path.")
    if not (path.is_file() or path.is_dir()):
        raise DataError(f"{path} is a device or a pipe; files and folders are read. Save it first.")


def detect_format(path: Path) -> Reader:
    """The reader of a file or folder, told from its content.

    Args:
        path: What to read.

    Raises:
        DataError: If it does not exist, or no reader knows it.
    """
    require_place(path)
    for reader in READERS:
        if reader.detect(path):
            return reader
    known = "; ".join(f"{reader.name} ({reader.title})" for reader in READERS)
    raise DataError(f"{path} is of no known format. Known: {known}. Name it with --format.")
