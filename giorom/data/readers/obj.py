"""Read sequences of Wavefront OBJ meshes: the vertices are the particles.

A deformed mesh keeps its vertices, so that row i is the same material point in every frame; a file
with other faces than the first is refused, because it was meshed anew. Only ``v`` and the vertex
numbers of ``f`` are read.

Source:
    Wavefront, "Object Files (.obj)", Advanced Visualizer manual, appendix B1.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import Cloud, check_count, cloud_of, reading, text_lines
from giorom.data.readers.frame_files import is_first_file
from giorom.data.readers.sequence import read_sequences
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader

__all__ = ["OBJ", "read_obj_frame"]

EXTENSIONS = (".obj",)

START_BYTES = 1 << 16
"""Bytes among which a vertex must stand."""

BLOCK_VERTICES = 1 << 14


def read_obj_frame(path: Path) -> Cloud:
    """Read the vertices of one OBJ file.

    Args:
        path: The file.

    Returns:
        The vertices, and a digest of the faces.

    Raises:
        DataError: If the file is damaged or has no vertices.
    """
    with reading(path), path.open("rb") as stream:
        blocks, faces, digest = _parse(stream, path)
        if not blocks:
            raise DataError(f"{path} has no vertices. It is empty, truncated or no OBJ mesh.")
        position = np.concatenate(blocks)
        check_count(len(position), path.stat().st_size, 1, path=path)
        notes = (f"The vertices are the particles; {faces} faces are left out.",) if faces else ()
        return cloud_of(position, {}, path=path, topology=digest, notes=notes)


def _parse(stream: Any, path: Path) -> tuple[list[np.ndarray], int, str | None]:
    """Vertices in blocks, the number of faces, and a digest of their vertex numbers."""
    blocks: list[np.ndarray] = []
    rows: list[tuple[float, ...]] = []
    faces, digest = 0, hashlib.sha256()
    for line in text_lines(stream, path=path):
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            if len(words) < 4:
                raise DataError(
                    f"{path} has a vertex of {len(words) - 1} numbers; it must have at least 3. "
                    f"The file is truncated or damaged; copy it again."
                )
            rows.append(tuple(float(word) for word in words[1:4]))
            if len(rows) == BLOCK_VERTICES:
                blocks.append(np.array(rows, dtype=np.float64))
                rows = []
        elif words[0] == b"f":
            faces += 1
            digest.update(b" ".join(word.split(b"/")[0] for word in words[1:]) + b"\n")
    if rows:
        blocks.append(np.array(rows, dtype=np.float64))
    return blocks, faces, digest.hexdigest() if faces else None


def _is_obj(file: Path) -> bool:
    """Whether a file is text with a vertex near its start."""
    with file.open("rb") as stream:
        start = stream.read(START_BYTES)
    return b"\0" not in start and any(line.split()[:1] == [b"v"] for line in start.splitlines())


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each series of OBJ files as a motion."""
    yield from read_sequences(path, EXTENSIONS, read_obj_frame)


OBJ = Reader(
    name="obj",
    title="OBJ meshes, one per frame; the vertices are the particles",
    detect=lambda path: is_first_file(path, EXTENSIONS, _is_obj),
    read=_read,
)
"""Reader of sequences of OBJ meshes."""
