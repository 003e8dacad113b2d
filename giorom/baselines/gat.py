"""Graph attention between the encoders and the decoder of the graph network simulator.

Attention averages what the neighbours say, so that it can neither add forces up nor count
neighbours; that is why the degree of a particle is one of its features here. No position is read:
a translation changes nothing. Everything here is dimensionless.
"""

import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.mlp import MLP, relu

DEGREE_SCALE = 20.0
"""Usual number of neighbours, which brings the degree feature to order one."""


@dataclass(frozen=True, kw_only=True)
class GATConfig:
    """Size of the attention network."""

    layers: int = 10
    """Attention layers."""

    hidden: int = 128
    """Channels of node and edge features."""

    heads: int = 3
    """Attention heads, each ``hidden`` wide, whose mean is taken."""

    mlp_depth: int = 3
    """Linear layers of the encoders and of the decoder."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        for name in ("layers", "hidden", "heads", "mlp_depth", "embedding"):
            if getattr(self, name) < 1:
                raise ValueError(f"GATConfig.{name} must be >= 1, got {getattr(self, name)!r}.")

    @classmethod
    def published(cls) -> "GATConfig":
        """The same: no size of a particle simulator by graph attention is published in full."""
        return cls()


def _attention_layer() -> type[nn.Module]:
    """The layer of PyG, whose import calls what PyTorch is about to remove."""
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=r"`torch\.jit\.script` is", category=DeprecationWarning
        )
        from torch_geometric.nn import GATv2Conv
    return GATv2Conv


class GAT(Baseline):
    r"""Attention over the neighbours with residuals.

    .. math::
        s_{ij} = a \cdot \mathrm{LeakyReLU}(W_s v_j + W_t v_i + W_e e_{ij}), \qquad
        v_i \leftarrow v_i + \mathrm{LN}\Big(\frac{1}{H} \sum_h \sum_{j \in N(i)}
        \mathrm{softmax}_j(s_{ij})\, W_s v_j\Big)

    with weights of its own for each of the H heads. The encoders and the decoder are those of GNS;
    the degree of a particle is one more channel of its features.

    Source:
        Brody, Alon, Yahav, "How Attentive are Graph Attention Networks?", ICLR 2022
        (arXiv:2105.14491); the layer is ``torch_geometric.nn.GATv2Conv``.
    """

    def __init__(self, config: GATConfig, shape: NetworkShape) -> None:
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
        width = config.embedding + shape.node_width + 1
        self.node_in = MLP([width, *hidden], layer_norm=True, **options)
        self.edge_in = MLP([shape.edge_width, *hidden], layer_norm=True, **options)
        self.layers = nn.ModuleList(
            _attention_layer()(
                config.hidden,
                config.hidden,
                heads=config.heads,
                concat=False,
                add_self_loops=False,  # the graph has them already
                edge_dim=config.hidden,
            )
            for _ in range(config.layers)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(config.hidden) for _ in range(config.layers))
        self.node_out = MLP([*hidden, shape.dimension], **options)

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        edges = features.edges
        pairs = torch.stack([edges.sender, edges.receiver])
        degree = edges.offset.diff().to(features.node.dtype)[:, None] / DEGREE_SCALE
        embedded = self.type_embedding(features.particle_type)
        node = self.node_in(torch.cat([embedded, features.node, degree], dim=-1))
        edge = self.edge_in(features.edge)
        for attention, norm in zip(self.layers, self.norms, strict=True):
            node = node + norm(attention(node, pairs, edge))
        return self.node_out(node)
