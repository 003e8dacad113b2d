"""Procedural shapes by name, each with a random draw of its proportions.

``draw_shape`` gives a body of a stated height (a creature of ``creatures.py``: of a stated longest
edge); its proportions come from a generator, so a seed makes a shape. Bodies made to stand are cut
flat at the base. Metres; NumPy only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from giorom.mpm.creatures import CREATURES, draw_creature
from giorom.mpm.shapes import (
    Shape,
    box_distance,
    capsule_distance,
    cone_level,
    cut_base,
    cylinder_distance,
    recentred,
    smooth_union_level,
    superquadric_level,
    torus_distance,
)
from giorom.records import nearest

BASE_CUT = 0.12
"""Part of the height cut off below rounded bodies, so that they stand [-]."""


@dataclass(frozen=True, kw_only=True)
class Proportions:
    """What the drawn proportions of a body must satisfy."""

    height: float
    """Edge of the bounding box along axis 1; of a creature, the longest edge [m]."""

    dimension: int
    """2 or 3."""

    slenderness: tuple[float, float]
    """Range of width over height [-]."""

    def widths(self, generator: np.random.Generator) -> np.ndarray:
        """Draw the edges of the bounding box [m]."""
        edges = self.height * generator.uniform(*self.slenderness, self.dimension)
        edges[1] = self.height
        return edges

    def radius(self, generator: np.random.Generator) -> float:
        """Draw half a width [m]."""
        return 0.5 * self.height * float(generator.uniform(*self.slenderness))


def _box(generator: np.random.Generator, wanted: Proportions) -> Shape:
    edges = wanted.widths(generator)
    return Shape(
        name="box",
        level=box_distance(0.5 * edges),
        extent=tuple(edges.tolist()),
        parameters={"edges": edges.tolist()},
        volume=float(edges.prod()),
    )


def _sphere(generator: np.random.Generator, wanted: Proportions) -> Shape:
    del generator  # a ball has no proportions
    radius, solid = 0.5 * wanted.height, wanted.dimension == 3
    return Shape(
        name="sphere" if solid else "disc",
        level=capsule_distance(radius, 0.0),
        extent=(wanted.height,) * wanted.dimension,
        parameters={"radius": radius},
        volume=(4.0 / 3.0 * radius if solid else 1.0) * math.pi * radius**2,
    )


def _cut_superquadric(
    name: str, edges: np.ndarray, power: float, parameters: dict[str, float]
) -> Shape:
    full = edges.copy()
    full[1] = edges[1] / (1.0 - BASE_CUT)
    level, kept = cut_base(superquadric_level(0.5 * full, power), full, BASE_CUT)
    return Shape(
        name=name,
        level=level,
        extent=tuple(kept.tolist()),
        parameters={"edges": full.tolist(), "base_cut": BASE_CUT} | parameters,
    )


def _ellipsoid(generator: np.random.Generator, wanted: Proportions) -> Shape:
    edges = wanted.widths(generator)
    return _cut_superquadric("ellipsoid", edges, 2.0, {})


def _superquadric(generator: np.random.Generator, wanted: Proportions) -> Shape:
    power = float(generator.uniform(1.3, 6.0))
    edges = wanted.widths(generator)
    return _cut_superquadric("superquadric", edges, power, {"power": power})


def _capsule(generator: np.random.Generator, wanted: Proportions) -> Shape:
    radius = min(wanted.radius(generator), 0.45 * wanted.height)
    half_length = 0.5 * wanted.height - radius
    width, ends = 2.0 * radius, math.pi * radius**2
    volume = ends * (4.0 / 3.0 * radius + 2.0 * half_length)
    if wanted.dimension == 2:
        volume = ends + 2.0 * half_length * width
    return Shape(
        name="capsule",
        level=capsule_distance(radius, half_length),
        extent=(width, wanted.height, width)[: wanted.dimension],
        parameters={"radius": radius, "half_length": half_length},
        volume=volume,
    )


def _cylinder(generator: np.random.Generator, wanted: Proportions) -> Shape:
    radius, height = wanted.radius(generator), wanted.height
    return Shape(
        name="cylinder",
        level=cylinder_distance(radius, 0.5 * height),
        extent=(2.0 * radius, height, 2.0 * radius),
        parameters={"radius": radius},
        volume=math.pi * radius**2 * height,
    )


def _cone(generator: np.random.Generator, wanted: Proportions) -> Shape:
    radius, height = 1.25 * wanted.radius(generator), wanted.height
    top = radius * float(generator.uniform(0.2, 0.6))
    return Shape(
        name="cone",
        level=cone_level(radius, top, height),
        extent=(2.0 * radius, height, 2.0 * radius),
        parameters={"radius": radius, "top": top},
        volume=math.pi * height / 3.0 * (radius**2 + radius * top + top**2),
    )


def _torus(generator: np.random.Generator, wanted: Proportions) -> Shape:
    height = wanted.height
    tube = 0.5 * height * float(generator.uniform(0.28, 0.38))
    ring = 0.5 * height - tube
    return Shape(
        name="torus",
        level=torus_distance(ring, tube),
        extent=(height, height, 2.0 * tube),
        parameters={"ring": ring, "tube": tube},
        volume=2.0 * math.pi**2 * ring * tube**2,
    )


def _stack(generator: np.random.Generator, wanted: Proportions) -> Shape:
    """Four or five spheres on top of each other, shrinking upwards, melted into one."""
    count = int(generator.integers(4, 6))
    centers = generator.uniform(-0.25, 0.25, (count, wanted.dimension))
    centers[:, 1] = np.linspace(-0.9, 0.9, count) + generator.uniform(-0.1, 0.1, count)
    radii = np.linspace(0.9, 0.65, count) * generator.uniform(0.85, 1.15, count)
    return _melted("stack", centers, radii, wanted.height)


def _blob(generator: np.random.Generator, wanted: Proportions) -> Shape:
    """Six spheres around a common centre, melted into one."""
    centers = generator.uniform(-0.7, 0.7, (6, wanted.dimension))
    centers[0] = 0.0
    return _melted("blob", centers, generator.uniform(0.45, 0.8, 6), wanted.height)


def _melted(name: str, centers: np.ndarray, radii: np.ndarray, height: float) -> Shape:
    blend = 0.12
    reach = np.abs(centers).max(axis=0) + radii.max() + blend * math.log(len(radii))
    melted = smooth_union_level(centers, radii, blend=blend)
    level, edges = recentred(melted, reach, size=height / (1.0 - BASE_CUT))
    level, kept = cut_base(level, edges, BASE_CUT)
    return Shape(
        name=name,
        level=level,
        extent=tuple(kept.tolist()),
        parameters={
            "centers": centers.tolist(),
            "radii": radii.tolist(),
            "blend": blend,
            "base_cut": BASE_CUT,
        },
    )


def _creature(name: str) -> "Maker":
    def draw(generator: np.random.Generator, wanted: Proportions) -> Shape:
        return draw_creature(name, size=wanted.height, generator=generator)

    return draw


def _pebble(generator: np.random.Generator, wanted: Proportions) -> Shape:
    """A smooth closed curve about a centre, its radius a few random waves of the angle."""
    waves = np.arange(2, 6)
    amplitude = generator.uniform(-0.25, 0.25, len(waves)) / (waves - 1.0)
    phase = generator.uniform(0.0, 2.0 * math.pi, len(waves))
    stretch = np.array([float(generator.uniform(*wanted.slenderness)), 1.0])

    def radius(angle: np.ndarray) -> np.ndarray:
        return 1.0 + (amplitude * np.cos(waves * angle[:, None] + phase)).sum(axis=1)

    angle = np.linspace(0.0, 2.0 * math.pi, 721)
    curve = radius(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1) * stretch
    lower, upper = curve.min(axis=0), curve.max(axis=0)
    scale = wanted.height / (upper - lower)[1]

    def level(points: np.ndarray) -> np.ndarray:
        across, up = ((points / scale + 0.5 * (lower + upper)) / stretch).T
        return np.hypot(across, up) - radius(np.arctan2(up, across))

    return Shape(
        name="pebble",
        level=level,
        extent=tuple((scale * (upper - lower)).tolist()),
        parameters={
            "amplitude": amplitude.tolist(),
            "phase": phase.tolist(),
            "stretch": stretch.tolist(),
        },
    )


Maker = Callable[[np.random.Generator, Proportions], Shape]

SHAPES: dict[str, tuple[Maker, tuple[int, ...]]] = {
    "box": (_box, (2, 3)),
    "disc": (_sphere, (2,)),
    "sphere": (_sphere, (3,)),
    "ellipsoid": (_ellipsoid, (2, 3)),
    "superquadric": (_superquadric, (2, 3)),
    "capsule": (_capsule, (2, 3)),
    "cylinder": (_cylinder, (3,)),
    "cone": (_cone, (3,)),
    "torus": (_torus, (3,)),
    "stack": (_stack, (2, 3)),
    "blob": (_blob, (2, 3)),
    "pebble": (_pebble, (2,)),
} | {name: (_creature(name), (3,)) for name in CREATURES}
"""Every procedural shape: how it is drawn, and the dimensions it exists in."""


def require_shape(name: str, dimension: int) -> None:
    """Reject a shape name that does not exist in a dimension.

    Raises:
        ValueError: Lists the names that do exist.
    """
    if name not in SHAPES or dimension not in SHAPES[name][1]:
        known = [key for key, (_, dimensions) in SHAPES.items() if dimension in dimensions]
        raise ValueError(
            f"there is no {dimension}-D shape {name!r}. {nearest(name, known)} A closed mesh file "
            f"(.obj, .stl, .ply) is given by its path."
        )


def draw_shape(name: str, wanted: Proportions, *, generator: np.random.Generator) -> Shape:
    """Draw a shape of a stated height with random proportions.

    Args:
        name: A key of ``SHAPES``.
        wanted: Height, dimension and slenderness.
        generator: Source of the proportions.

    Returns:
        The shape.

    Raises:
        ValueError: If there is no such shape in that dimension.
    """
    require_shape(name, wanted.dimension)
    return SHAPES[name][0](generator, wanted)
