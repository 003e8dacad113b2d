"""Read LagrangeBench data sets, ours, and the simulations of NeuralMPM: HDF5 files.

LagrangeBench: groups ``00000``, ``00001`` ... with ``position`` (frames, particles, axes) and
``particle_type``; the time between frames is ``dt`` times ``write_every`` of ``metadata.json``.
Our own data sets have the same layout and say frame time and walls as attributes of each group.
NeuralMPM: one file per simulation with ``particles`` (frames, particles, positions and velocities)
and ``boundary`` likewise, whose particles are taken as kinematic.

LagrangeBench numbers particles in its own way: 0 fluid, 1 wall at rest, 2 moving wall, 3 rigid body
(``NodeType`` in its lagrangebench/utils.py, read in November 2026). Outside our own files 1 and
2 become kinematic; 0 and 3 become water and rigid where no type is above 3, which only GNS's
numbering has.

Frames are read in the blocks in which HDF5 stores them, behind ``hdf5_guard``.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError
from giorom.data.readers.foreign_metadata import ForeignMetadata, read_foreign_metadata
from giorom.data.readers.hdf5_guard import guarded_file, member, numbers_of, rows_of
from giorom.data.readers.particle_arrays import check_frames, checked_types
from giorom.data.readers.source import ForeignTrajectory, Reader
from giorom.data.readers.split_names import split_files, split_of
from giorom.state import KINEMATIC, RIGID, WATER

__all__ = ["LAGRANGEBENCH"]

BLOCK_BYTES = 32 << 20
"""Memory for a block of frames."""

WALLS = (1, 2)
TRANSLATION = {0: WATER, 1: KINEMATIC, 2: KINEMATIC, 3: RIGID}
"""LagrangeBench's particle types in GNS's numbering."""

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def read_lagrangebench(path: Path) -> Iterator[ForeignTrajectory]:
    """The trajectories of an HDF5 file, or of all those in a folder.

    Args:
        path: The file or folder; ``metadata.json`` is looked for beside the files.

    Yields:
        The trajectories, in the order of the files.

    Raises:
        DataError: If a file is damaged or has another layout.
    """
    files = split_files(path, ".h5", in_folders=True)
    if not files:
        raise DataError(f"{path} holds no .h5 file. Check the path.")
    metadata = read_foreign_metadata(path if path.is_dir() else path.parent)
    for file in files:
        yield from _read_file(file, metadata)


def is_lagrangebench(path: Path) -> bool:
    """Whether an HDF5 file has the group 00000 or NeuralMPM's entries, or a folder has one.

    A damaged ``.h5`` file counts, so that the reader may say what is wrong with it.

    Args:
        path: The file or folder.

    Returns:
        Whether it has.
    """
    try:
        files = split_files(path, ".h5", in_folders=True)
        if not files or not files[0].is_file():
            return False
        with files[0].open("rb") as file:
            if file.read(8) != HDF5_MAGIC:
                return False
        with guarded_file(files[0]) as file:
            # A test for "00000/position" would open what a link names.
            group = member(file, "00000", path=files[0])
            return member(group, "position", path=files[0]) is not None or "particles" in file
    except DataError:
        return files[0].suffix == ".h5"
    except OSError:
        return False


def _read_file(path: Path, metadata: ForeignMetadata) -> Iterator[ForeignTrajectory]:
    with guarded_file(path) as file:
        if "giorom_format_version" in file.attrs and "complete" not in file.attrs:
            raise DataError(f"{path} was not written to its end. Remove it and make it again.")
        names = sorted(name for name in file if re.fullmatch(r"[0-9]{5,9}", name))
        is_single = not names and "particles" in file
        if not names and not is_single:
            raise DataError(f"{path} has neither groups 00000, 00001 ... nor 'particles'.")
    for name in names:
        yield _trajectory(path, name, metadata)
    if is_single:
        yield _neural_mpm(path, metadata)


def _trajectory(path: Path, name: str, metadata: ForeignMetadata) -> ForeignTrajectory:
    """One group of a LagrangeBench file, or of ours."""
    where = f"{path.name}[{name}]"
    with guarded_file(path) as file:
        group = member(file, name, path=path)
        position = _positions(group, "position", path)
        frames, count, dimension = position.shape
        check_frames(frames, count, dimension, where)
        types, notes = _types(file, group, count, path, where)
        frame_dt, bounds = _own_scene(group, dimension, where)
    notes += metadata.notes if bounds is None else ()
    known = bounds if bounds is not None else metadata.bounds
    if known is not None and len(known) != dimension:
        raise DataError(f"{where} is {dimension}-D, but metadata.json says {len(known)}-D.")
    return ForeignTrajectory(
        name=where,
        particle_type=types,
        frames=lambda: _frames(path, name, ["position"], dimension),
        frame_count=frames,
        split=split_of(path),
        frame_dt=frame_dt if frame_dt is not None else metadata.frame_dt,
        bounds=known,
        identity_kept=True,
        notes=notes,
    )


def _neural_mpm(path: Path, metadata: ForeignMetadata) -> ForeignTrajectory:
    """The simulation of a NeuralMPM file."""
    where, keys = path.name, ["particles"]
    with guarded_file(path) as file:
        frames, count, channels = _positions(file, "particles", path).shape
        dimension = channels // 2 if channels in (4, 6) else channels
        check_frames(frames, count, dimension, where)
        types = np.full(count, WATER)
        if "boundary" in file:
            boundary = _positions(file, "boundary", path)
            if boundary.shape[0] != frames or boundary.shape[2] < dimension:
                raise DataError(f"{where}: 'boundary' has shape {boundary.shape}, which is odd.")
            if boundary.shape[1]:
                keys.append("boundary")
                check_frames(frames, boundary.shape[1], dimension, where)
                types = np.concatenate([types, np.full(boundary.shape[1], KINEMATIC)])
        left_out = sorted(
            ascii(str(key)[:40])[1:-1] for key in file if key not in ("particles", "boundary")
        )
    notes = [*metadata.notes, "Left out: velocities.", "Boundary particles follow the others."]
    if left_out:
        notes.append(f"Left out: {', '.join(left_out[:20])}.")
    return ForeignTrajectory(
        name=where,
        particle_type=checked_types(types, len(types), where),
        frames=lambda: _frames(path, "", keys, dimension),
        frame_count=frames,
        split=split_of(path),
        frame_dt=metadata.frame_dt,
        bounds=metadata.bounds,
        identity_kept=True,
        notes=tuple(notes),
    )


def _positions(group: Any, key: str, path: Path) -> Any:
    """An unread array of floats with the axes frames, particles, space."""
    data = numbers_of(group, key, path=path, dims=3)
    if data is None or data.dtype.kind != "f":
        raise DataError(f"{path} has no floats {key!r} of shape (frames, particles, axes).")
    return data


def _types(
    file: Any, group: Any, count: int, path: Path, where: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Particle types in GNS's numbering, and whether they had another."""
    data = numbers_of(group, "particle_type", path=path, dims=1)
    if data is None or data.shape[0] not in (1, count):
        raise DataError(f"{where} has no 'particle_type' with one integer for each particle.")
    types = checked_types(rows_of(data, 0, data.shape[0], path=path), count, where)
    is_mixed = bool((types > max(TRANSLATION)).any())
    table = {old: new for old, new in TRANSLATION.items() if not is_mixed or old in WALLS}
    if "giorom_format_version" in file.attrs or not set(table) & set(types.tolist()):
        return types, ()
    translated = np.array([table.get(int(kind), int(kind)) for kind in range(int(types.max()) + 1)])
    note = ", ".join(f"{old} becomes {new}" for old, new in table.items())
    return translated[types], (f"Particle types are LagrangeBench's and are renumbered: {note}.",)


