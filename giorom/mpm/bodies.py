"""Draw the bodies of a scene: shape, filling, place, material and motion of each.

``draw_bodies`` is what ``scenes.py`` puts together into a ``Scene``. Shape, filling, place
with motion, number and material come from independent random streams of one seed, so that
another range of one does not change the others. Bodies lie inside the walls, and no two
bounding boxes come nearer to each other than two particle spacings (about one grid cell).

Metres and seconds; NumPy only.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from giorom.mpm.mesh import load_mesh_shape
from giorom.mpm.motion import clamped_velocity, thrown_velocity
from giorom.mpm.scene_config import SceneConfig
from giorom.mpm.shape_library import SHAPES, Proportions, draw_shape
from giorom.mpm.shapes import Shape, fill, volume_of

GAP = 2.0
"""Smallest distance between the bounding boxes of two bodies [spacing]."""

TRIES = 2000
"""Places drawn for a body before the scene counts as full."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """One filled body, placed and moving."""

    shape: Shape
    """What was filled."""

    center: Float[np.ndarray, " d"]
    """Middle of its bounding box [m]."""

    position: Float[np.ndarray, "p d"]
    """Particles [m]."""

    velocity: Float[np.ndarray, "p d"]
    """Their velocities [m/s]."""

    gradient: Float[np.ndarray, "d d"]
    """Velocity gradient of all of them [1/s]."""

    spacing: float
    """Distance of neighbouring particles [m]."""

    volume: float
    """Volume of each particle [m^d]."""

    choice: int
    """Number of its material: 0 is ``SceneConfig.material``, then the mixture in order."""

    kinematic: Bool[np.ndarray, " p"]
    """Which are held."""

    clamp_plane: float | None
    """Particles at or below this height are held [m]; None: no clamp."""

    motion: dict[str, Any]
    """What was drawn of the motion, as JSON values."""

    @property
    def attributes(self) -> dict[str, Any]:
        """What was drawn, as JSON values."""
        return {
            "shape": self.shape.name,
            "shape_extent": list(self.shape.extent),
            "shape_parameters": self.shape.parameters,
            "spacing": self.spacing,
            "initial_motion": self.motion,
        }


def draw_bodies(config: SceneConfig, *, seed: int, shape: str | None = None) -> list[Body]:
    """Draw every body of one scene.

    Args:
        config: The family.
        seed: Number of the scene; the same seed gives the same bodies.
        shape: Name of a shape, held-out ones too, or path of a closed mesh file, for every
            body in place of a drawn name.

    Returns:
        The bodies, in the order in which they were placed.

    Raises:
        ValueError: If the shape is unknown or unusable, a body reaches beyond the walls, or
            finds no place apart from the others.
    """
    shapes, fillings, motions, numbers, choices = (
        np.random.default_rng([seed, stream]) for stream in range(5)
    )
    bodies: list[Body] = []
    for _ in range(int(numbers.integers(config.bodies[0], config.bodies[1] + 1))):
        body = _draw_shape(config, shape, shapes)
        spacing = _spacing(config, body)
        local, volume = fill(body, spacing=spacing, generator=fillings)
        center = _place(config, body, bodies, motions)
        start = _clamped if config.family == "clamped" else _thrown
        bodies.append(
            Body(
                shape=body,
                center=center,
                position=local + center,
                spacing=spacing,
                volume=volume,
                choice=int(choices.integers(1 + len(config.mixture))),
                **start(config, body, local + center, motions),
            )
        )
    return bodies


def _clamped(
    config: SceneConfig, body: Shape, position: np.ndarray, generator: np.random.Generator
) -> dict[str, Any]:
    """Held part and motion of a body that stands on its clamp."""
    # At least one layer of particles is held, however flat the body is.
    spacing = _spacing(config, body)
    held = max(config.clamped_fraction * body.extent[1], spacing)
    clamp_plane = config.base_height + held
    kinematic = position[:, 1] <= clamp_plane
    if bool(kinematic.all()):
        raise ValueError(
            f"shape {body.name} is {body.extent[1]:.3g} m high and all of it is clamped at "
            f"spacing {spacing:g} m. Lower SceneConfig.spacing or clamped_fraction."
        )
    velocity, drawn = clamped_velocity(
        position,
        clamp_plane=clamp_plane,
        impulses=config.impulses,
        top_speed=float(generator.uniform(*config.speed_range)),
        generator=generator,
    )
    return {
        "kinematic": kinematic,
        "clamp_plane": clamp_plane,
        "velocity": velocity,
        "gradient": np.zeros((config.dimension, config.dimension)),
        "motion": drawn,
    }


def _thrown(
    config: SceneConfig, body: Shape, position: np.ndarray, generator: np.random.Generator
) -> dict[str, Any]:
    """Motion of a body that flies."""
    del body  # only a clamp depends on the shape
    velocity, gradient, drawn = thrown_velocity(
        position,
        speed=float(generator.uniform(*config.speed_range)),
        spin=float(generator.uniform(*config.spin_range)),
        generator=generator,
    )
    return {
        "kinematic": np.zeros(len(position), dtype=bool),
        "clamp_plane": None,
        "velocity": velocity,
        "gradient": gradient,
        "motion": drawn,
    }


def _draw_shape(config: SceneConfig, shape: str | None, generator: np.random.Generator) -> Shape:
    name = str(generator.choice(config.shapes)) if shape is None else shape
    height = float(generator.uniform(*config.height_range))
    if Path(name).suffix and name not in SHAPES:
        if config.dimension != 3:
            raise ValueError(f"mesh {name} is a 3-D body and this scene is 2-D. Name a 2-D shape.")
        return load_mesh_shape(name, size=height)
    wanted = Proportions(
        height=height, dimension=config.dimension, slenderness=tuple(config.slenderness)
    )
    return draw_shape(name, wanted, generator=generator)


def _spacing(config: SceneConfig, body: Shape) -> float:
    """Distance of neighbouring particles in a body [m]."""
    if config.points is None:
        return config.spacing
    return (volume_of(body) / config.points) ** (1.0 / config.dimension)


def _place(
    config: SceneConfig, body: Shape, others: list[Body], generator: np.random.Generator
) -> np.ndarray:
    """Where the centre of the body's bounding box goes, apart from the others [m]."""
    for _ in range(TRIES):
        center = _center(config, body, generator)
        _require_inside(config, body, center)
        if all(_apart(body, center, other) for other in others):
            return center
    raise ValueError(
        f"body {len(others) + 1} of a scene, a {body.name} of "
        f"{' x '.join(f'{edge:.3g}' for edge in body.extent)} m, found no place apart from the "
        f"others in {TRIES} draws. Lower SceneConfig.bodies or height_range, or widen placement."
    )


