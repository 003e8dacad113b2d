"""Random scenes: which body starts where, of what, and how fast.

A ``SceneConfig`` describes a family of scenes in plain values; ``draw_scene`` turns it and a
seed into one ``Scene``, always the same. SI units. This module needs no simulator.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.mpm.materials import Material, make_material, material_attributes
from giorom.mpm.mesh import load_mesh_shape
from giorom.mpm.motion import clamped_velocity, thrown_velocity
from giorom.mpm.scene_config import SceneConfig, WallContact
from giorom.mpm.shape_library import SHAPES, Proportions, draw_shape
from giorom.mpm.shapes import Shape, fill
from giorom.state import KINEMATIC


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One body, ready to simulate."""

    position: Float[Tensor, "p d"]
    """Initial positions [m]."""

    velocity: Float[Tensor, "p d"]
    """Initial velocities [m/s]."""

    affine_velocity: Float[Tensor, "p d d"]
    """Initial velocity gradient at each particle [1/s]."""

    volume: Float[Tensor, " p"]
    """Initial volume of each particle [m^d]."""

    particle_type: Int[Tensor, " p"]
    """``KINEMATIC`` for held particles, else the type of the material."""

    material: Material
    """What the body is made of."""

    bounds: Float[Tensor, "d 2"]
    """Lower and upper wall on each axis [m]."""

    wall_contact: WallContact = "slip"
    """Whether what is pressed on a wall slides along it; see ``giorom.mpm.boundary``."""

    gravity: float = 0.0
    """Downward acceleration [m/s^2]."""

    clamp_plane: float | None = None
    """Particles at or below this height are held [m]; None: no clamp."""

    attributes: dict[str, Any] = field(default_factory=dict)
    """What made it, as JSON values."""

    @property
    def kinematic(self) -> Tensor:
        """Boolean mask of the held particles, shape (p)."""
        return self.particle_type == KINEMATIC


def draw_scene(config: SceneConfig, *, seed: int, shape: str | None = None) -> Scene:
    """Draw one scene of a family.

    Shape, filling and motion use independent random streams of the same seed.

    Args:
        config: The family.
        seed: Number of the scene; the same seed gives the same scene.
        shape: Name of a shape, held-out ones too, or path of a closed mesh file, in place
            of a drawn name.

    Returns:
        The scene.

    Raises:
        ValueError: If the shape is unknown or unusable, or the body reaches beyond the walls.
    """
    streams = [np.random.default_rng([seed, stream]) for stream in range(3)]
    body = _draw_body(config, shape, streams[0])
    local, volume = fill(body, spacing=config.spacing, generator=streams[1])
    center = _center(config, body, streams[2])
    _require_inside(config, body, center)
    start = (_clamped if config.family == "clamped" else _thrown)(
        config, body, local + center, streams[2]
    )
    material = make_material(config.material, config.material_parameters)
    types = np.where(start.kinematic, KINEMATIC, material.particle_type)
    attributes = {
        "family": config.family,
        "seed": seed,
        "shape": body.name,
        "shape_extent": list(body.extent),
        "shape_parameters": body.parameters,
        "spacing": config.spacing,
        "gravity": config.gravity,
        "wall_contact": config.wall_contact,
        "clamp_plane": start.clamp_plane,
        "initial_motion": start.drawn,
    }
    return Scene(
        position=torch.from_numpy(local + center).float(),
        velocity=torch.from_numpy(start.velocity).float(),
        affine_velocity=torch.from_numpy(start.gradient).float().repeat(len(local), 1, 1),
        volume=torch.full((len(local),), volume),
        particle_type=torch.from_numpy(types),
        material=material,
        bounds=torch.tensor([[config.wall, 1.0 - config.wall]] * config.dimension),
        wall_contact=config.wall_contact,
        gravity=config.gravity,
        clamp_plane=start.clamp_plane,
        attributes=attributes | material_attributes(material),
    )


@dataclass(frozen=True, kw_only=True)
class _Start:
    """How a body starts: held part and motion."""

    kinematic: np.ndarray
    clamp_plane: float | None
    velocity: np.ndarray
    gradient: np.ndarray
    drawn: dict[str, Any]


def _clamped(
    config: SceneConfig, body: Shape, position: np.ndarray, generator: np.random.Generator
) -> _Start:
    # At least one layer of particles is held, however flat the body is.
    held = max(config.clamped_fraction * body.extent[1], config.spacing)
    clamp_plane = config.base_height + held
    kinematic = position[:, 1] <= clamp_plane
    if bool(kinematic.all()):
        raise ValueError(
            f"shape {body.name} is {body.extent[1]:.3g} m high and all of it is clamped at "
            f"spacing {config.spacing:g} m. Lower SceneConfig.spacing or clamped_fraction."
        )
    velocity, drawn = clamped_velocity(
        position,
        clamp_plane=clamp_plane,
        impulses=config.impulses,
        top_speed=float(generator.uniform(*config.speed_range)),
        generator=generator,
    )
    return _Start(
        kinematic=kinematic,
        clamp_plane=clamp_plane,
        velocity=velocity,
        gradient=np.zeros((config.dimension, config.dimension)),
        drawn=drawn,
    )


def _thrown(
    config: SceneConfig, body: Shape, position: np.ndarray, generator: np.random.Generator
) -> _Start:
    del body  # only a clamp depends on the shape
    velocity, gradient, drawn = thrown_velocity(
        position,
        speed=float(generator.uniform(*config.speed_range)),
        spin=float(generator.uniform(*config.spin_range)),
        generator=generator,
    )
    return _Start(
        kinematic=np.zeros(len(position), dtype=bool),
        clamp_plane=None,
        velocity=velocity,
        gradient=gradient,
        drawn=drawn,
    )


def _draw_body(config: SceneConfig, shape: str | None, generator: np.random.Generator) -> Shape:
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


def _center(config: SceneConfig, body: Shape, generator: np.random.Generator) -> np.ndarray:
    """Where the centre of the body's bounding box goes [m]."""
    half = 0.5 * np.array(body.extent)
    if config.family == "clamped":
        center = np.full(config.dimension, 0.5)
        center[1] = config.base_height + half[1]
        return center
    if config.placement is not None:
        lower, upper = np.array(config.placement, dtype=float).T
    else:
        lower, upper = config.wall + half, 1.0 - config.wall - half
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
