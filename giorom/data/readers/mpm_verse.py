"""Read the official data sets of the paper, MPM-Verse: ``.pt`` and ``.obj`` files.

Both are pickles (``.obj`` is no mesh here) of a dict of parallel lists, one entry per window
(``train``, ``test``) or per trajectory (``rollout``, ``rollout_full``):

- windows: ``position`` (particles, 6, axes), oldest frame first, and ``output`` (particles,
  axes), the frame after. A trajectory is stored as overlapping windows; it is put together again
  where the last five frames of one are the first five of the next, bit by bit. Copies with
  other particles become trajectories of their own.
- rollouts: ``position`` (particles, frames, axes). Sets that were made from GNS data lack
  the last frame there and hold it in ``output`` (particles, axes); in the others ``output`` is
  the path of particle 6 by mistake, and is left out.

The time between frames in ``metadata.json`` of the 3-D sets is a constant of the official
converter and says nothing about the data; it is not taken.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError
from giorom.data.readers.foreign_metadata import ForeignMetadata, read_foreign_metadata
from giorom.data.readers.lazy_array import LazyArray
from giorom.data.readers.particle_arrays import check_frames, checked_types, types_from
from giorom.data.readers.pickle_constructors import StoredArray
from giorom.data.readers.source import MOST_PARTICLES, ForeignTrajectory, Reader
from giorom.data.readers.torch_file import load_torch_file, looks_packed, torch_file_texts
from giorom.state import WATER

__all__ = ["MPM_VERSE"]

WINDOW = 6
"""Frames of a window."""

NAMES = ("train", "test", "rollout", "rollout_full", "rollout_mid", "rollout_gt")
"""Official names of files, in the order in which they are read."""

SUFFIXES = (".pt", ".obj")

KEYS = {"particle_type", "position", "n_particles_per_example", "output"}

ROLLOUT_NOTES = (
    "Official rollout files include runs that were trained on.",
    "rollout and rollout_full are different random subsets of the particles of the same runs: "
    "row i of one is not row i of the other.",
)


TEST_NOTE = "Official test windows may be of a run that is also in train."


@dataclass(frozen=True, slots=True)
class _Entry:
    """One window or rollout."""

    position: LazyArray
    types: LazyArray | None
    output: LazyArray | None


def read_mpm_verse(path: Path) -> Iterator[ForeignTrajectory]:
    """The trajectories of an official file, or of all those in a folder.

    Args:
        path: The file or folder.

    Yields:
        The trajectories: put together from windows, or as they are.

    Raises:
        DataError: If a file is damaged, asks for more than arrays, or is no such data set.
    """
    files = _files(path)
    if not files:
        raise DataError(f"{path} holds none of {', '.join(NAMES)} (.pt or .obj). Check the path.")
    metadata = _trusted(read_foreign_metadata(files[0].parent), files[0].parent)
    for file in files:
        yield from _read_file(file, metadata, in_folder=path.is_dir())


def is_mpm_verse(path: Path) -> bool:
    """Whether a pickle begins with the keys of the official data sets, or a folder has one.

    A damaged file of an official name counts, so that the reader may say what is wrong with it.

    Args:
        path: The file or folder.

    Returns:
        Whether it does.
    """
    files = _files(path)
    if not files or not files[0].is_file():
        return False
    texts = set(torch_file_texts(files[0]))
    is_official = files[0].suffix in SUFFIXES and files[0].stem in NAMES
    return bool(KEYS & texts) or (not texts and is_official and looks_packed(files[0]))


def _files(path: Path) -> list[Path]:
    """The files to read, in the order of ``NAMES``."""
    if not path.is_dir():
        return [path]
    candidates = [path / f"{name}{suffix}" for name in NAMES for suffix in SUFFIXES]
    return [file for file in candidates if file.is_file()]


def _trusted(metadata: ForeignMetadata, folder: Path) -> ForeignMetadata:
    """The metadata without the frame time of the 3-D sets."""
    if metadata.dimension != 3 or metadata.frame_dt is None:
        return metadata
    note = (
        f"{folder.name}/metadata.json says dt={metadata.frame_dt:g} s, a constant of the official "
        f"converter that says nothing about these data; it is not taken. Neither are its "
        f"statistics."
    )
    return replace(metadata, frame_dt=None, notes=(*metadata.notes, note))


def _read_file(
    path: Path, metadata: ForeignMetadata, *, in_folder: bool
) -> Iterator[ForeignTrajectory]:
    entries = _entries(path)
    split = next((name for name in ("train", "test") if path.stem == name), None)
    if path.stem.startswith("rollout"):
        split = "test" if in_folder else None
    if entries[0].position.shape[1] == WINDOW:
        chains = _chains(entries, path)
    else:
        chains = (_rollout(entry, f"{path.name}[{i}]") for i, entry in enumerate(entries))
    if metadata.dimension not in (None, _dimension(entries)):
        raise DataError(
            f"{path} is {_dimension(entries)}-D, but metadata.json beside it says "
            f"{metadata.dimension}-D. The files belong to different data sets."
        )
    leak = (TEST_NOTE,) if path.stem == "test" else ()
    for trajectory in chains:
        yield replace(
            trajectory,
            split=split,
            frame_dt=metadata.frame_dt,
            bounds=metadata.bounds,
            notes=(*metadata.notes, *trajectory.notes, *leak),
        )


def _dimension(entries: list[_Entry]) -> int:
    return entries[0].position.shape[2]


def _entries(path: Path) -> list[_Entry]:
    """The parallel lists of a file, checked."""
    value = load_torch_file(path)
    lists = value if isinstance(value, dict) else {}
    positions = lists.get("position")
    if type(positions) is not list or not positions:
        raise DataError(
            f"{path} is no MPM-Verse data set: it has no list 'position' with windows or rollouts."
        )
    others = {
        key: _list_like(lists.get(key), len(positions)) for key in ("particle_type", "output")
    }
    entries, taken = [], 0
    for number, position in enumerate(positions):
        where = f"{path.name}[{number}]"
        array = _array(position)
        if array is None or len(array.shape) != 3 or not array.is_float:
            raise DataError(f"{where}: 'position' must be floats (particles, frames, axes).")
        check_frames(array.shape[1], array.shape[0], array.shape[2], where)
        if entries and array.shape[2] != _dimension(entries):
            raise DataError(f"{where} has other axes than the entries before. It is damaged.")
        taken += array.byte_count
        entries.append(
            _Entry(array, _array(others["particle_type"][number]), _array(others["output"][number]))
        )
    if taken > 4 * max(1 << 16, path.stat().st_size):
        raise DataError(f"{path} refers to the same bytes again and again. It is hostile.")
    return entries


def _list_like(value: Any, count: int) -> list[Any]:
    """A list as long as the positions, or as many times nothing."""
    return value if type(value) is list and len(value) == count else [None] * count


def _array(value: Any) -> LazyArray | None:
    return value.array if type(value) is StoredArray else None


def _chains(entries: list[_Entry], path: Path) -> Iterator[ForeignTrajectory]:
    """Trajectories put together from overlapping windows."""
    begin, previous = 0, _window(entries[0], f"{path.name}[0]")
    outputs_agree = True
    for number in range(1, len(entries) + 1):
        where = f"{path.name}[{number}]"
        current = _window(entries[number], where) if number < len(entries) else None
        if current is not None and _continues(previous, current):
            outputs_agree = outputs_agree and _output_is(entries[number - 1], current[:, -1])
        else:
            chain = entries[begin:number]
            yield _chain(chain, f"{path.name}[{begin}:{number}]", with_output=outputs_agree)
            begin, outputs_agree = number, True
        if current is not None:
            previous = current


def _window(entry: _Entry, where: str) -> np.ndarray:
    """Positions of a window."""
    if entry.position.shape[1] != WINDOW:
        raise DataError(f"{where} has {entry.position.shape[1]} frames, the others {WINDOW}.")
    return entry.position.read(most_bytes=MOST_PARTICLES * WINDOW * 3 * 8)


def _continues(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether a window is the next one of the same trajectory, bit by bit."""
    return before.shape == after.shape and before[:, 1:].tobytes() == after[:, :-1].tobytes()


