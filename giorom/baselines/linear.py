"""The least that learns: one linear map of what a particle knows of itself and its surroundings.

It is to the networks what a straight line is to a curve fit: a network that does not beat it has
learnt nothing that needed a network.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.aggregation import Grouping, weighted_sum


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Size of the linear model."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    def __post_init__(self) -> None:
        """Reject an empty embedding."""
        if self.embedding < 1:
            raise ValueError(f"LinearConfig.embedding must be >= 1, got {self.embedding!r}.")

    @classmethod
    def published(cls) -> "LinearConfig":
        """The same: there is no other size."""
        return cls()


class Linear(Baseline):
    r"""Acceleration linear in a particle's features, its type and the mean of its edges.

    .. math::
        a_i = W \Big[t_i,\; n_i,\; \frac{1}{|N(i)|} \sum_{j \in N(i)} e_{ij}\Big] + b

    with the embedding t of the particle's type, its features n (velocities, distances to the
    walls) and those of its edges e. The mean relative position of the neighbours points into the
    body where they are missing on one side, and their mean distance tells a crowd; the velocities
    of the neighbours are not seen. No position is read, so that a translation changes nothing.
    """

    def __init__(self, config: LinearConfig, shape: NetworkShape) -> None:
        """Make the map.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        self.type_embedding = nn.Embedding(shape.particle_types, config.embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        width = config.embedding + shape.node_width + shape.edge_width
        self.map = nn.Linear(width, shape.dimension)

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless), never in less than their precision.
        """
        edges = features.edges
        order = torch.arange(len(edges.receiver), device=edges.receiver.device)
        receiver = Grouping(point=edges.receiver, order=order, offset=edges.offset)
        weight = receiver.mean_weight(dtype=features.edge.dtype)
        mean = weighted_sum(features.edge, receiver, weight)
        embedded = self.type_embedding(features.particle_type)
        # A handful of products: half precision would save nothing and round the answer.
        with torch.autocast(features.node.device.type, enabled=False):
            return self.map(torch.cat([embedded, features.node, mean], dim=1))
