"""The graph network simulator: an encoder, message passing with sums, a decoder.

It reads no position, so that a translation changes nothing. Everything here is dimensionless.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.message_passing import MessagePassing, Neighborhood
from giorom.layers.mlp import MLP, relu


@dataclass(frozen=True, kw_only=True)
class GNSConfig:
    """Size of the graph network; the defaults are those of its authors."""

    layers: int = 10
    """Message-passing layers, none of which share weights; they bound how far a particle sees."""

    hidden: int = 128
    """Channels of node and edge features."""

    mlp_depth: int = 3
    """Linear layers of each network on nodes and edges."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        for name in ("layers", "hidden", "mlp_depth", "embedding"):
            if getattr(self, name) < 1:
                raise ValueError(f"GNSConfig.{name} must be >= 1, got {getattr(self, name)!r}.")

    @classmethod
    def published(cls) -> "GNSConfig":
        """The size of the paper and of the matched comparison alike."""
        return cls()


class GNS(Baseline):
    r"""Encode, process with M layers, decode.

    .. math::
        m_{ij} = \phi_e(v_i, v_j, e_{ij}), \qquad
        v_i \leftarrow v_i + \phi_v\Big(v_i, \sum_{j \in N(i)} m_{ij}\Big), \qquad
        e_{ij} \leftarrow e_{ij} + m_{ij}

    with a LayerNorm behind every network but the decoder. The sum makes a particle feel how many
    neighbours it has, and makes the network depend on how densely a body is sampled.

    Source:
        Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph Networks", ICML
        2020 (arXiv:2002.09405). Weights start normal where the original truncates the tails.
    """

    def __init__(self, config: GNSConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        hidden = [config.hidden] * config.mlp_depth
        options = {"activation": relu, "unit_variance": True}
        self.type_embedding = nn.Embedding(shape.particle_types, config.embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        width = config.embedding + shape.node_width
        self.node_in = MLP([width, *hidden], layer_norm=True, **options)
        self.edge_in = MLP([shape.edge_width, *hidden], layer_norm=True, **options)
        self.layers = nn.ModuleList(
            MessagePassing(config.hidden, depth=config.mlp_depth) for _ in range(config.layers)
        )
        self.node_out = MLP([*hidden, shape.dimension], **options)

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        neighborhood = Neighborhood.summed(features.edges, dtype=features.edge.dtype)
        embedded = self.type_embedding(features.particle_type)
        node = self.node_in(torch.cat([embedded, features.node], dim=-1))
        edge = self.edge_in(features.edge)
        for layer in self.layers:
            node, edge = layer(node, edge, neighborhood)
        return self.node_out(node)
