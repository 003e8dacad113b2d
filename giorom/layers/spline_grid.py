"""A background grid with quadratic B-splines: mass and momentum between points and nodes.

Every point touches the 3^d nodes around it. The weights are positive and add up to one, and the
offsets of the nodes, weighted so, add up to zero: sums over points that are handed to the nodes
and back keep mass, momentum and angular momentum.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MARGIN = 3
"""Nodes beyond each wall, so that every point near a wall finds its neighbours."""

Array = TypeVar("Array", Tensor, np.ndarray)


def spline_weights(place: Array) -> tuple[Array, Array, Array]:
    """Quadratic B-spline weights of three nodes in a row.

    Args:
        place: Distance from the first of them, in [0.5, 1.5] node distances.
    """
    return 0.5 * (1.5 - place) ** 2, 0.75 - (place - 1.0) ** 2, 0.5 * (place - 0.5) ** 2


MOST_NODES = 1 << 24
"""Largest grid of one scene, 256 nodes along each of three axes; refused before it is laid out."""


@dataclass(frozen=True, kw_only=True)
class Stencil:
    """The nodes that some points touch."""

    node: Int[Tensor, "q k"]
    """Running number of each node, scenes behind one another."""

    weight: Float[Tensor, "q k"]
    """Share of the point that each node gets; adds up to one."""

    offset: Float[Tensor, "q k d"]
    """From the point to the node [m]."""


class SplineGrid:
    """A regular grid over a box, the same for every scene of a batch.

    Args:
        bounds: Lower and upper wall on each axis [m]; the lower walls lie on nodes.
        spacing: Distance between nodes [m].

    Raises:
        ValueError: If it would have more than ``MOST_NODES`` nodes, or not one cell.
    """

    def __init__(self, bounds: Float[Tensor, "d 2"], *, spacing: float) -> None:
        self.spacing, self.dimension = spacing, len(bounds)
        cells = torch.ceil((bounds[:, 1] - bounds[:, 0]) / spacing - 1e-3)
        _require_size(bounds, cells, spacing=spacing)
        cells = cells.long()
        self.origin = bounds[:, 0] - MARGIN * spacing
        self.shape = (cells + 1 + 2 * MARGIN).tolist()

    # A grid is made for every frame, and the kernels need none of what follows: it is computed
    # when it is first asked for.

    @cached_property
    def stride(self) -> Int[Tensor, " d"]:
        """How far the running numbers of two neighbours on each axis are apart."""
        strides = torch.tensor([1, *self.shape[::-1]][:-1], device=self.origin.device).cumprod(0)
        return strides.flip(0)

    @cached_property
    def corner(self) -> Int[Tensor, "k d"]:
        """Offsets 0 to 2 on each axis of the nodes that a point touches."""
        row = torch.arange(3, device=self.origin.device)
        return torch.cartesian_prod(*[row] * self.dimension)

    @cached_property
    def last_base(self) -> Float[Tensor, " d"]:
        """Last node on each axis that can be the first of three."""
        return self.origin.new_tensor(self.shape) - 3

    @property
    def node_count(self) -> int:
        """Nodes of one scene."""
        return math.prod(self.shape)

    @cached_property
    def node_position(self) -> Float[Tensor, "n d"]:
        """Places of the nodes of one scene [m]."""
        like = {"dtype": self.origin.dtype, "device": self.origin.device}
        axes = [torch.arange(n, **like) for n in self.shape]
        return self.origin + torch.cartesian_prod(*axes) * self.spacing

    @property
    def inverse_moment(self) -> float:
        """Inverse of the second moment of the weights, the same on every axis [1/m^2]."""
        return 4.0 / self.spacing**2

    def stencil(self, position: Float[Tensor, "q d"], batch: Int[Tensor, " q"]) -> Stencil:
        """Nodes, weights and offsets of points.

        Args:
            position: Points [m]; those beyond the margin touch the outermost nodes, those that
                are not finite some node, with weights that are not finite.
            batch: Scene of each point.

        Returns:
            A stencil of 3^d nodes for each point.
        """
        place = (position - self.origin) / self.spacing
        base = torch.floor(place.detach() - 0.5).nan_to_num(0.0).clamp_min(0.0)
        base = torch.minimum(base, self.last_base)
        f = (place - base).clamp(0.5, 1.5)
        each = torch.stack(spline_weights(f), dim=-1)
        weight = each[:, 0]
        for axis in range(1, self.dimension):
            weight = (weight[:, :, None] * each[:, axis, None, :]).flatten(1)
        first = (base.long() * self.stride).sum(dim=1) + batch * self.node_count
        node = first[:, None] + (self.corner * self.stride).sum(dim=1)
        offset = (self.corner.to(f) - f[:, None, :]) * self.spacing
        return Stencil(node=node, weight=weight, offset=offset)

    def gather(
        self, stencil: Stencil, value: Float[Tensor, "q k c"], *, scenes: int
    ) -> Float[Tensor, "n c"]:
        """Sum what the points give to their nodes.

        Args:
            stencil: Nodes of the points.
            value: What each point gives to each of its nodes.
            scenes: Scenes of the batch.

        Returns:
            Sums at the nodes of all scenes, one scene behind another.
        """
        result = value.new_zeros(scenes * self.node_count, value.shape[2])
        return result.index_add(0, stencil.node.flatten(), value.flatten(0, 1))


def _require_size(
    bounds: Float[Tensor, "d 2"], cells: Float[Tensor, " d"], *, spacing: float
) -> None:
    """Refuse a grid that no memory holds, and one without a cell."""
    nodes = math.prod((cells + 1 + 2 * MARGIN).tolist())
    if not nodes <= MOST_NODES:
        raise ValueError(
            f"a grid of {spacing:g} m over the walls {bounds.tolist()} m would have {nodes:.3g} "
            f"nodes; at most {MOST_NODES} are taken. Raise GridStepperConfig.spacing."
        )
    widest = float((bounds[:, 1] - bounds[:, 0]).max())
    if not spacing <= widest:
        raise ValueError(
            f"a grid of {spacing:g} m has not one cell between the walls {bounds.tolist()} m. "
            f"Lower GridStepperConfig.spacing to at most {widest:g} m."
        )
