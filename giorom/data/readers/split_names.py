"""Which part of a data set a file or folder is for, told from its name.

Readers of single files ask ``split_of`` and read the files of a folder in the order of
``split_files``; readers of series of frames look their folders up in ``SPLIT_NAMES``.
"""

from pathlib import Path

from giorom.data.readers.natural_order import natural_key

__all__ = ["SPLIT_NAMES", "split_files", "split_of"]

SPLIT_NAMES = {
    "train": "train",
    "training": "train",
    "valid": "valid",
    "val": "valid",
    "validation": "valid",
    "test": "test",
}
"""Names of files and folders, in lower case, and the part their trajectories are for."""

SPLIT_ORDER = ("train", "valid", "test")
"""The parts in the order in which they are read."""


def split_of(path: Path) -> str | None:
    """What the name of a file says its trajectories are for.

    Args:
        path: The file; its folder may say it too.

    Returns:
        ``train``, ``valid``, ``test`` or None.
    """
    return SPLIT_NAMES.get(path.stem.lower(), SPLIT_NAMES.get(path.parent.name.lower()))


def split_files(path: Path, extension: str, *, in_folders: bool = False) -> list[Path]:
    """The files to read: training data first, then validation, test and the rest.

    Args:
        path: A file, which is taken as it is, or a folder.
        extension: Ending of the files of a folder, with its dot.
        in_folders: Whether the folders ``train``, ``valid`` and ``test`` are searched too.

    Returns:
        The files, those of one part in natural order; none if the folder cannot be listed.
    """
    if not path.is_dir():
        return [path]
    folders = [path, *(path / name for name in SPLIT_ORDER if in_folders)]
    try:
        found = [
            file for folder in folders for file in folder.glob(f"*{extension}") if file.is_file()
        ]
    except OSError:
        return []
    order = {name: place for place, name in enumerate(SPLIT_ORDER)}
    return sorted(
        found, key=lambda file: (order.get(split_of(file) or "", len(order)), natural_key(file))
    )