def _output_is(entry: _Entry, frame: np.ndarray) -> bool:
    """Whether a window's output is a frame."""
    if not _is_frame(entry.output, frame.shape):
        return False
    assert entry.output is not None  # noqa: S101 - _is_frame says so
    output = entry.output.read(most_bytes=frame.size * 8)
    return bool(np.array_equal(output, frame, equal_nan=True))


def _is_frame(output: LazyArray | None, shape: tuple[int, ...]) -> bool:
    return output is not None and output.shape == shape and output.is_float


def _chain(chain: list[_Entry], where: str, *, with_output: bool) -> ForeignTrajectory:
    """One trajectory from its windows."""
    first = chain[0]
    count, _, dimension = first.position.shape
    last = (
        chain[-1].output
        if with_output and _is_frame(chain[-1].output, (count, dimension))
        else None
    )
    notes = [] if last else ["The last frame ('output') is missing or contradicts the windows."]
    return _foreign(
        first,
        where,
        lambda: _chain_frames(chain, last),
        frame_count=WINDOW + len(chain) - 1 + (last is not None),
        notes=tuple(notes),
    )


def _chain_frames(
    chain: list[_Entry], last: LazyArray | None
) -> Iterator[Float[np.ndarray, "p d"]]:
    """The first window, the newest frame of each other, and the output of the last."""
    yield from chain[0].position.frames(time_axis=1)
    for entry in chain[1:]:
        window = entry.position.read(most_bytes=entry.position.byte_count)
        yield np.ascontiguousarray(window[:, -1])
    if last is not None:
        yield last.read(most_bytes=last.byte_count)


