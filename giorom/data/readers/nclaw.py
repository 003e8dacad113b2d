"""Read the state folders of NCLaw: one ``torch.save`` file per simulated step.

``state/0000.pt``, ``state/0001.pt`` and so on each hold a dict with ``x`` (particles, 3) and the
velocity, affine velocity, deformation gradient and stress, which are left out: the program
needs positions. NCLaw does not write its time step; by its default settings a step is 5e-4 s.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError
from giorom.data.readers.lazy_array import LazyArray
from giorom.data.readers.particle_arrays import check_frames, checked_types
from giorom.data.readers.pickle_constructors import StoredArray
from giorom.data.readers.source import MOST_PARTICLES, ForeignTrajectory, Reader
from giorom.data.readers.torch_file import load_torch_file, looks_packed, torch_file_texts
from giorom.state import WATER

__all__ = ["NCLAW"]

STATE_NAME = re.compile(r"[0-9]{1,9}\.pt")
"""Names of the files of a state folder."""

KEYS = {"x", "v", "C", "F"}
"""Entries of a state, of which x is needed."""

MOST_FOLDERS = 100_000
"""Most entries looked at in a folder of folders."""

NOTES = (
    "NCLaw does not store the time between frames; one step is 5e-4 s by its default settings.",
    "Left out: velocity, affine velocity, deformation gradient, stress, sections and types.",
)


def read_nclaw(path: Path) -> Iterator[ForeignTrajectory]:
    """The motions in a state folder, in a folder that has one, or in a folder of such folders.

    Args:
        path: The folder.

    Yields:
        One trajectory per state folder.

    Raises:
        DataError: If a state is damaged, asks for more than arrays or differs from the first.
    """
    folders = _state_folders(path)
    if not folders:
        raise DataError(f"{path} holds no state folder with files like 0000.pt. Check the path.")
    for folder in folders:
        yield _trajectory(folder, path)


def is_nclaw(path: Path) -> bool:
    """Whether a folder has numbered files whose pickles name x, v, C and F.

    A damaged first file counts, so that the reader may say what is wrong with it.

    Args:
        path: The folder.

    Returns:
        Whether it has.
    """
    folders = _state_folders(path) if path.is_dir() else []
    if not folders:
        return False
    first = _states(folders[0])[0]
    texts = set(torch_file_texts(first))
    return texts >= KEYS or (not texts and looks_packed(first))


def _state_folders(path: Path) -> list[Path]:
    """The state folders: the folder itself, its ``state``, or those one level down."""
    try:
        below = sorted(entry for entry in path.iterdir() if entry.is_dir())[:MOST_FOLDERS]
    except OSError:
        return []
    candidates = [path, path / "state", *(entry / "state" for entry in below)]
    return [folder for folder in candidates if folder.is_dir() and _states(folder)]


def _states(folder: Path) -> list[Path]:
    """The files of a state folder in the order of their numbers."""
    try:
        found = [entry for entry in folder.iterdir() if STATE_NAME.fullmatch(entry.name)]
    except OSError:
        return []
    return sorted((file for file in found if file.is_file()), key=lambda file: int(file.stem))


def _trajectory(folder: Path, root: Path) -> ForeignTrajectory:
    """The motion of one state folder."""
    states = _states(folder)
    where = (
        str(folder.relative_to(root.parent)) if root in (folder, *folder.parents) else folder.name
    )
    position = _position(states[0])
    count, dimension = position.shape
    check_frames(len(states), count, dimension, where)
    notes = list(NOTES)
    numbers = [int(file.stem) for file in states]
    steps = {after - before for before, after in pairwise(numbers)}
    if len(steps) > 1:
        notes.append(
            "The numbers of the states have gaps; the time between frames is not constant."
        )
    return ForeignTrajectory(
        name=where,
        particle_type=checked_types(np.array(WATER), count, where),
        frames=lambda: _frames(states, position.shape),
        frame_count=len(states),
        identity_kept=True,
        notes=tuple(notes),
    )


def _frames(states: list[Path], shape: tuple[int, ...]) -> Iterator[Float[np.ndarray, "p d"]]:
    """Positions of one state after the other."""
    for file in states:
        position = _position(file)
        if position.shape != shape:
            raise DataError(
                f"{file} has positions of shape {position.shape}, the first state has {shape}; "
                f"the number of particles must not change."
            )
        yield position.read(most_bytes=MOST_PARTICLES * 3 * 8)


def _position(file: Path) -> LazyArray:
    """The positions of a state, unread."""
    state = load_torch_file(file)
    value = state.get("x") if isinstance(state, dict) else None
    array = value.array if type(value) is StoredArray else None
    if array is None or len(array.shape) != 2 or not array.is_float:
        raise DataError(f"{file} is no NCLaw state: it has no floats 'x' of shape (particles, 3).")
    return array


NCLAW = Reader(
    name="nclaw",
    title="NCLaw state folder",
    detect=is_nclaw,
    read=read_nclaw,
)
"""Reader of NCLaw's states."""
