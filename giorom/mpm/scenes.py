"""Random scenes: which body starts where, of what, and how fast.

A ``SceneConfig`` describes a family of scenes in plain values; ``draw_scene`` turns it and a
seed into one ``Scene``, always the same. Two families:

``clamped``
    A body stands upright on its clamp in still air (no gravity unless asked for). Its lowest
    part is kinematic; an initial velocity that vanishes at the clamp sets it swinging.
``thrown``
    A body starts at a random place in the box with a random velocity and spin, and falls.

The domain is the unit box, axis 1 points up. SI units. This module needs no simulator.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.mpm.materials import Material, make_material, material_attributes
from giorom.mpm.mesh import load_mesh_shape
from giorom.mpm.motion import IMPULSES, clamped_velocity, thrown_velocity
from giorom.mpm.shape_library import SHAPES, Proportions, draw_shape, require_shape
from giorom.mpm.shapes import Shape, fill
from giorom.state import KINEMATIC

GRAVITY = 9.8
"""Standard choice of the reference data sets [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How a random scene is drawn."""

    family: Literal["clamped", "thrown"]
    """``clamped``: stands on its clamp and swings. ``thrown``: starts anywhere and falls."""

    dimension: int
    """2 (plane strain) or 3."""

    material: str
    """Name of a material, see ``giorom.mpm.materials.MATERIALS``."""

    material_parameters: dict[str, float]
    """Parameters of the material, SI."""

    shapes: list[str]
    """Names of the shapes to draw from."""

    held_out_shapes: list[str] = field(default_factory=list)
    """Shapes kept for testing: never drawn, only on request."""

    height_range: list[float]
    """Smallest and largest height of the body [m]; of a mesh, its longest edge."""

    spacing: float
    """Distance of neighbouring particles [m]; about half a grid cell."""

    speed_range: list[float]
    """Range of the initial speed [m/s]; clamped: of the fastest particle."""

    spin_range: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Range of the initial angular speed of a thrown body [rad/s]."""

    slenderness: list[float] = field(default_factory=lambda: [0.5, 0.8])
    """Range of width over height of a drawn body [-]."""

    gravity: float = 0.0
    """Downward acceleration [m/s^2]; 0 turns it off."""

    wall: float = 0.0625
    """Distance of the walls from the sides of the unit box [m]; two grid cells or more."""

    placement: list[list[float]] | None = None
    """Range of the centre on each axis of a thrown body [m]; null: wherever it fits."""

    base_height: float = 0.125
    """Height at which a clamped body stands [m]."""

    clamped_fraction: float = 0.1
    """Part of the height of a clamped body that is held [-]."""

    impulses: list[str] = field(default_factory=lambda: list(IMPULSES))
    """Parts of the initial motion of a clamped body: bend, sway, twist, axial."""

    def __post_init__(self) -> None:
        """Reject what no scene can be drawn from."""
        if self.dimension not in (2, 3):
            raise ValueError(f"SceneConfig.dimension must be 2 or 3, got {self.dimension!r}.")
        if self.family not in ("clamped", "thrown"):
            raise ValueError(
                f"SceneConfig.family must be 'clamped' or 'thrown', got {self.family!r}."
            )
        make_material(self.material, self.material_parameters)
        self._check_shapes()
        for name in ("height_range", "slenderness", "speed_range", "spin_range"):
            self._check_range(name, getattr(self, name))
        if not 0.0 < self.spacing < float("inf"):
            raise ValueError(f"SceneConfig.spacing must be > 0 m, got {self.spacing!r}.")
        if not 0.0 <= self.gravity < float("inf"):
            raise ValueError(
                f"SceneConfig.gravity points down and must be >= 0 m/s^2, got {self.gravity!r}."
            )
        if not 0.0 < self.wall < 0.5:
            raise ValueError(
                f"SceneConfig.wall is a distance from the side of the unit box and must lie "
                f"between 0 and 0.5 m, got {self.wall!r}."
            )
        if not 0.0 < self.clamped_fraction < 1.0:
            raise ValueError(
                f"SceneConfig.clamped_fraction must lie between 0 and 1, got "
                f"{self.clamped_fraction!r}."
            )
        if not self.impulses or not set(self.impulses) <= set(IMPULSES):
            raise ValueError(
                f"SceneConfig.impulses must name at least one of {', '.join(IMPULSES)}, got "
                f"{self.impulses!r}."
            )
        self._check_placement()

    def _check_shapes(self) -> None:
        if not self.shapes:
            raise ValueError(
                f"SceneConfig.shapes is empty, a scene needs at least one. Shapes: "
                f"{', '.join(SHAPES)}."
            )
        for name in [*self.shapes, *self.held_out_shapes]:
            require_shape(name, self.dimension)
        both = sorted(set(self.shapes) & set(self.held_out_shapes))
        if both:
            raise ValueError(
                f"SceneConfig.held_out_shapes are kept for testing and must not be in shapes "
                f"too, got {', '.join(both)} in both. Drop them from one list."
            )

    def _check_range(self, name: str, values: list[float]) -> None:
        if len(values) != 2 or not 0.0 <= values[0] <= values[1] < float("inf"):
            raise ValueError(
                f"SceneConfig.{name} must be [lowest, highest] with 0 <= lowest <= highest, got "
                f"{values!r}."
            )
        if name in ("height_range", "slenderness") and values[0] == 0.0:
            raise ValueError(f"SceneConfig.{name} must start above 0, got {values!r}.")

    def _check_placement(self) -> None:
        if self.placement is None:
            return
        if len(self.placement) != self.dimension or any(len(pair) != 2 for pair in self.placement):
            raise ValueError(
                f"SceneConfig.placement must be one [lowest, highest] for each of the "
                f"{self.dimension} axes, got {self.placement!r}."
            )


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


ELASTIC3D = SceneConfig(
    family="clamped",
    dimension=3,
    material="stable_neo_hookean",
    material_parameters={"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.2},
    shapes=["box", "ellipsoid", "superquadric", "cylinder", "cone", "stack"],
    held_out_shapes=["capsule", "torus", "blob", "sphere"],
    height_range=[0.24, 0.38],
    spacing=1.0 / 64.0,
    speed_range=[0.7, 1.7],
)
"""Clamped elastic bodies on a grid of 32 cells; frames of 5 ms show 1-4 swings in 150."""

WATER2D = SceneConfig(
    family="thrown",
    dimension=2,
    material="weakly_compressible_fluid",
    material_parameters={"density": 1000.0, "bulk_modulus": 4e5},
    shapes=["box"],
    held_out_shapes=["disc", "blob"],
    height_range=[0.1, 0.27],
    slenderness=[0.5, 1.3],
    spacing=1.0 / 128.0,
    speed_range=[0.0, 0.7],
    gravity=GRAVITY,
    wall=13.0 / 128.0,
)
"""One drop of water on a grid of 128 cells; frames of 2.5 ms."""

JELLY3D = SceneConfig(
    family="thrown",
    dimension=3,
    material="stable_neo_hookean",
    material_parameters={"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.2},
    shapes=["box", "ellipsoid", "superquadric", "cylinder", "stack"],
    held_out_shapes=["capsule", "torus", "blob"],
    height_range=[0.24, 0.38],
    spacing=1.0 / 64.0,
    speed_range=[0.0, 3.0],
    spin_range=[0.0, 3.0],
    slenderness=[0.6, 1.0],
    gravity=GRAVITY,
)
"""A bouncing elastic body on a grid of 32 cells; frames of 5 ms."""
