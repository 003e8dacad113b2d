"""Animal-like bodies: tapered and flattened capsules melted into one closed solid.

They stand in for scanned models (a cow, a rabbit, a fish, an armadillo, a bird): bodies with a
trunk, limbs and thin parts, unlike the compact shapes of ``shape_library.py``, closed by
construction, and another individual for every seed. A creature looks along axis 0; its size is
its longest edge, as for a mesh file. Metres; NumPy only.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from giorom.mpm.shapes import Level, Shape, recentred, smooth_minimum

BLEND = 0.025
"""Width over which parts melt into each other [part of the body's unit length]."""

VARIETY = 0.15
"""Largest relative change of a proportion from one individual to another [-]."""

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Part:
    """A capsule whose radius changes from one end to the other, stretched along the axes."""

    start: Point
    """Centre of the first end."""

    end: Point
    """Centre of the second end."""

    radii: tuple[float, float]
    """Radius at both ends, before stretching."""

    stretch: Point = (1.0, 1.0, 1.0)
    """Factors on the cross section; below one flattens along that axis."""

    def level(self, points: np.ndarray) -> np.ndarray:
        """Negative inside; near the surface about the distance."""
        stretch = np.array(self.stretch)
        first, along = np.array(self.start) / stretch, (np.array(self.end) - self.start) / stretch
        rest = points / stretch - first
        t = np.clip(rest @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        radius = self.radii[0] + (self.radii[1] - self.radii[0]) * t
        away = np.linalg.norm(rest - t[:, None] * along, axis=1) - radius
        return away * float(stretch.min())

    def reach(self) -> np.ndarray:
        """Largest distance from the origin along each axis."""
        ends = np.maximum(np.abs(self.start), np.abs(self.end))
        return ends + max(self.radii) * np.array(self.stretch)


@dataclass(frozen=True, kw_only=True)
class Sketch:
    """A body plan in units of about its length, filled in by a random generator."""

    generator: np.random.Generator
    """Source of the proportions."""

    parts: list[Part] = field(default_factory=list)
    """What has been drawn so far."""

    def vary(self, value: float) -> float:
        """A proportion of this individual."""
        return value * float(self.generator.uniform(1.0 - VARIETY, 1.0 + VARIETY))

    def add(
        self,
        start: Point,
        end: Point | None = None,
        radii: tuple[float, float] | float = 0.1,
        stretch: Point = (1.0, 1.0, 1.0),
    ) -> None:
        """Add one part; without ``end`` a ball."""
        both = (radii, radii) if isinstance(radii, float) else radii
        self.parts.append(Part(start=start, end=end or start, radii=both, stretch=stretch))

    def add_pair(
        self,
        start: Point,
        end: Point | None = None,
        radii: tuple[float, float] | float = 0.1,
        stretch: Point = (1.0, 1.0, 1.0),
    ) -> None:
        """Add a part and its mirror image across the plane of axis 2."""
        for side in (1.0, -1.0):
            mirrored = [
                None if point is None else (point[0], point[1], side * point[2])
                for point in (start, end)
            ]
            self.add(mirrored[0], mirrored[1], radii, stretch)


def _quadruped(body: Sketch) -> None:
    """Trunk, four legs, neck, head, ears and tail."""
    girth, legs = body.vary(0.2), body.vary(0.5)
    reach, crown = body.vary(0.56), body.vary(0.36)
    body.add((-0.34, 0.0, 0.0), (0.34, 0.02, 0.0), girth)
    for along in (-0.32, 0.32):
        body.add_pair((along, -0.05, 0.11), (along, -legs, 0.13), (0.085, 0.07))
    body.add((0.34, 0.08, 0.0), (reach, crown, 0.0), (0.12, 0.1))
    body.add((reach, crown, 0.0), (reach + 0.22, crown - 0.07, 0.0), (0.13, 0.09))
    body.add_pair((reach, crown + 0.07, 0.07), (reach - 0.04, crown + 0.19, 0.14), 0.05)
    body.add((-0.42, 0.06, 0.0), (-0.62, -body.vary(0.15), 0.0), (0.06, 0.045))


def _rabbit(body: Sketch) -> None:
    """Plump body, haunches, head with long ears, feet and a ball for a tail."""
    girth, ears, head = body.vary(0.29), body.vary(0.42), body.vary(0.19)
    body.add((-0.06, 0.0, 0.0), (0.08, 0.03, 0.0), girth, (1.1, 0.95, 0.9))
    body.add_pair((-0.16, -0.1, 0.17), radii=0.17)
    body.add_pair((-0.12, -0.26, 0.19), (0.12, -0.27, 0.2), 0.07)
    body.add_pair((0.24, -0.1, 0.1), (0.33, -0.27, 0.11), (0.09, 0.07))
    body.add((0.33, 0.3, 0.0), (0.42, 0.27, 0.0), (head, 0.7 * head))
    body.add_pair((0.28, 0.42, 0.07), (0.16, 0.42 + ears, 0.15), (0.07, 0.055))
    body.add((-0.38, -0.02, 0.0), radii=0.1)


def _fish(body: Sketch) -> None:
    """Deep flat body, forked tail, back fin and two side fins."""
    depth, fork = body.vary(0.3), body.vary(0.28)
    body.add((-0.36, 0.0, 0.0), (0.22, 0.0, 0.0), (0.4 * depth, depth), (1.0, 0.9, 0.6))
    for side in (1.0, -1.0):
        body.add((-0.44, 0.0, 0.0), (-0.72, side * fork, 0.0), (0.12, 0.08), (1.0, 1.0, 0.6))
    body.add((0.02, 0.2, 0.0), (-0.22, 0.2 + depth / 2, 0.0), (0.12, 0.07), (1.0, 1.0, 0.6))
    body.add_pair((0.14, -0.1, 0.12), (-0.06, -0.2, body.vary(0.36)), (0.08, 0.055))


def _figure(body: Sketch) -> None:
    """Upright: trunk, head with snout and ears, arms raised, legs, feet and a thick tail."""
    girth, arms, legs = body.vary(0.2), body.vary(0.4), body.vary(0.42)
    body.add((0.0, -0.14, 0.0), (0.0, 0.2, 0.0), (1.1 * girth, girth))
    body.add((0.0, 0.3, 0.0), (0.02, 0.52, 0.0), (0.11, 0.16))
    body.add((0.06, 0.5, 0.0), (body.vary(0.26), 0.45, 0.0), (0.1, 0.065))
    body.add_pair((0.0, 0.6, 0.1), (-0.03, 0.76, 0.18), (0.06, 0.05))
    body.add_pair((0.0, 0.24, 0.16), (0.1, 0.12, arms), (0.09, 0.08))
    body.add_pair((0.1, 0.12, arms), (0.2, 0.12 + 0.6 * arms, arms + 0.06), (0.08, 0.075))
    body.add_pair((0.0, -0.22, 0.12), (0.04, -0.22 - legs, 0.19), (0.13, 0.09))
    body.add_pair((0.04, -0.23 - legs, 0.19), (0.2, -0.24 - legs, 0.21), 0.075)
    body.add((-0.14, -0.2, 0.0), (-body.vary(0.48), -0.44, 0.0), (0.12, 0.06))


def _bird(body: Sketch) -> None:
    """Body, head with beak, spread wings, fan tail and two short legs."""
    girth, span, lift = body.vary(0.19), body.vary(0.66), float(body.generator.uniform(-0.05, 0.25))
    body.add((-0.2, 0.0, 0.0), (0.2, 0.08, 0.0), girth)
    body.add((0.28, 0.16, 0.0), (0.38, 0.28, 0.0), (0.12, 0.14))
    body.add((0.46, 0.27, 0.0), (0.62, 0.24, 0.0), (0.07, 0.045))
    body.add_pair((0.04, 0.1, 0.12), (-0.14, 0.1 + lift, span), (0.17, 0.09), (1.0, 0.5, 1.0))
    body.add((-0.3, 0.0, 0.0), (-body.vary(0.62), 0.05, 0.0), (0.15, 0.12), (1.0, 0.5, 1.0))
    body.add_pair((0.0, -0.14, 0.09), (0.03, -0.38, 0.1), 0.06)


CREATURES: dict[str, Callable[[Sketch], None]] = {
    "quadruped": _quadruped,
    "rabbit": _rabbit,
    "fish": _fish,
    "figure": _figure,
    "bird": _bird,
}
"""Body plans by name."""


def draw_creature(name: str, *, size: float, generator: np.random.Generator) -> Shape:
    """Draw one individual.

    Args:
        name: A key of ``CREATURES``.
        size: Longest edge of its bounding box [m].
        generator: Source of its proportions.

    Returns:
        The closed shape.
    """
    sketch = Sketch(generator=generator)
    CREATURES[name](sketch)
    parts = sketch.parts
    reach = np.max([part.reach() for part in parts], axis=0) + BLEND * np.log(len(parts))
    level, extent = recentred(_melted(parts), reach, size=size, axis=None)
    return Shape(
        name=name,
        level=level,
        extent=tuple(extent.tolist()),
        parameters={
            "parts": [[*part.start, *part.end, *part.radii, *part.stretch] for part in parts],
            "blend": BLEND,
        },
    )


def _melted(parts: list[Part]) -> Level:
    def level(points: np.ndarray) -> np.ndarray:
        return smooth_minimum(np.stack([part.level(points) for part in parts], axis=1), BLEND)

    return level
