"""Closed triangle meshes as shapes.

A mesh file of any unit becomes a shape whose longest edge is a stated length. Whether a
point is inside is the winding number along a ray: every crossing of the ray with a triangle
counts +1 or -1 by its orientation. Overlapping closed parts are therefore solid, whatever
their number. The rays run along one axis, so a triangle meets only the points of the few
cells its projection covers.

Metres after scaling; NumPy only (trimesh reads the file, imported inside the function).
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from giorom.mpm.shapes import Shape

RAY_AXIS = 1
"""Axis along which the rays run."""

EXTENSIONS = (".obj", ".stl", ".ply", ".off", ".glb")
"""Mesh files that are read; each is one file without a packing that could hide more."""

PAIRS_AT_ONCE = 4_000_000
"""Point-triangle pairs tested in one piece; bounds the memory to about 0.5 GB."""


def load_mesh_shape(path: str | Path, *, size: float) -> Shape:
    """Read a closed mesh and scale it.

    Args:
        path: A file of one of ``EXTENSIONS``.
        size: Length of the longest edge of its bounding box after scaling [m].

    Returns:
        The shape; its volume is that of the mesh.

    Raises:
        ValueError: If the file is of another kind, missing, unreadable, not a triangle mesh or not
            closed.
    """
    mesh = _read(Path(path))
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)]
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    scale = size / float((upper - lower).max())
    triangles = (triangles - 0.5 * (lower + upper)) * scale
    volume = abs(float(np.einsum("ni,ni->n", triangles[:, 0], _normals(triangles)).sum()) / 6.0)
    columns = Columns(triangles, signed=bool(mesh.is_winding_consistent))
    return Shape(
        name=Path(path).stem,
        level=lambda points: np.where(columns.contains(points), -1.0, 1.0),
        extent=tuple(((upper - lower) * scale).tolist()),
        parameters={"file": Path(path).name, "faces": len(triangles), "scale": scale},
        volume=volume,
    )


def _read(path: Path) -> Any:
    if path.suffix.lower() not in EXTENSIONS:  # trimesh would unpack archives and follow links
        raise ValueError(
            f"mesh file {path} is of no kind that is read: {', '.join(EXTENSIONS)}. Export it as a "
            f"triangle .obj."
        )
    if not os.path.isfile(path):
        raise ValueError(f"mesh file {path} does not exist. Give the path of a closed mesh.")
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:  # its readers raise whatever their libraries raise
        raise ValueError(
            f"mesh file {path} cannot be read ({error}). Export it as a triangle .obj."
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"mesh file {path} holds no triangles. Export it as a triangle .obj.")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"mesh file {path} holds a coordinate that is not finite. Repair it.")
    # A texture seam doubles vertices: the same corner, two texture coordinates.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not mesh.is_watertight:
        raise ValueError(
            f"mesh {path.name} is not closed: an inside needs every edge to be shared by two "
            f"triangles. Fill its holes (in Blender: Mesh > Clean Up > Fill Holes)."
        )
    return mesh


def _normals(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


class Columns:
    """Triangles sorted into columns along the ray axis."""

    def __init__(self, triangles: Float[np.ndarray, "f 3 3"], *, signed: bool) -> None:
        normals = _normals(triangles)
        facing = np.abs(normals[:, RAY_AXIS]) > 1e-12 * np.linalg.norm(normals, axis=1).max()
        self._triangles = triangles[facing]
        self._sign = np.where(normals[facing, RAY_AXIS] > 0.0, 1, -1)
        self._signed = signed
        self._across = [axis for axis in range(3) if axis != RAY_AXIS]
        flat = self._triangles[:, :, self._across]
        self._lower = flat.min(axis=(0, 1))
        self._extent = flat.max(axis=(0, 1)) - self._lower
        self._cells = int(np.clip(np.sqrt(len(flat)), 8, 256))
        self._sort(flat)

    def _cell(self, points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        scaled = (points - self._lower) / self._extent * self._cells
        return np.clip(np.floor(scaled), -1, self._cells).astype(np.int64)

    def _sort(self, flat: Float[np.ndarray, "f 3 2"]) -> None:
        """List for each column the triangles whose bounding box touches it."""
        first = np.clip(self._cell(flat.min(axis=1)), 0, self._cells - 1)
        last = np.clip(self._cell(flat.max(axis=1)), 0, self._cells - 1)
        span = last - first + 1
        triangle, within = _expand(span.prod(axis=1))
        row = first[triangle, 0] + within // span[triangle, 1]
        column = first[triangle, 1] + within % span[triangle, 1]
        number = row * self._cells + column
        order = np.argsort(number, kind="stable")
        self._listed = triangle[order]
        self._start = np.searchsorted(number[order], np.arange(self._cells**2 + 1))

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points are inside.

        The rays are moved aside by some 1e-7 of the extent: a regular mesh under a regular
        lattice would otherwise put rays exactly on edges.

        Args:
            points: Points [m].

        Returns:
            True where a point is inside.
        """
        flat = points[:, self._across] + self._extent * np.array([1.37e-7, 0.73e-7])
        cell = self._cell(flat)
        over = ((cell >= 0) & (cell < self._cells)).all(axis=1)
        number = np.where(over, cell[:, 0] * self._cells + cell[:, 1], 0)
        counts = np.where(over, self._start[number + 1] - self._start[number], 0)
        winding = np.zeros(len(points), dtype=np.int64)
        pieces = np.searchsorted(
            np.cumsum(counts), np.arange(PAIRS_AT_ONCE, counts.sum(), PAIRS_AT_ONCE)
        )
        for piece in np.split(np.arange(len(points)), pieces):
            owner, within = _expand(counts[piece])
            point = piece[owner]
            triangle = self._listed[self._start[number[point]] + within]
            hit = self._above(flat[point], points[point, RAY_AXIS], triangle)
            np.add.at(winding, point[hit], self._sign[triangle[hit]] if self._signed else 1)
        return winding != 0 if self._signed else winding % 2 == 1

    def _above(
        self,
        flat: Float[np.ndarray, "m 2"],
        height: Float[np.ndarray, " m"],
        triangle: Int[np.ndarray, " m"],
    ) -> Bool[np.ndarray, " m"]:
        """Whether the upward ray of each point crosses the triangle paired with it."""
        corners = self._triangles[triangle]
        a, b, c = (corners[:, i][:, self._across] - flat for i in range(3))
        areas = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
        inside = (areas > 0.0).all(axis=1) | (areas < 0.0).all(axis=1)
        crossing = (areas * corners[:, :, RAY_AXIS]).sum(axis=1)
        total = areas.sum(axis=1)
        return inside & (crossing * np.sign(total) > height * np.abs(total))


def _cross(a: Float[np.ndarray, "m 2"], b: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _expand(
    counts: Int[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Owner and number within the owner of ``counts[i]`` entries of each i."""
    owner = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - before[owner]