def _rollout(entry: _Entry, where: str) -> ForeignTrajectory:
    """One trajectory that is stored whole."""
    count, frames, dimension = entry.position.shape
    last = entry.output if _is_frame(entry.output, (count, dimension)) else None
    if last is not None and _is_path_of_particle(entry, last):
        last = None
    notes = (
        ROLLOUT_NOTES
        if last
        else (*ROLLOUT_NOTES, "'output' is not the frame after the last and is left out.")
    )
    return _foreign(
        entry,
        where,
        lambda: _rollout_frames(entry.position, last),
        frame_count=frames + (last is not None),
        notes=notes,
    )


def _is_path_of_particle(entry: _Entry, output: LazyArray) -> bool:
    """Whether the output is the path of particle 6, where both have the same shape."""
    count, frames, _ = entry.position.shape
    if count != frames or count <= WINDOW:
        return False
    values = output.read(most_bytes=output.byte_count)
    return all(
        np.array_equal(frame[WINDOW], values[number], equal_nan=True)
        for number, frame in enumerate(entry.position.frames(time_axis=1))
    )


def _rollout_frames(
    position: LazyArray, last: LazyArray | None
) -> Iterator[Float[np.ndarray, "p d"]]:
    yield from position.frames(time_axis=1)
    if last is not None:
        yield last.read(most_bytes=last.byte_count)


def _foreign(
    entry: _Entry, where: str, frames: Any, *, frame_count: int, notes: tuple[str, ...]
) -> ForeignTrajectory:
    """The record of a trajectory, with its types."""
    count = entry.position.shape[0]
    if entry.types is None:
        types = checked_types(np.array(WATER), count, where)
        notes = (*notes, f"No particle types are stored; all particles are taken as type {WATER}.")
    else:
        types = types_from(entry.types, count, where)
    return ForeignTrajectory(
        name=where,
        particle_type=types,
        frames=frames,
        frame_count=frame_count,
        identity_kept=True,
        notes=notes,
    )


MPM_VERSE = Reader(
    name="mpm-verse",
    title="official GIOROM data, MPM-Verse .pt and .obj",
    detect=is_mpm_verse,
    read=read_mpm_verse,
)
"""Reader of the official data sets."""
