"""Write motions as the .npz files that the PyTorch GNS (geoelements/gns) trains on.

Its loader takes the member ``gns_data`` if there is one and treats it as a list of pairs
(positions, particle types); without it, every member of the file is such a pair. Two layouts
satisfy it:

* motions of one shape: ``gns_data`` is an array of records with the fields ``positions``
  (float32, frames x particles x dim) and ``particle_type`` (int64, particles). NumPy takes a record
  for a pair, and no pickle is involved: ``np.load(path)`` opens the file with pickles refused.
  Written frame by frame.
* motions of several shapes, or above 2 GiB: NumPy's records cannot hold them. ``simulation_0`` ...
  are object arrays of two arrays, which NumPy stores as a pickle of plain arrays; ``np.load`` then
  needs ``allow_pickle=True``, which that loader passes. One motion is held in memory.

Source:
    github.com/geoelements/gns, ``load_npz_data`` in gns/data_loader.py and ``load_data`` in
    gns/particle_data_loader.py, read in November 2026.
"""

import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from torch import Tensor

from giorom.data.atomic import replacing
from giorom.export.spool import Spool
from giorom.export.writer import MotionHeader, MotionWriter

__all__ = ["StoredMotion", "gns_writer", "write_gns_file"]

MOST_RECORD_BYTES = 2**31 - 1
"""Largest record of NumPy."""


@dataclass(frozen=True, kw_only=True)
class StoredMotion:
    """A motion that can be read frame by frame and whose length is known."""

    particle_type: Int[np.ndarray, " p"]
    """GNS particle types."""

    shape: tuple[int, int, int]
    """Frames, particles and dimension."""

    frames: Callable[[], Iterable[np.ndarray]]
    """Starts reading: float32 positions of one frame after the other [m]."""

    @property
    def record(self) -> list[tuple[str, str, tuple[int, ...]]]:
        """Fields of the record that holds it."""
        return [("positions", "<f4", self.shape), ("particle_type", "<i8", self.shape[1:2])]

    @property
    def record_bytes(self) -> int:
        """Size of that record."""
        frames, particles, dimension = self.shape
        return 4 * frames * particles * dimension + 8 * particles


class GnsWriter(MotionWriter):
    """Keeps the frames of one motion on the disk until their number is known.

    Args:
        target: Where the file is written at the end.
        spool: Where the frames wait.
        header: What is known before the first frame.
    """

    def __init__(self, target: Path, spool: Spool, header: MotionHeader) -> None:
        super().__init__(header)
        self._target, self._spool = target, spool

    def _append(self, position: Tensor, _fields: dict[str, Tensor]) -> None:
        self._spool.append(position)

    def _finish(self) -> None:
        frames = self._spool.frames()
        motion = StoredMotion(
            particle_type=self.header.particle_type.cpu().numpy().astype(np.int64),
            shape=frames.shape,
            frames=lambda: iter(frames),
        )
        write_gns_file(self._target, [motion])


@contextmanager
def gns_writer(path: Path, header: MotionHeader) -> Iterator[GnsWriter]:
    """Open a GNS file of one motion; fields, frame time and bounds are not stored.

    Args:
        path: File to create or replace, ending in ``.npz``.
        header: What is known before the first frame.

    Yields:
        The writer.
    """
    shape = (header.particle_count, header.dimension)
    with replacing(path) as temporary, Spool(path.parent, shape) as spool:
        yield GnsWriter(temporary, spool, header)


def write_gns_file(path: Path, motions: Sequence[StoredMotion]) -> bool:
    """Write motions into one file.

    Args:
        path: File to create; use a temporary name (``giorom.data.atomic.replacing``).
        motions: What to store, at least one.

    Returns:
        Whether the file opens without pickle.
    """
    plain = (
        len({motion.shape for motion in motions}) == 1
        and motions[0].record_bytes <= MOST_RECORD_BYTES
    )
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        if plain:
            with archive.open("gns_data.npy", "w", force_zip64=True) as member:
                _write_records(member, motions)
            return True
        for index, motion in enumerate(motions):
            with archive.open(f"simulation_{index}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, _pair(motion), allow_pickle=True)
    return False


def _write_records(member: Any, motions: Sequence[StoredMotion]) -> None:
    """Write motions of one shape as an array of records, frame by frame."""
    description = {
        "descr": motions[0].record,
        "fortran_order": False,
        "shape": (len(motions),),
    }
    np.lib.format.write_array_header_1_0(member, description)
    for motion in motions:
        count = 0
        for frame in motion.frames():
            member.write(np.ascontiguousarray(frame, dtype="<f4").tobytes())
            count += 1
        if count != motion.shape[0]:
            raise RuntimeError(f"a motion of {motion.shape[0]} frames gave {count}.")
        member.write(motion.particle_type.astype("<i8").tobytes())


def _pair(motion: StoredMotion) -> np.ndarray:
    """The object array (positions, particle types)."""
    pair = np.empty(2, dtype=object)
    positions = np.empty(motion.shape, dtype=np.float32)
    for index, frame in enumerate(motion.frames()):
        positions[index] = frame
    pair[:] = [positions, motion.particle_type]
    return pair
