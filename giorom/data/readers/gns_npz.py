"""Read the ``.npz`` files of geoelements/gns, and plain arrays in ``.npz``.

geoelements stores one array of objects per trajectory, ``simulation_0`` and so on: positions
(frames, particles, axes), particle types (one integer or one per particle) and, in newer
files, a material property per particle, which is left out with a note. Older files have
one array ``gns_data`` of such pairs; ours one of records, which need no pickle. Arrays of objects
are pickles; they go through ``restricted_pickle`` and never through NumPy's loader. An array of
three axes under any name is taken as a trajectory too, with the types of an array named
``particle_type`` if there is one.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.metadata import DataError
from giorom.data.readers.foreign_metadata import ForeignMetadata, read_foreign_metadata
from giorom.data.readers.lazy_array import LazyArray
from giorom.data.readers.natural_order import natural_key
from giorom.data.readers.npy_header import NpyHeader, read_npy_header
from giorom.data.readers.npy_records import read_records
from giorom.data.readers.particle_arrays import check_frames, checked_types, types_from
from giorom.data.readers.pickle_constructors import StoredArray
from giorom.data.readers.restricted_pickle import load_pickle
from giorom.data.readers.source import ForeignTrajectory, Reader
from giorom.data.readers.split_names import split_files, split_of
from giorom.data.readers.zip_archive import ZipArchive, is_zip
from giorom.state import WATER

__all__ = ["GNS_NPZ"]

TYPE_NAMES = ("particle_type", "particle_types")
"""Names under which plain arrays of particle types are stored."""


def read_npz(path: Path) -> Iterator[ForeignTrajectory]:
    """The trajectories of an ``.npz`` file, or of all those in a folder.

    Args:
        path: The file or folder; ``metadata.json`` is looked for beside the files.

    Yields:
        The trajectories, in the order of the files.

    Raises:
        DataError: If a file is damaged, asks for more than arrays, or holds no trajectory.
    """
    files = split_files(path, ".npz")
    if not files:
        raise DataError(f"{path} holds no .npz file. Check the path.")
    metadata = read_foreign_metadata(files[0].parent)
    for file in files:
        yield from _read_file(file, metadata)


def is_npz(path: Path) -> bool:
    """Whether a file is a zip archive of arrays, or a folder has one.

    Args:
        path: The file or folder.

    Returns:
        Whether it is.
    """
    files = split_files(path, ".npz")
    try:
        if not files or not is_zip(files[0]):
            return False
        names = list(ZipArchive(files[0]).members)
    except DataError:
        return files[0].suffix == ".npz"
    return bool(names) and all(name.endswith(".npy") for name in names)


def _read_file(path: Path, metadata: ForeignMetadata) -> Iterator[ForeignTrajectory]:
    archive = ZipArchive(path)
    names = [name for name in archive.members if name.endswith(".npy")]
    found = 0
    for name in list(names):
        records = read_records(archive.source(name))
        if records is None:
            continue
        archive.check_sum(name)
        names.remove(name)
        for number, (positions, kinds) in enumerate(records):
            where = f"{path.name}[{name.removesuffix('.npy')}][{number}]"
            yield _trajectory(positions, kinds, False, where=where, path=path, metadata=metadata)
            found += 1
    headers = {name: read_npy_header(archive.source(name)) for name in names}
    types = _shared_types(archive, headers)
    for name in sorted(names, key=lambda name: natural_key(Path(name))):
        header = headers[name]
        if not (header.holds_objects or len(header.shape) == 3):
            continue
        archive.check_sum(name)
        label = f"{path.name}[{name.removesuffix('.npy')}]"
        if header.holds_objects:
            for pair, where in _pairs(header, label):
                yield _trajectory(*pair, where=where, path=path, metadata=metadata)
                found += 1
        else:
            yield _trajectory(
                header.array(), types, False, where=label, path=path, metadata=metadata
            )
            found += 1
    if not found:
        raise DataError(
            f"{path} holds no trajectory: none of {', '.join(names[:5]) or 'no arrays'} has the "
            f"axes (frames, particles, 2 or 3). Check what is in it."
        )


def _shared_types(archive: ZipArchive, headers: dict[str, NpyHeader]) -> LazyArray | None:
    """Particle types stored as an array of their own."""
    for name in TYPE_NAMES:
        header = headers.get(f"{name}.npy")
        if header is not None and not header.holds_objects:
            archive.check_sum(f"{name}.npy")
            return header.array()
    return None


def _pairs(header: NpyHeader, label: str) -> Iterator[tuple[tuple[LazyArray, Any, bool], str]]:
    """Positions, types and whether there is more, of each trajectory in an array of objects."""
    value = load_pickle(header.source, start=header.start).value
    if type(value) is not StoredArray or value.values is None:
        raise DataError(f"{label} is damaged: its pickle is no array of objects.")
    items = _items(value)
    single = len(items) == 1 and value.shape != (1,)
    taken = 0
    for number, item in enumerate(items):
        where = label if single else f"{label}[{number}]"
        array = _positions(item)
        if array is None:
            raise DataError(f"{where} is no pair of positions (frames, particles, axes) and types.")
        taken += array.byte_count
        if taken > 2 * header.source.size:
            raise DataError(f"{label} refers to the same bytes again and again. It is hostile.")
        yield (array, item[1] if len(item) > 1 else None, len(item) > 2), where


def _items(value: StoredArray) -> list[list[Any]]:
    """The trajectories of an array of objects, each as a list of positions, types and more."""
    values = value.values or []
    if len(value.shape) == 2 and value.shape[1] in (2, 3):
        width = value.shape[1]
        return [values[row : row + width] for row in range(0, len(values), width)]
    if value.shape in ((2,), (3,)) and type(values[0]) is StoredArray and values[0].array:
        return [values]
    return [
        list(item) if isinstance(item, tuple | list) else getattr(item, "values", None) or []
        for item in values
    ]


def _positions(item: list[Any]) -> LazyArray | None:
    """The positions of a trajectory."""
    first = item[0] if item else None
    return first.array if type(first) is StoredArray else None


def _trajectory(
    positions: LazyArray,
    types: Any,
    has_more: bool,
    *,
    where: str,
    path: Path,
    metadata: ForeignMetadata,
) -> ForeignTrajectory:
    """One trajectory, its shapes checked."""
    if len(positions.shape) != 3 or not positions.is_float:
        raise DataError(
            f"{where}: positions are {positions.dtype} of shape {positions.shape}; they must be "
            f"floating-point numbers of shape (frames, particles, 2 or 3)."
        )
    frames, count, dimension = positions.shape
    check_frames(frames, count, dimension, where)
    if metadata.dimension not in (None, dimension):
        raise DataError(f"{where} is {dimension}-D, but metadata.json says {metadata.dimension}-D.")
    notes = list(metadata.notes)
    if has_more:
        notes.append("Left out: the material property.")
    if types is None:
        notes.append(f"No particle types are stored; all particles are taken as type {WATER}.")
    return ForeignTrajectory(
        name=where,
        particle_type=_types(types, count, where),
        frames=lambda: positions.frames(time_axis=0),
        frame_count=frames,
        split=split_of(path),
        frame_dt=metadata.frame_dt,
        bounds=metadata.bounds,
        identity_kept=True,
        notes=tuple(notes),
    )


def _types(types: Any, count: int, where: str) -> Any:
    """Particle types from an array, a number or nothing."""
    if isinstance(types, StoredArray):
        types = types.array
    if isinstance(types, LazyArray):
        return types_from(types, count, where)
    if types is None:
        types = WATER
    if type(types) is not int or abs(types) > 1 << 40:
        raise DataError(f"{where} has particle types that are no integers.")
    return checked_types(np.array(types, dtype=np.int64), count, where)


GNS_NPZ = Reader(name="gns-npz", title="geoelements/gns, .npz", detect=is_npz, read=read_npz)
"""Reader of geoelements/gns."""
