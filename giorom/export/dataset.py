"""Write a whole data set in the layout of another program, memory independent of its length.

* ``gns``: ``train.npz`` ... (``giorom.export.gns``) and ``metadata.json``.
* ``lagrangebench``: ``train.h5`` ... with the groups ``00000`` ... of ``position`` and
  ``particle_type``, and ``metadata.json`` with its extra keys. Its loader takes the number of
  frames from the first trajectory of a split, so that all are cut to the shortest. Its kinematic
  particles are types 1 (wall at rest) and 2 (moving wall); type 3, our kinematic one, would be a
  free body there and is renumbered.

A split without trajectories gets no file. The result appears whole or not at all.

Source:
    github.com/tumaer/lagrangebench, ``H5Dataset`` in lagrangebench/data/data.py and ``NodeType``
    in lagrangebench/utils.py, read in November 2026.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from giorom.data.atomic import replacing_folder, write_json
from giorom.data.hdf5_output import hdf5_output
from giorom.data.metadata import read_metadata
from giorom.data.trajectory_file import CHUNK_BYTES, SPLITS, DataError
from giorom.data.trajectory_stream import StoredTrajectory, is_ours, stored_trajectories
from giorom.export.gns import StoredMotion, write_gns_file
from giorom.export.scene import DIAMETER_PER_SPACING, diameter_from_spacing
from giorom.state import KINEMATIC

__all__ = ["LAYOUTS", "export_dataset"]

LAYOUTS = ("gns", "lagrangebench")
"""Layouts a data set can be written in."""

WALL_AT_REST, MOVING_WALL = 1, 2
"""Kinematic particle types of LagrangeBench."""


def export_dataset(
    folder: Path, out: Path, *, layout: str, report: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Write a data set in another layout.

    Args:
        folder: A finished data set.
        out: Folder to make; it must not exist or be empty.
        layout: One of ``LAYOUTS``.
        report: Called after each split.

    Returns:
        ``trajectories`` by split, ``files``, and for ``gns`` whether they need ``pickle``.

    Raises:
        DataError: If the data set is unfinished or empty, or ``out`` holds anything.
    """
    metadata = read_metadata(folder)
    if not is_ours(folder):
        raise DataError(f"{folder} is a foreign data set. Run 'giorom import {folder}' first.")
    splits = {name: stored_trajectories(folder, name) for name in SPLITS}
    if not any(splits.values()):
        raise DataError(f"{folder} has no trajectory; nothing can be exported.")
    if out.is_dir() and any(out.iterdir()):
        raise DataError(f"{out} holds something; nothing is written over it. Choose another name.")
    write = _write_gns if layout == "gns" else _write_lagrangebench
    with replacing_folder(out) as temporary:
        notes = {}
        for name, motions in splits.items():
            if motions:
                notes[name] = write(temporary, name, motions)
            report()
        keys = _gns_keys(splits) if layout == "gns" else _lagrangebench_keys(splits, metadata)
        write_json(temporary / "metadata.json", metadata | keys)
        files = sorted(path.name for path in temporary.iterdir())
    result: dict[str, Any] = {
        "trajectories": {name: len(motions) for name, motions in splits.items()},
        "files": [str(out / name) for name in files],
    }
    if layout == "gns":
        result["pickle"] = not all(notes.values())
    return result


def _write_gns(folder: Path, split: str, motions: Sequence[StoredTrajectory]) -> bool:
    """One .npz of a split; whether it opens without pickle."""
    stored = [
        StoredMotion(
            particle_type=motion.particle_type,
            shape=(motion.frame_count, len(motion.particle_type), len(motion.bounds)),
            frames=motion.frames,
        )
        for motion in motions
    ]
    return write_gns_file(folder / f"{split}.npz", stored)


def _write_lagrangebench(folder: Path, split: str, motions: Sequence[StoredTrajectory]) -> bool:
    """One .h5 of a split, all trajectories cut to the shortest."""
    count = _shortest(motions)
    with hdf5_output(folder / f"{split}.h5") as file:
        for index, motion in enumerate(motions):
            _copy_trajectory(file.create_group(f"{index:05d}"), motion, count)
    return True


def _copy_trajectory(group: Any, motion: StoredTrajectory, count: int) -> None:
    """Copy frames one by one and see whether the kinematic particles move."""
    kinematic = motion.particle_type == KINEMATIC
    shape = (len(kinematic), len(motion.bounds))
    rows = min(count, max(1, CHUNK_BYTES // (4 * shape[0] * shape[1])))
    position = group.create_dataset(
        "position",
        (count, *shape),
        np.float32,
        chunks=(rows, *shape),
        compression="gzip",
        compression_opts=4,
        shuffle=True,
    )
    block, first, moves = [], None, False
    for index, frame in enumerate(motion.frames(count=count)):
        first = frame if first is None else first
        moves = moves or bool((frame[kinematic] != first[kinematic]).any())
        block.append(frame)
        if len(block) == rows or index == count - 1:
            position[index + 1 - len(block) : index + 1] = np.stack(block)
            block = []
    types = np.where(kinematic, MOVING_WALL if moves else WALL_AT_REST, motion.particle_type)
    group["particle_type"] = types.astype(np.int32)


def _gns_keys(splits: dict[str, list[StoredTrajectory]]) -> dict[str, Any]:
    """Metadata of GNS: the real frame time, and steps that every trajectory has."""
    motions = [motion for group in splits.values() for motion in group]
    return {"dt": motions[0].frame_dt, "sequence_length": _shortest(motions) - 1}


def _lagrangebench_keys(
    splits: dict[str, list[StoredTrajectory]], metadata: dict[str, Any]
) -> dict[str, Any]:
    """Metadata that LagrangeBench reads beyond the keys of GNS."""
    motions = [motion for group in splits.values() for motion in group]
    first = motions[0]
    counts = {name: (_shortest(group) if group else 0) for name, group in splits.items()}
    spacing = diameter_from_spacing(
        torch.from_numpy(next(first.frames())),
        kinematic=torch.from_numpy(first.particle_type == KINEMATIC),
        bounds=torch.from_numpy(first.bounds),
    )
    return {
        "write_every": metadata.get("write_every", 1),
        "dx": metadata.get("dx", spacing / DIAMETER_PER_SPACING),
        "num_particles_max": max(len(motion.particle_type) for motion in motions),
        "periodic_boundary_conditions": metadata.get("periodic_boundary_conditions", [False] * 3),
        **{f"num_trajs_{name}": len(group) for name, group in splits.items()},
        **{f"sequence_length_{name}": count for name, count in counts.items()},
    }


def _shortest(motions: Sequence[StoredTrajectory]) -> int:
    return min(motion.frame_count for motion in motions)
