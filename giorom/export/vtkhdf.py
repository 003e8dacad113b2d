"""Write a motion as a temporal VTKHDF file, which ParaView opens as an animation of points.

The file is plain HDF5. The points of all frames stand one frame after the other in data sets that
grow; the cells (one vertex per particle) and the particle types do not change and are stored
once, every step pointing at them. Positions are metres, the time values seconds.

Source:
    "VTKHDF File Format", version 2.0, docs.vtk.org: PolyData and temporal data.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from giorom.data.atomic import replacing
from giorom.data.hdf5_output import check_written, hdf5_output
from giorom.export.scene import in_space
from giorom.export.writer import MotionHeader, PointWriter

__all__ = ["vtkhdf_writer"]

VERSION = (2, 0)

CELL_KINDS = ("Vertices", "Lines", "Polygons", "Strips")
"""Kinds of cell of a PolyData, in the order of the columns of the step offsets."""

MOST_CHUNK_ROWS = 1 << 18
"""Most points in a compressed block (3 MiB)."""


class VtkHdfWriter(PointWriter):
    """Appends frames to an open file.

    Args:
        file: The open ``h5py.File``.
        header: What is known before the first frame.
    """

    def __init__(self, file: Any, header: MotionHeader) -> None:
        super().__init__(header)
        particles = header.particle_count
        self._file = file
        self._root = root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array(VERSION, dtype=np.int64)
        root.attrs.create("Type", b"PolyData", dtype=_fixed_text(len("PolyData")))
        root["NumberOfPoints"] = np.array([particles], dtype=np.int64)
        self._points = _growing(root, "Points", particles, columns=(3,))
        data = root.create_group("PointData")
        self._names = ("speed", *header.fields)
        self._numbers = {name: _growing(data, name, particles) for name in self._names}
        data["particle_type"] = header.particle_type.cpu().numpy().astype(np.int32)
        _write_cells(root, particles)

    def _put(self, position: Tensor, numbers: dict[str, Tensor]) -> None:
        _extend(self._points, in_space(position))
        for name, values in numbers.items():
            _extend(self._numbers[name], values.numpy())
        check_written(self._file)

    def _complete(self) -> None:
        _write_steps(self._root, self.frame_count, self.header, self._names)


@contextmanager
def vtkhdf_writer(path: Path, header: MotionHeader) -> Iterator[VtkHdfWriter]:
    """Open a file for ParaView with the speed [m/s], type and fields of each particle.

    Args:
        path: File to create or replace, ending in ``.vtkhdf``.
        header: What is known before the first frame; a 2-D motion lies in z = 0.

    Yields:
        The writer.
    """
    with replacing(path) as temporary, hdf5_output(temporary) as file:
        yield VtkHdfWriter(file, header)


def _fixed_text(length: int) -> Any:
    """The HDF5 type of an ASCII text of fixed length, which VTK requires."""
    import h5py

    return h5py.string_dtype("ascii", length)


def _growing(group: Any, name: str, particles: int, *, columns: tuple[int, ...] = ()) -> Any:
    """An empty float32 data set to which frames are appended."""
    return group.create_dataset(
        name,
        (0, *columns),
        np.float32,
        maxshape=(None, *columns),
        chunks=(min(particles, MOST_CHUNK_ROWS), *columns),
        compression="gzip",
        compression_opts=4,
        shuffle=True,
    )


def _extend(data: Any, rows: np.ndarray) -> None:
    """Append rows."""
    stored = len(data)
    data.resize(stored + len(rows), axis=0)
    data[stored:] = rows


def _write_cells(root: Any, particles: int) -> None:
    """Store one vertex per particle, and no cell of the other kinds."""
    for kind in CELL_KINDS:
        count = particles if kind == "Vertices" else 0
        group = root.create_group(kind)
        group["NumberOfCells"] = np.array([count], dtype=np.int64)
        group["NumberOfConnectivityIds"] = np.array([count], dtype=np.int64)
        group["Offsets"] = np.arange(count + 1, dtype=np.int64)
        group["Connectivity"] = np.arange(count, dtype=np.int64)


def _write_steps(root: Any, frames: int, header: MotionHeader, names: tuple[str, ...]) -> None:
    """Store the times and where the data of each begin; cells and types begin at 0 always."""
    start = np.arange(frames, dtype=np.int64) * header.particle_count
    nothing = np.zeros(frames, dtype=np.int64)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = np.arange(frames, dtype=np.float64) * header.frame_dt
    steps["PartOffsets"] = nothing
    steps["NumberOfParts"] = np.ones(frames, dtype=np.int64)
    steps["PointOffsets"] = start
    steps["CellOffsets"] = np.zeros((frames, len(CELL_KINDS)), dtype=np.int64)
    steps["ConnectivityIdOffsets"] = np.zeros((frames, len(CELL_KINDS)), dtype=np.int64)
    offsets = steps.create_group("PointDataOffsets")
    for name in names:
        offsets[name] = start
    offsets["particle_type"] = nothing
