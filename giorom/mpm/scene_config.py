"""How a random scene is drawn: the record, its rules and three ready-made families.

The first stage of the pipeline reads it; ``scenes.py`` turns it and a seed into a ``Scene``.
Two families:

``clamped``
    A body stands upright on its clamp in still air (no gravity unless asked for). Its lowest
    part is kinematic; an initial velocity that vanishes at the clamp sets it swinging.
``thrown``
    One or several bodies, each of one of several materials, start at random places in the box,
    apart from each other, with random velocities and spins, and fall.

The domain is the unit box, axis 1 points up. SI units.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from giorom.mpm.materials import make_material
from giorom.mpm.motion import IMPULSES
from giorom.mpm.shape_library import SHAPES, require_shape
from giorom.state import KINEMATIC, PARTICLE_TYPE_COUNT

MOST_BODIES = 64
"""Most bodies of one scene; more do not fit apart into the box."""

GRAVITY = 9.8
"""Standard choice of the reference data sets [m/s^2]."""


WallContact = Literal["slip", "stick"]
"""Friction of the walls: none, or without limit."""


@dataclass(frozen=True, kw_only=True)
class MaterialChoice:
    """A further material a body may be made of."""

    material: str
    """Name of a material, see ``giorom.mpm.materials.MATERIALS``."""

    material_parameters: dict[str, float | bool]
    """Parameters of the material, SI."""

    particle_type: int | None = None
    """Particle type that the model sees; null: the one of the material."""

    def __post_init__(self) -> None:
        """Reject what is no material, and types no embedding has."""
        make_material(self.material, self.material_parameters)
        if self.particle_type is not None and (
            self.particle_type == KINEMATIC or not 0 <= self.particle_type < PARTICLE_TYPE_COUNT
        ):
            raise ValueError(
                f"MaterialChoice.particle_type must be 0 to {PARTICLE_TYPE_COUNT - 1} and not "
                f"{KINEMATIC} (held particles), got {self.particle_type!r}."
            )


@dataclass(frozen=True, kw_only=True)
class SwitchChoice:
    """A change of the first material during the run, as when a body melts."""

    frame: int
    """Stored frame from which the new material holds; 0 is the initial one."""

    material: str
    """Name of the new material."""

    material_parameters: dict[str, float | bool]
    """Its parameters, SI."""

    def __post_init__(self) -> None:
        """Reject what is no material and no frame of a run."""
        make_material(self.material, self.material_parameters)
        if self.frame < 1:
            raise ValueError(
                f"SwitchChoice.frame must be at least 1 (before that the body simply is of the "
                f"new material), got {self.frame!r}."
            )


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How a random scene is drawn."""

    family: Literal["clamped", "thrown"]
    """``clamped``: stands on its clamp and swings. ``thrown``: starts anywhere and falls."""

    dimension: int
    """2 (plane strain) or 3."""

    material: str
    """Name of a material, see ``giorom.mpm.materials.MATERIALS``."""

    material_parameters: dict[str, float | bool]
    """Parameters of the material, SI."""

    shapes: list[str]
    """Names of the shapes to draw from."""

    held_out_shapes: list[str] = field(default_factory=list)
    """Shapes kept for testing: never drawn, only on request."""

    height_range: list[float]
    """Smallest and largest height of the body [m]; of a mesh or creature, its longest edge."""

    spacing: float | None = None
    """Distance of neighbouring particles [m], about half a grid cell; exactly one of ``spacing``
    and ``points`` is set."""

    points: int | None = None
    """Particles of each body, about: the spacing follows from its volume."""

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

    wall_contact: WallContact = "slip"
    """``slip``: walls without friction. ``stick``: nothing pressed on a wall slides along it."""

    placement: list[list[float]] | None = None
    """Range of the centre on each axis of a thrown body [m]; null: wherever it fits."""

    base_height: float = 0.125
    """Height at which a clamped body stands [m]."""

    clamped_fraction: float = 0.1
    """Part of the height of a clamped body that is held [-]."""

    impulses: list[str] = field(default_factory=lambda: list(IMPULSES))
    """Parts of the initial motion of a clamped body: bend, sway, twist, axial."""

    bodies: list[int] = field(default_factory=lambda: [1, 1])
    """Fewest and most bodies of a thrown scene; no two bounding boxes come nearer than a cell."""

    mixture: list[MaterialChoice] = field(default_factory=list)
    """Further materials of a thrown scene; each body is of one of them or of ``material``."""

    switch: SwitchChoice | None = None
    """Change of ``material`` during the run; null: none."""

    def __post_init__(self) -> None:
        """Reject what no scene can be drawn from."""
        if self.dimension not in (2, 3):
            raise ValueError(f"SceneConfig.dimension must be 2 or 3, got {self.dimension!r}.")
        if self.family not in ("clamped", "thrown"):
            raise ValueError(
                f"SceneConfig.family must be 'clamped' or 'thrown', got {self.family!r}."
            )
        if self.wall_contact not in ("slip", "stick"):
            raise ValueError(
                f"SceneConfig.wall_contact must be 'slip' or 'stick', got {self.wall_contact!r}."
            )
        make_material(self.material, self.material_parameters)
        self._check_shapes()
        for name in ("height_range", "slenderness", "speed_range", "spin_range"):
            self._check_range(name, getattr(self, name))
        self._check_filling()
        if not 0.0 <= self.gravity < float("inf"):
            raise ValueError(
                f"SceneConfig.gravity points down and must be >= 0 m/s^2, got {self.gravity!r}."
            )
        if not 0.0 < self.wall < 0.5:
            raise ValueError(
                f"SceneConfig.wall is a distance from the side of the unit box and must lie "
                f"between 0 and 0.5 m, got {self.wall!r}."
            )
        if not 0.0 <= self.base_height < 1.0:
            raise ValueError(
                f"SceneConfig.base_height is a height in the unit box and must lie between 0 and "
                f"1 m, got {self.base_height!r}."
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
        self._check_bodies()

    def _check_filling(self) -> None:
        if (self.spacing is None) == (self.points is None):
            raise ValueError(
                f"SceneConfig needs exactly one of spacing and points, got spacing="
                f"{self.spacing!r} and points={self.points!r}."
            )
        if self.spacing is not None and not 0.0 < self.spacing < float("inf"):
            raise ValueError(f"SceneConfig.spacing must be > 0 m, got {self.spacing!r}.")
        if self.points is not None and self.points < 1:
            raise ValueError(f"SceneConfig.points must be >= 1, got {self.points!r}.")

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
        if not all(-math.inf < low <= high < math.inf for low, high in self.placement):
            raise ValueError(
                f"SceneConfig.placement must be finite with lowest <= highest on each axis, got "
                f"{self.placement!r}."
            )

    def _check_bodies(self) -> None:
        if len(self.bodies) != 2 or not 1 <= self.bodies[0] <= self.bodies[1] <= MOST_BODIES:
            raise ValueError(
                f"SceneConfig.bodies must be [fewest, most] with 1 <= fewest <= most <= "
                f"{MOST_BODIES}, got {self.bodies!r}."
            )
        if self.family == "clamped" and (self.bodies != [1, 1] or self.mixture):
            raise ValueError(
                "a clamped scene has one body of one material; SceneConfig.bodies and mixture "
                "are for thrown ones. Set family: thrown, or remove them."
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