def _apart(body: Shape, center: np.ndarray, other: Body) -> bool:
    """Whether two bounding boxes keep their distance along some axis."""
    reach = 0.5 * (np.array(body.extent) + np.array(other.shape.extent))
    return bool((np.abs(center - other.center) >= reach + GAP * other.spacing).any())


def _center(config: SceneConfig, body: Shape, generator: np.random.Generator) -> np.ndarray:
    """One draw of the centre of the body's bounding box [m]."""
    half = 0.5 * np.array(body.extent)
    if config.family == "clamped":
        center = np.full(config.dimension, 0.5)
        center[1] = config.base_height + half[1]
        return center
    lower, upper = config.wall + half, 1.0 - config.wall - half
    if config.placement is not None:
        first, last = np.array(config.placement, dtype=float).T
        # A large body keeps to the part of the range where it fits, if there is one.
        fits = np.maximum(first, lower) <= np.minimum(last, upper)
        lower = np.where(fits, np.maximum(first, lower), first)
        upper = np.where(fits, np.minimum(last, upper), last)
    return lower + generator.uniform(0.0, 1.0, config.dimension) * (upper - lower)


def _require_inside(config: SceneConfig, body: Shape, center: np.ndarray) -> None:
    half = 0.5 * np.array(body.extent)
    below, above = config.wall - (center - half), center + half - (1.0 - config.wall)
    beyond = np.maximum(below, above)
    axis = int(beyond.argmax())
    if beyond[axis] > 1e-9:
        side = "lower" if below[axis] >= above[axis] else "upper"
        remedy = "base_height" if config.family == "clamped" else "placement"
        raise ValueError(
            f"shape {body.name} reaches {beyond[axis]:.3g} m beyond the {side} wall of axis "
            f"{axis} (walls at {config.wall:g} and {1.0 - config.wall:g} m). Lower "
            f"SceneConfig.height_range or wall, or change {remedy}."
        )