def _own_scene(group: Any, dimension: int, where: str) -> tuple[float | None, Any]:
    """Frame time and walls of our own files, which stand in the attributes of a group."""
    known = group.attrs
    if "frame_dt" not in known or "bounds" not in known:
        return None, None
    frame_dt, bounds = np.asarray(known["frame_dt"]), np.asarray(known["bounds"])
    fits = frame_dt.shape == () and bounds.shape == (dimension, 2)
    if not fits or not {frame_dt.dtype.kind, bounds.dtype.kind} <= set("fiu"):
        raise DataError(f"{where} has attributes frame_dt and bounds of an unknown form.")
    walls = bounds.astype(np.float64)
    if not (
        0.0 < frame_dt < np.inf and np.isfinite(walls).all() and (walls[:, 0] < walls[:, 1]).all()
    ):
        raise DataError(
            f"{where} has frame_dt={float(frame_dt)!r} and bounds {walls.tolist()}; they must be "
            f"finite, the time > 0 and each lower bound below the upper one."
        )
    return float(frame_dt), walls


def _frames(
    path: Path, name: str, keys: list[str], dimension: int
) -> Iterator[Float[np.ndarray, "p d"]]:
    """Positions of one frame after the other, the data sets side by side."""
    with guarded_file(path) as file:
        group = member(file, name, path=path) if name else file
        datasets = [_positions(group, key, path) for key in keys]
        frames = datasets[0].shape[0]
        frame_bytes = sum(math.prod(data.shape[1:]) * data.dtype.itemsize for data in datasets)
        block = max(1, BLOCK_BYTES // frame_bytes)
        chunk = datasets[0].chunks[0] if datasets[0].chunks else 1
        block = chunk * max(1, block // chunk) if chunk <= 4 * block else block
        for first in range(0, frames, block):
            last = min(first + block, frames)
            parts = [rows_of(data, first, last, path=path)[:, :, :dimension] for data in datasets]
            joined = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
            yield from map(np.ascontiguousarray, joined)


LAGRANGEBENCH = Reader(
    name="lagrangebench",
    title="LagrangeBench or giorom HDF5, NeuralMPM .h5",
    detect=is_lagrangebench,
    read=read_lagrangebench,
)
"""Reader of HDF5 data sets."""
