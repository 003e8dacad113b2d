"""The initial state of one simulation: particles, what they are made of, walls and gravity.

What a scene generator draws and what ``simulate`` runs. The domain is the unit box, axis 1
points up. SI units. This module needs no simulator.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.mpm.materials import Material
from giorom.mpm.scene_config import WallContact
from giorom.state import KINEMATIC


@dataclass(frozen=True, kw_only=True)
class MaterialSwitch:
    """A change of law during a run: plasticine that falls apart to sand."""

    frame: int
    """First stored frame after which the new law holds; the frame itself is of the old one."""

    material_index: int
    """Which of the scene's materials changes."""

    material: Material
    """What it becomes. The elastic strain is carried over; density stays that of the scene."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One or several bodies, ready to simulate."""

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

    materials: tuple[Material, ...]
    """What the bodies are made of."""

    material_index: Int[Tensor, " p"]
    """Index into ``materials`` of each particle, held ones too."""

    bounds: Float[Tensor, "d 2"]
    """Lower and upper wall on each axis [m]."""

    wall_contact: WallContact = "slip"
    """Whether what is pressed on a wall slides along it; see ``giorom.mpm.boundary``."""

    gravity: float = 0.0
    """Downward acceleration [m/s^2]."""

    clamp_plane: float | None = None
    """Particles at or below this height are held [m]; None: no clamp."""

    switch: MaterialSwitch | None = None
    """A change of law during the run."""

    attributes: dict[str, Any] = field(default_factory=dict)
    """What made it, as JSON values."""

    def __post_init__(self) -> None:
        """Reject particles of no material and a switch that cannot happen.

        Raises:
            ValueError: Names the index, or the two laws and what they carry.
        """
        count = len(self.materials)
        if count == 0:
            raise ValueError("Scene.materials is empty; particles must be made of something.")
        outside = (self.material_index < 0) | (self.material_index >= count)
        if bool(outside.any()):
            particle = int(outside.nonzero()[0])
            raise ValueError(
                f"particle {particle} has material_index {int(self.material_index[particle])}, "
                f"but the scene has {count} materials: give an index from 0 to {count - 1}."
            )
        if self.switch is not None:
            _require_possible(self.switch, self.materials)

    @property
    def kinematic(self) -> Tensor:
        """Boolean mask of the held particles, shape (p)."""
        return self.particle_type == KINEMATIC

    @property
    def mass(self) -> Float[Tensor, " p"]:
        """Mass of each particle [kg per m^(3 - d)], in the precision of ``volume``."""
        density = torch.tensor([each.density for each in self.materials], dtype=self.volume.dtype)
        return density[self.material_index] * self.volume

    @property
    def laws(self) -> tuple[Material, ...]:
        """Every law that holds at some time: the materials, and what one of them becomes."""
        return self.materials if self.switch is None else (*self.materials, self.switch.material)


def _require_possible(switch: MaterialSwitch, materials: tuple[Material, ...]) -> None:
    if not 0 <= switch.material_index < len(materials):
        raise ValueError(
            f"MaterialSwitch.material_index must be an index from 0 to {len(materials) - 1} into "
            f"Scene.materials, got {switch.material_index!r}."
        )
    if switch.frame < 1:
        raise ValueError(
            f"MaterialSwitch.frame must be at least 1, got {switch.frame!r}. To start with the "
            f"other material, put it into Scene.materials."
        )
    before, after = materials[switch.material_index], switch.material
    if before.state != after.state:
        raise ValueError(
            f"{before.name} carries the strain {before.state} and {after.name} carries "
            f"{after.state}: nothing tells one from the other. Switch between two solids."
        )
    if before.density != after.density:
        raise ValueError(
            f"MaterialSwitch changes the density from {before.density:g} to {after.density:g} "
            f"kg/m^3, and mass is conserved. Give both materials the same density."
        )
