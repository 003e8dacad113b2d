"""A regular grid with multilinear weights: sums from points to nodes, means of nodes at points.

Every point shares a weight of one among the 2^d nodes of the cell it lies in (bilinear in the
plane, trilinear in space). Both ways use the same weights: what points give to the nodes adds up
to what they have, and a field that is linear in the coordinates is read without an error. Every
scene of a batch has a grid of its own, one behind another. Positions are metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.layers.aggregation import Grouping, take, weighted_sum

__all__ = ["LinearGrid", "LinearStencil"]


@dataclass(frozen=True, kw_only=True)
class LinearStencil:
    """The nodes around some points, with the weights between them."""

    point: Grouping
    """Pairs of each point."""

    node: Grouping
    """Pairs of each node, scenes behind one another."""

    weight: Float[Tensor, " m"]
    """Weight of each pair; those of a point add up to one."""

    def to_nodes(self, value: Float[Tensor, "q c"]) -> Float[Tensor, "n c"]:
        r"""Sums at the nodes, :math:`u_g = \sum_p w_{pg} u_p`."""
        return _sums(take(value, self.point), self.node, self.weight)

    def to_points(self, value: Float[Tensor, "n c"]) -> Float[Tensor, "q c"]:
        r"""Means at the points, :math:`u_p = \sum_g w_{pg} u_g`."""
        return _sums(take(value, self.node), self.point, self.weight)


@dataclass(frozen=True, kw_only=True)
class LinearGrid:
    """Where the nodes are."""

    bounds: Sequence[Sequence[float]]
    """First and last node on each axis [m]."""

    side: int
    """Nodes along each axis, the last axis fastest."""

    @property
    def node_count(self) -> int:
        """Nodes of one scene."""
        return self.side ** len(self.bounds)

    def stencil(
        self, position: Float[Tensor, "q d"], batch: Int[Tensor, " q"], *, scenes: int
    ) -> LinearStencil:
        """Nodes and weights of points.

        Args:
            position: Points [m]; those beyond the outermost nodes count as lying on them.
            batch: Scene of each point.
            scenes: Scenes of the batch.

        Returns:
            2^d pairs for each point.
        """
        place = self._place(position).clamp(0.0, self.side - 1.0)
        base = place.detach().nan_to_num(0.0).floor().clamp_max(self.side - 2.0)
        share = place - base
        first = base.long()
        nodes, weights = [], []
        for corner in product((0, 1), repeat=len(self.bounds)):
            node, weight = batch, torch.ones_like(share[:, 0])
            for axis, step in enumerate(corner):
                node = node * self.side + first[:, axis] + step
                weight = weight * (share[:, axis] if step else 1.0 - share[:, axis])
            nodes.append(node)
            weights.append(weight)
        point = torch.arange(len(position), device=position.device)
        return LinearStencil(
            point=Grouping.by(point.repeat_interleave(len(nodes)), len(position)),
            node=Grouping.by(torch.stack(nodes, dim=1).flatten(), scenes * self.node_count),
            weight=torch.stack(weights, dim=1).flatten(),
        )

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the points between the outermost nodes."""
        place = self._place(position)
        inside = ((place >= 0.0) & (place <= self.side - 1.0)).all(dim=1)
        return inside.to(position.dtype).mean()

    def _place(self, position: Tensor) -> Tensor:
        """Places in units of the node distance, counted from the first node."""
        low, high = position.new_tensor(self.bounds).unbind(dim=1)
        return (position - low) / (high - low) * (self.side - 1)


def _sums(value: Tensor, grouping: Grouping, weight: Tensor) -> Tensor:
    """Weighted sums with a gradient to the weights, and so to the positions."""
    value = value * weight.to(value.dtype)[:, None]
    return weighted_sum(value, grouping, torch.ones_like(weight))
