"""Walls of the box and the clamp plane, as nodes of the grid.

Walls are frictionless and separating: on every node at or beyond a wall plane the component
of velocity that points into the wall is set to zero, the others are left alone. On nodes at
or below the clamp plane the whole velocity is zero.

A wall acts through the grid, so its plane is a plane of nodes: the effective plane is the
nearest one that is not inside the box asked for. By the width of the spline a particle that
is pressed on can come up to half a cell beyond it. Metres; the box is ``[0, 1]^d``.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.scenes import Scene

WALL_TOLERANCE = 0.6
"""How far a particle may be pressed beyond an effective wall plane [cells]."""

WALL_CELLS = 2
"""Fewest cells between the box and a wall: three rows of nodes stop what moves outwards."""


@dataclass(frozen=True, kw_only=True)
class Walls:
    """Wall and clamp nodes of one scene on one grid."""

    grid_cells: int
    """Cells per axis."""

    lower: tuple[int, ...]
    """Last blocked node at the lower wall of each axis."""

    upper: tuple[int, ...]
    """First blocked node at the upper wall of each axis."""

    clamp_node: int
    """Last sticky node of axis 1; -1 without a clamp."""

    @property
    def planes(self) -> Float[Tensor, "d 2"]:
        """Effective lower and upper wall plane of each axis [m]."""
        nodes = torch.tensor([self.lower, self.upper], dtype=torch.float64)
        return nodes.T / self.grid_cells

    def outside(self, position: Float[Tensor, "p d"]) -> float:
        """How far the worst particle is beyond a wall plane; negative if all are inside [m]."""
        planes = self.planes
        below = planes[:, 0] - position.double()
        above = position.double() - planes[:, 1]
        return float(torch.maximum(below, above).max())

    def require_inside(self, position: Float[Tensor, "p d"]) -> None:
        """Reject a start that is not finite or beyond the walls.

        Raises:
            ValueError: Names the first bad particle and what to change.
        """
        lost = ~torch.isfinite(position).all(dim=1)
        if bool(lost.any()):
            raise ValueError(
                f"particle {int(lost.nonzero()[0])} of the scene starts at a position that is "
                f"not finite ({int(lost.sum())} in all); positions must be finite metres."
            )
        outside = self.outside(position)
        if outside > 1e-6:
            planes = ", ".join(f"{low:g} to {high:g}" for low, high in self.planes.tolist())
            raise ValueError(
                f"the scene starts {outside:.3g} m outside its walls ({planes} m). Move it, make "
                f"it smaller, or move the walls outwards."
            )


def walls_of(scene: Scene, grid_cells: int) -> Walls:
    """Find the blocked nodes of a scene's walls.

    Args:
        scene: Gives wall planes and clamp plane [m].
        grid_cells: Cells per axis of the unit box.

    Returns:
        The nodes.

    Raises:
        ValueError: If a wall is too near the side of the box for the grid.
    """
    bounds = scene.bounds.double()
    lower = tuple(math.floor(low * grid_cells + 1e-6) for low in bounds[:, 0].tolist())
    upper = tuple(math.ceil(high * grid_cells - 1e-6) for high in bounds[:, 1].tolist())
    if min(lower) < WALL_CELLS or max(upper) > grid_cells - WALL_CELLS:
        raise ValueError(
            f"the walls at {bounds.tolist()} m are nearer than {WALL_CELLS} cells "
            f"({WALL_CELLS / grid_cells:.4g} m) to a side of the unit box. Raise "
            f"SceneConfig.wall or SolverConfig.grid_cells."
        )
    clamp_node = -1
    if scene.clamp_plane is not None:
        clamp_node = math.floor(scene.clamp_plane * grid_cells + 1e-6)
    return Walls(grid_cells=grid_cells, lower=lower, upper=upper, clamp_node=clamp_node)
