"""Check one trajectory of an open trajectory file before any position is read.

A file may come from a stranger whatever its layout: what a group announces is compared with the
size of the file, and nothing that lies in another file is read. The layout is the one of
``giorom.data.trajectory_file``. Positions are metres, times seconds.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.metadata import DataError
from giorom.data.readers.hdf5_guard import check_storage, member
from giorom.data.readers.source import MOST_PARTICLES
from giorom.state import KINEMATIC, PARTICLE_TYPE_COUNT

__all__ = ["GroupHeader", "group_header"]

MOST_RATIO = 1100
"""Strongest compression of a whole file; deflate packs 1032 to 1 at most."""

SMALL_BYTES = 1 << 26
"""Arrays up to this size may be as empty as they like."""

KEYS = ("position", "particle_type")
"""Data sets of a trajectory."""

FOREIGN_WALLS = (1, 2)
"""LagrangeBench's types of walls, which have no meaning here."""


@dataclass(frozen=True, kw_only=True)
class GroupHeader:
    """One trajectory of an open file: ``position`` is the HDF5 data set, unread."""

    position: Any
    particle_type: np.ndarray
    frame_dt: float
    bounds: np.ndarray
    attributes: dict[str, Any]


def group_header(
    file: Any, name: str, *, path: Path, metadata: dict[str, Any] | None
) -> GroupHeader:
    """Check one trajectory of an open file and say what it is, its positions unread.

    Args:
        file: The open ``h5py.File``.
        name: Its group.
        path: The file, for messages.
        metadata: Those of the data set, if the file is part of one.

    Raises:
        DataError: If the group is damaged, foreign, or lies in another file.
    """
    group, where = member(file, name, path=path), f"{path}[{name}]"
    position, particle_type = _checked_arrays(group, where, path)
    if metadata is not None and position.shape[2] != metadata["dim"]:
        raise DataError(
            f"{where} is {position.shape[2]}-dimensional, but metadata.json beside it says "
            f"dim={metadata['dim']}. The files belong to different data sets."
        )
    frame_dt, bounds, attributes = _scene(group, metadata, where)
    if bounds.shape != (position.shape[2], 2):
        raise DataError(f"{where} has bounds of shape {bounds.shape}, which must be (dim, 2).")
    return GroupHeader(
        position=position,
        particle_type=_checked_types(particle_type, where),
        frame_dt=frame_dt,
        bounds=bounds,
        attributes=attributes,
    )


def _checked_arrays(group: Any, where: str, path: Path) -> tuple[Any, Any]:
    """The two data sets of a group, unread, with the types and shapes of the format."""
    import h5py

    position, particle_type = (member(group, key, path=path) for key in KEYS)
    for key, data in zip(KEYS, (position, particle_type), strict=True):
        if not isinstance(data, h5py.Dataset) or data.shape is None:
            raise DataError(f"{where} has no '{key}'. It is no trajectory file or a damaged one.")
    if position.dtype != np.float32 or position.ndim != 3 or position.shape[2] not in (2, 3):
        raise DataError(
            f"{where}/position is {position.dtype} of shape {position.shape}; it must be float32 "
            f"of shape (frames, particles, 2 or 3). Convert it with 'giorom import'."
        )
    if 0 in position.shape:
        raise DataError(f"{where}/position is empty: its shape is {position.shape}. Remake it.")
    if particle_type.dtype.kind not in "iu" or particle_type.shape != position.shape[1:2]:
        raise DataError(
            f"{where}/particle_type is {particle_type.dtype} of shape {particle_type.shape}; it "
            f"must be one integer for each of the {position.shape[1]} particles."
        )
    limit = max(SMALL_BYTES, MOST_RATIO * path.stat().st_size)
    for data in (position, particle_type):
        check_storage(data, path=path, limit=limit)
    if position.shape[1] > MOST_PARTICLES:
        raise DataError(
            f"{where} announces {position.shape[1]} particles, more than the {MOST_PARTICLES} that "
            f"are read. Check the file."
        )
    return position, particle_type


def _checked_types(particle_type: Any, where: str) -> np.ndarray:
    """Particle types of GNS's numbering, int64."""
    types = particle_type[:].astype(np.int64)
    wrong = types[(types < 0) | (types >= PARTICLE_TYPE_COUNT)]
    if len(wrong):
        raise DataError(
            f"{where}/particle_type holds {int(wrong[0])}; types lie between 0 and "
            f"{PARTICLE_TYPE_COUNT - 1} (GNS convention). Renumber them."
        )
    ours = "giorom_format_version" in particle_type.file.attrs
    walls = types[np.isin(types, FOREIGN_WALLS)]
    if len(walls) and not ours:
        raise DataError(
            f"{where}/particle_type holds {int(walls[0])}, which is a wall in LagrangeBench's "
            f"numbering and would move freely here, where walls are {KINEMATIC}. Convert the data "
            f"with 'giorom import'."
        )
    return types


def _scene(
    group: Any, metadata: dict[str, Any] | None, where: str
) -> tuple[float, np.ndarray, dict[str, Any]]:
    """Frame time [s], walls [m] and attributes: the group's own, else the data set's."""
    known = group.attrs
    if metadata is None and not {"frame_dt", "bounds"} <= set(known):
        raise DataError(
            f"{where} lacks the attributes frame_dt and bounds. Put a metadata.json beside it "
            f"and read it as a data set, or convert it with 'giorom import'."
        )
    given = metadata or {}
    try:
        frame_dt = float(known["frame_dt"] if "frame_dt" in known else _foreign_frame_dt(given))
        bounds = known["bounds"] if "bounds" in known else given["bounds"]
        bounds = np.asarray(bounds).astype(np.float64, casting="same_kind")
    except (TypeError, ValueError):
        raise DataError(
            f"{where} has a frame_dt or bounds that are no numbers. Remake it."
        ) from None
    if not (0.0 < frame_dt < math.inf and (np.abs(bounds) <= np.finfo(np.float32).max).all()):
        raise DataError(
            f"{where} has frame_dt={frame_dt!r} and bounds {str(bounds.tolist())[:120]}; the "
            f"frame time must be > 0 s and all must be finite in float32. Remake it."
        )
    try:
        attributes = json.loads(known.get("attributes", "{}"))
    except (TypeError, ValueError, RecursionError):
        attributes = None
    if not isinstance(attributes, dict):
        raise DataError(f"{where} has attributes that are no JSON object. Remake the file.")
    return frame_dt, bounds, attributes


def _foreign_frame_dt(metadata: dict[str, Any]) -> float:
    """Frame time of a LagrangeBench set, whose ``dt`` is the solver's step."""
    return float(metadata["dt"]) * float(metadata.get("write_every", 1))
