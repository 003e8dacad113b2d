"""The regular grid the neural operator transformer works on, and who is near its nodes.

Every scene of a batch has a grid of its own; the node coordinates are shared. Because the grid
is regular, the nodes within reach of a particle follow from its position alone: no search, and
no table of all distances. Positions are metres; ``unit`` coordinates run from 0 to 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from giorom.layers.aggregation import Grouping
from giorom.layers.kernel_integral import PointPairs

__all__ = ["GridPairs", "LatentGrid", "Tokens", "widened"]


def widened(bounds: Sequence[Sequence[float]], share: float) -> list[list[float]]:
    """Bounds that go farther on each side by a share of their width."""
    return [[low - share * (high - low), high + share * (high - low)] for low, high in bounds]


@dataclass(frozen=True, kw_only=True)
class GridPairs:
    """Particles and grid nodes within reach of each other, sorted by particle."""

    particle: Int[Tensor, " m"]
    """Particle of each pair."""

    node: Int[Tensor, " m"]
    """Node of each pair in the grid of the particle's scene."""

    relative: Float[Tensor, "m d"]
    """(particle - node) / radius."""


@dataclass(frozen=True, kw_only=True)
class Tokens:
    """The grid nodes that are processed, dense per scene."""

    node: Int[Tensor, "#b t"]
    """Node of each token."""

    slot: Int[Tensor, " m"]
    """Token of each pair, counted through the flattened (b t)."""

    mask: Bool[Tensor, "b t"] | None
    """False for padding; None when there is no padding."""


@dataclass(frozen=True, kw_only=True)
class LatentGrid:
    """Where the nodes are and how far they reach."""

    bounds: Sequence[Sequence[float]]
    """First and last node on each axis [m]."""

    side: int
    """Nodes along each axis."""

    radius: float | None = None
    """Reach of a node [m]; None means 1.5 times what is needed to reach everywhere inside."""

    @property
    def spacing(self) -> list[float]:
        """Distance between neighbouring nodes on each axis [m]."""
        return [(high - low) / (self.side - 1) for low, high in self.bounds]

    @property
    def covering_radius(self) -> float:
        """Smallest reach that leaves no point inside the grid without a node [m]."""
        return 0.5 * math.hypot(*self.spacing)

    @property
    def reach(self) -> float:
        """Reach of a node [m]."""
        return 1.5 * self.covering_radius if self.radius is None else self.radius

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return self.side ** len(self.bounds)

    def unit(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "q d"]:
        """Coordinates of points in units of the grid, 0 to 1 inside."""
        low, high = position.new_tensor(self.bounds).unbind(dim=1)
        return (position - low) / (high - low)

    def node_unit(self, node: Int[Tensor, "*n"], like: Tensor) -> Float[Tensor, "*n d"]:
        """Coordinates of nodes in units of the grid.

        Args:
            node: Nodes, the last axis fastest.
            like: Gives the dtype.

        Returns:
            Coordinates, 0 to 1.
        """
        powers = [self.side**k for k in reversed(range(len(self.bounds)))]
        index = node[..., None] // torch.tensor(powers, device=node.device) % self.side
        return index.to(like.dtype) / (self.side - 1)

    def pairs(self, position: Float[Tensor, "q d"]) -> GridPairs:
        """Find the nodes within reach of each particle.

        On each axis at most ``floor(2 reach / spacing) + 1`` consecutive nodes can be in reach;
        the product of these windows is tested.

        Args:
            position: Particle positions [m].

        Returns:
            The pairs, sorted by particle and then by node.
        """
        spacing = position.new_tensor(self.spacing)
        scaled = (position - position.new_tensor(self.bounds)[:, 0]) / spacing
        first = torch.ceil(scaled - self.reach / spacing).to(torch.int64)
        index = first[:, None] + self._window(position.device)  # q w d
        relative = (scaled[:, None] - index) * (spacing / self.reach)
        inside = ((index >= 0) & (index < self.side)).all(dim=-1)
        near = inside & (relative.square().sum(dim=-1) <= 1.0)
        node = index[..., 0]
        for axis in range(1, len(self.bounds)):
            node = node * self.side + index[..., axis]
        return GridPairs(particle=near.nonzero()[:, 0], node=node[near], relative=relative[near])

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles that have a node within reach."""
        covered = torch.zeros(len(position), device=position.device)
        covered[self.pairs(position).particle] = 1.0
        return covered.mean()

    def tokens(
        self, pairs: GridPairs, batch: Int[Tensor, " q"], batch_size: int, *, occupied: bool
    ) -> Tokens:
        """Choose the nodes that are processed.

        Args:
            pairs: Particles and nodes in reach.
            batch: Scene of each particle.
            batch_size: Number of scenes.
            occupied: Only the nodes some particle of the scene reaches, not all.

        Returns:
            The tokens.
        """
        scene, count = batch[pairs.particle], self.node_count
        flat = scene * count + pairs.node
        if not occupied:
            every = torch.arange(count, device=batch.device)
            return Tokens(node=every[None], slot=flat, mask=None)
        used = torch.zeros(batch_size * count, dtype=torch.bool, device=batch.device)
        used[flat] = True
        used = used.view(batch_size, count)
        rank = used.cumsum(dim=1) - 1
        size = int(rank[:, -1].max()) + 1
        in_scene, of_node = used.nonzero(as_tuple=True)
        node = torch.zeros(batch_size, size, dtype=torch.int64, device=batch.device)
        mask = torch.zeros(batch_size, size, dtype=torch.bool, device=batch.device)
        at = (in_scene, rank[used])
        node[at], mask[at] = of_node, True
        slot = scene * size + rank.view(-1)[flat]
        return Tokens(node=node, slot=slot, mask=mask)

    def inward(
        self,
        position: Float[Tensor, "q d"],
        pairs: GridPairs,
        tokens: Tokens,
        *,
        coordinate: Float[Tensor, "b t d"],
    ) -> PointPairs:
        """Tokens as queries of the particles in their reach, the scenes in a row.

        Args:
            position: Particle positions [m].
            pairs: Particles and nodes in reach.
            tokens: The nodes that are processed.
            coordinate: Their coordinates in units of the grid, for every scene.
        """
        place = coordinate.flatten(0, 1)
        return PointPairs(
            query=Grouping.by(tokens.slot, len(place)),
            source=Grouping.by(pairs.particle, len(position)),
            relative=pairs.relative,
            query_position=place,
            source_position=self.unit(position),
        )

    def _window(self, device: torch.device) -> Int[Tensor, "w d"]:
        """Offsets of the nodes that can be in reach, counted from the first on each axis."""
        widths = [math.floor(2.0 * self.reach / spacing) + 1 for spacing in self.spacing]
        axes = [torch.arange(width, device=device) for width in widths]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).flatten(0, -2)
