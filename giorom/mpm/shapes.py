"""Bodies to simulate: procedural shapes by name, and how to fill one with particles.

A shape is a level function, negative inside, in a frame whose origin is the centre of its
bounding box; axis 1 points up. Where the text says "distance" the function is the exact
signed distance, elsewhere only its sign means anything. Filling is a regular lattice clipped
to the inside, moved a little by a seeded jitter; particles never leave the shape.

Closed meshes are in ``mesh.py``. Metres; NumPy only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "n d"]
Level = Callable[[np.ndarray], np.ndarray]

MOST_LATTICE_POINTS = 20_000_000
"""Refused before memory is taken: filling needs some 100 bytes for each."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One body, centred on its bounding box."""

    name: str
    """Name in the registry, or the stem of the mesh file."""

    level: Level
    """Negative inside, positive outside, of points (n, d) [m]."""

    extent: tuple[float, ...]
    """Edges of the bounding box [m]."""

    parameters: dict[str, Any]
    """What was drawn, as JSON values."""

    volume: float | None = None
    """Volume (area in 2-D) if a closed form is known [m^d]; else counted from the lattice."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.extent)


def box_distance(half: np.ndarray) -> Level:
    """Distance to a box with half edges ``half`` [m]."""

    def level(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(points) - half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return outside + np.minimum(beyond.max(axis=1), 0.0)

    return level


def superquadric_level(half: np.ndarray, power: float) -> Level:
    """Level ``sum |x_i / half_i|^power - 1``; power 2 is the ellipsoid."""

    def level(points: np.ndarray) -> np.ndarray:
        return (np.abs(points / half) ** power).sum(axis=1) - 1.0

    return level


def capsule_distance(radius: float, half_length: float) -> Level:
    """Distance to a vertical segment of ``2 half_length``, less ``radius`` [m]."""

    def level(points: np.ndarray) -> np.ndarray:
        rest = points.copy()
        rest[:, 1] -= np.clip(points[:, 1], -half_length, half_length)
        return np.linalg.norm(rest, axis=1) - radius

    return level


def cylinder_distance(radius: float, half_height: float) -> Level:
    """Distance to an upright cylinder [m]."""
    profile = box_distance(np.array([radius, half_height]))

    def level(points: np.ndarray) -> np.ndarray:
        return profile(np.stack([np.hypot(points[:, 0], points[:, 2]), points[:, 1]], axis=1))

    return level


def cone_level(radius: float, top: float, height: float) -> Level:
    """Level of an upright cone, cut at radius ``top`` [m]."""

    def level(points: np.ndarray) -> np.ndarray:
        up = points[:, 1] / height + 0.5
        side = np.hypot(points[:, 0], points[:, 2]) - (radius + (top - radius) * up)
        return np.maximum(side, np.abs(points[:, 1]) - 0.5 * height)

    return level


def torus_distance(ring: float, tube: float) -> Level:
    """Distance to a ring that stands upright (its axis is axis 2) [m]."""

    def level(points: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(points[:, 0], points[:, 1]) - ring, points[:, 2]) - tube

    return level


def smooth_minimum(levels: np.ndarray, blend: float) -> np.ndarray:
    """Least of the last axis, rounded: ``-blend log sum exp(-level / blend)``."""
    nearest = levels.min(axis=1)
    return nearest - blend * np.log(np.exp((nearest[:, None] - levels) / blend).sum(axis=1))


def smooth_union_level(centers: np.ndarray, radii: np.ndarray, *, blend: float) -> Level:
    """Spheres melted into one."""

    def level(points: np.ndarray) -> np.ndarray:
        return smooth_minimum(
            np.linalg.norm(points[:, None] - centers[None], axis=2) - radii, blend
        )

    return level


def cut_base(level: Level, extent: np.ndarray, fraction: float) -> tuple[Level, np.ndarray]:
    """Cut the lowest ``fraction`` of the height off, so that the shape stands flat.

    Args:
        level: Level function centred on a bounding box of ``extent``.
        extent: Its edges [m].
        fraction: Part of the height to remove.

    Returns:
        The level function centred on the new bounding box, and the new edges [m].
    """
    removed = fraction * extent[1]
    shift = np.zeros(len(extent))
    shift[1] = 0.5 * removed
    kept = extent - 2.0 * shift

    def cut(points: np.ndarray) -> np.ndarray:
        return np.maximum(level(points + shift), -points[:, 1] - 0.5 * kept[1])

    return cut, kept


def recentred(
    level: Level, reach: np.ndarray, *, size: float, axis: int | None = 1
) -> tuple[Level, np.ndarray]:
    """Find the bounding box of a level function by sampling, and scale it to a size.

    Args:
        level: Level function that is positive outside ``[-reach, reach]``.
        reach: Half edges of the sampled box.
        size: Wanted length of one edge [m].
        axis: Which edge; None: the longest.

    Returns:
        The level function of the scaled, centred body and its edges [m].
    """
    axes = [np.linspace(-half, half, 49 if len(reach) == 3 else 257) for half in reach]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(reach))
    filled = grid[level(grid) < 0.0]
    step = 2.0 * reach / (len(axes[0]) - 1)
    lower, upper = filled.min(axis=0) - 0.5 * step, filled.max(axis=0) + 0.5 * step
    edges = upper - lower
    center = 0.5 * (lower + upper)
    scale = size / (edges.max() if axis is None else edges[axis])

    def scaled(points: np.ndarray) -> np.ndarray:
        return scale * level(points / scale + center)

    return scaled, scale * edges


def lattice(extent: tuple[float, ...], spacing: float) -> np.ndarray:
    """Points of a regular lattice that fills a centred box.

    Each edge carries the whole number of cells nearest to ``edge / spacing``.

    Args:
        extent: Edges of the box [m].
        spacing: Distance of neighbours [m].

    Returns:
        Points (n, d) [m], the last axis running fastest.

    Raises:
        ValueError: If the lattice has more than ``MOST_LATTICE_POINTS``.
    """
    wanted = math.prod(max(1.0, edge / spacing) for edge in extent)
    if not wanted <= MOST_LATTICE_POINTS:
        raise ValueError(
            f"a body of {' x '.join(f'{edge:.3g}' for edge in extent)} m at spacing {spacing:.3g} "
            f"m needs a lattice of {wanted:.3g} points, more than {MOST_LATTICE_POINTS}. Raise "
            f"SceneConfig.spacing or ask for fewer points."
        )
    counts = [max(1, round(edge / spacing)) for edge in extent]
    axes = [(np.arange(count) - 0.5 * (count - 1)) * spacing for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(extent))


def volume_of(shape: Shape) -> float:
    """Volume of a shape (area in 2-D), from its closed form or counted on a lattice [m^d]."""
    if shape.volume is not None:
        return shape.volume
    spacing = max(shape.extent) / (60 if shape.dimension == 3 else 400)
    inside = int((shape.level(lattice(shape.extent, spacing)) < 0.0).sum())
    return inside * spacing**shape.dimension


def fill(
    shape: Shape, *, spacing: float, generator: np.random.Generator, jitter: float = 0.25
) -> tuple[Float[np.ndarray, "n d"], float]:
    """Fill a shape with particles.

    Args:
        shape: The body.
        spacing: Distance of neighbours on the lattice [m].
        generator: Source of the jitter.
        jitter: Largest displacement of a particle on each axis [spacing]; one that would
            leave the shape stays on the lattice.

    Returns:
        Positions in the frame of the shape [m] and the volume of each particle [m^d].

    Raises:
        ValueError: If the spacing exceeds the shape, or no lattice point falls inside.
    """
    if spacing > max(shape.extent):
        raise ValueError(
            f"shape {shape.name} is {max(shape.extent):.3g} m long, less than the spacing of its "
            f"particles, {spacing:g} m. Lower SceneConfig.spacing or raise height_range."
        )
    points = lattice(shape.extent, spacing)
    points = points[shape.level(points) < 0.0]
    if len(points) == 0:
        raise ValueError(
            f"shape {shape.name} of {' x '.join(f'{edge:.3g}' for edge in shape.extent)} m holds "
            f"no lattice point at spacing {spacing:g} m. Lower SceneConfig.spacing or raise "
            f"height_range."
        )
    moved = points + generator.uniform(-jitter, jitter, points.shape) * spacing
    moved = np.where((shape.level(moved) < 0.0)[:, None], moved, points)
    volume = len(points) * spacing**shape.dimension if shape.volume is None else shape.volume
    return moved, volume / len(points)
