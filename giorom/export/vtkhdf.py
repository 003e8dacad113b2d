"""Write a motion as a temporal VTKHDF file, which ParaView opens as an animation of points.

The file is plain HDF5. The points of all frames stand one frame after the other; the cells (one
vertex per particle) and the particle types do not change and are stored once, every step
pointing at them. Positions are metres, the time values seconds.

Source:
    "VTKHDF File Format", version 2.0, docs.vtk.org: PolyData and temporal data.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from giorom.data.atomic import replacing
from giorom.export.points import point_fields
from giorom.export.scene import in_space
from giorom.state import Trajectory

__all__ = ["write_vtkhdf"]

VERSION = (2, 0)

CELL_KINDS = ("Vertices", "Lines", "Polygons", "Strips")
"""Kinds of cell of a PolyData, in the order of the columns of the step offsets."""


def write_vtkhdf(
    trajectory: Trajectory,
    path: Path,
    *,
    fields: Mapping[str, Float[Tensor, "t p"]] | None = None,
) -> Path:
    """Write a motion for ParaView, with the speed [m/s] and type of each particle.

    Args:
        trajectory: The motion; a 2-D one lies in z = 0.
        path: File to create or replace, ending in ``.vtkhdf``.
        fields: More numbers for each particle and frame, such as an error.

    Returns:
        The path.

    Raises:
        ValueError: If a field has a name that is taken or a wrong shape.
    """
    import h5py

    values = point_fields(trajectory, fields)
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array(VERSION, dtype=np.int64)
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len("PolyData")))
        _write_points(root, trajectory, values)
        _write_cells(root, trajectory.position.shape[1])
        _write_steps(root, trajectory, list(values))
    return path


def _write_points(root: Any, trajectory: Trajectory, values: dict[str, np.ndarray]) -> None:
    """Store the points of every frame, their fields, and the types once."""
    frames, particles, _ = trajectory.position.shape
    root["NumberOfPoints"] = np.array([particles], dtype=np.int64)
    packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    points = root.create_dataset(
        "Points", (frames * particles, 3), np.float32, chunks=(particles, 3), **packed
    )
    for frame in range(frames):
        first = frame * particles
        points[first : first + particles] = in_space(trajectory.position[frame])
    data = root.create_group("PointData")
    for name, numbers in values.items():
        data.create_dataset(name, data=numbers.reshape(-1), chunks=(particles,), **packed)
    data["particle_type"] = trajectory.particle_type.cpu().numpy().astype(np.int32)


def _write_cells(root: Any, particles: int) -> None:
    """Store one vertex per particle, and no cell of the other kinds."""
    for kind in CELL_KINDS:
        count = particles if kind == "Vertices" else 0
        group = root.create_group(kind)
        group["NumberOfCells"] = np.array([count], dtype=np.int64)
        group["NumberOfConnectivityIds"] = np.array([count], dtype=np.int64)
        group["Offsets"] = np.arange(count + 1, dtype=np.int64)
        group["Connectivity"] = np.arange(count, dtype=np.int64)


def _write_steps(root: Any, trajectory: Trajectory, names: list[str]) -> None:
    """Store the times and where the data of each begin; cells and types begin at 0 always."""
    frames, particles, _ = trajectory.position.shape
    start = np.arange(frames, dtype=np.int64) * particles
    nothing = np.zeros(frames, dtype=np.int64)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = np.arange(frames, dtype=np.float64) * trajectory.frame_dt
    steps["PartOffsets"] = nothing
    steps["NumberOfParts"] = np.ones(frames, dtype=np.int64)
    steps["PointOffsets"] = start
    steps["CellOffsets"] = np.zeros((frames, len(CELL_KINDS)), dtype=np.int64)
    steps["ConnectivityIdOffsets"] = np.zeros((frames, len(CELL_KINDS)), dtype=np.int64)
    offsets = steps.create_group("PointDataOffsets")
    for name in names:
        offsets[name] = start
    offsets["particle_type"] = nothing
