"""Walls of the box and the clamp plane, as nodes of the grid.

Walls are separating: they act on nodes at or beyond a wall plane whose velocity points into
the wall, and let go of what moves off. A *slip* wall sets the component that points into it to
zero and leaves the others alone (no friction). A *stick* wall sets the whole velocity to zero
(no slip; friction without limit), as a rough floor does under a pile of sand; it still
separates, because grains do not hang from a ceiling nor cling to a side wall. Up to the first
row of nodes at the clamp plane (at most a quarter cell below it) the whole velocity is zero:
were a row of nodes free among held particles, which carry no strain, the body would tear off
its own clamp (measured on a bar when that row lies 0.44 cells below the plane; not at 0.25).

A wall acts through the grid, so its plane is a plane of nodes: the effective plane is the
nearest one that is not inside the box asked for. By the width of the spline a particle that
is pressed on can come up to half a cell beyond it. Metres; the box is ``[0, 1]^d``.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.scene import Scene

WALL_TOLERANCE = 0.6
"""How far a particle may be pressed beyond an effective wall plane [cells]."""

WALL_CELLS = 2
"""Fewest cells between the box and a wall: three rows of nodes stop what moves outwards."""

CLAMP_TOLERANCE = 0.25
"""How far the last sticky row of nodes may be below the clamp plane [cells]."""


@dataclass(frozen=True, kw_only=True)
class Walls:
    """Wall and clamp nodes of one scene on one grid."""

    grid_cells: int
    """Cells per axis."""

    lower: tuple[int, ...]
    """Last blocked node at the lower wall of each axis."""

    upper: tuple[int, ...]
    """First blocked node at the upper wall of each axis."""

    sticking: bool
    """Whether a wall stops sliding too: the whole velocity that points into it is lost."""

    clamp_node: int
    """Last sticky node of axis 1, the first at the clamp plane; -1 without a clamp."""

    @property
    def clamp_plane(self) -> float | None:
        """Effective clamp plane: nothing at or below it moves [m]; None without a clamp."""
        return None if self.clamp_node < 0 else self.clamp_node / self.grid_cells

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
        clamp_node = math.ceil(scene.clamp_plane * grid_cells - CLAMP_TOLERANCE)
    return Walls(
        grid_cells=grid_cells,
        lower=lower,
        upper=upper,
        sticking=scene.wall_contact == "stick",
        clamp_node=clamp_node,
    )
