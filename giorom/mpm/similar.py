"""The same scene in other units of length, so that any box and any cell fit the unit box.

Time is kept. Lengths, velocities and gravity change by one factor, stresses per density by its
square, and every particle does the same in its own units: a similarity, no approximation. It is
what lets a scene run on a grid whose cells do not divide the unit box, with the walls on nodes.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.boundary import WALL_CELLS, walls_of
from giorom.mpm.materials import Material
from giorom.mpm.scene import Scene

STRESSES = ("youngs_modulus", "bulk_modulus", "yield_stress", "viscosity")
"""Parameters of materials that are a stress, or a stress by a time."""

SAME = ("density", "poissons_ratio", "friction_angle", "cohesion_strain", "volume_correction")
"""Parameters that no length changes; the density because mass follows the volume."""

FEWEST_CELLS = 8
"""Fewest cells of a grid, as ``SolverConfig`` has it."""


@dataclass(frozen=True, kw_only=True)
class Similar:
    """A scene in the unit box of a grid, and the way back."""

    scene: Scene
    """The scene in the units of the grid."""

    grid_cells: int
    """Cells per axis of the unit box."""

    factor: float
    """Length in the units of the grid over length in metres."""

    origin: Float[Tensor, " d"]
    """Where the corner of the unit box lies [m]."""

    def metres(self, position: Float[Tensor, "*n d"]) -> Float[Tensor, "*n d"]:
        """Positions in metres from those in the units of the grid."""
        return position / self.factor + self.origin.to(position)


def on_cells(scene: Scene, *, grid_cells: int, coarsening: float) -> Similar:
    """A scene with its walls where a grid has them, on a grid of larger cells.

    The lower walls lie on nodes, or the clamp plane if there is one; an upper wall on the next
    node outside.

    Args:
        scene: The scene in the unit box.
        grid_cells: Cells per axis of the finer grid.
        coarsening: Cells of the finer grid along one cell.

    Raises:
        ValueError: If the cells would not get larger or stay the same.
    """
    if not coarsening >= 1.0:
        raise ValueError(f"coarsening must be >= 1, got {coarsening!r}.")
    cell = coarsening / grid_cells
    walls = walls_of(scene, grid_cells)
    low, high = walls.planes.unbind(dim=1)
    origin = low - WALL_CELLS * cell
    if walls.clamp_plane is not None:
        below = math.ceil((walls.clamp_plane - float(low[1])) / cell - 1e-6) + WALL_CELLS
        origin[1] = walls.clamp_plane - below * cell
    upper = ((high - origin) / cell - 1e-6).ceil().max()
    cells = max(int(upper) + WALL_CELLS, FEWEST_CELLS)
    factor = 1.0 / (cells * cell)
    moved = replace(
        scene,
        position=((scene.position.double() - origin) * factor).float(),
        velocity=scene.velocity * factor,
        volume=scene.volume * factor ** scene.position.shape[1],
        bounds=(torch.stack([low, high], dim=1) - origin[:, None]) * factor,
        gravity=scene.gravity * factor,
        materials=tuple(_scaled(material, factor) for material in scene.materials),
        clamp_plane=(
            None if walls.clamp_plane is None else (walls.clamp_plane - float(origin[1])) * factor
        ),
        switch=(
            None
            if scene.switch is None
            else replace(scene.switch, material=_scaled(scene.switch.material, factor))
        ),
    )
    return Similar(scene=moved, grid_cells=cells, factor=factor, origin=origin)


def _scaled(material: Material, factor: float) -> Material:
    """A material whose waves are faster by a factor."""
    names = [field.name for field in fields(material)]
    unknown = sorted(set(names) - {*STRESSES, *SAME})
    if unknown:
        raise ValueError(
            f"material {material.name} has the parameter {unknown[0]}, of which "
            f"giorom.mpm.similar does not know how it changes with the unit of length. Add it."
        )
    changed = {name: getattr(material, name) * factor**2 for name in names if name in STRESSES}
    return replace(material, **changed)
