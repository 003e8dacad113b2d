"""Discretisation-agnostic message passing, the part of the interaction operator on particles.

One layer is the operator MP of equation 8: a learned kernel of the edge and of the features
at its two ends, averaged over the neighbours, and a pointwise network of the average. The mean
(not a sum) makes the result independent of how densely the body is sampled. Everything is
dimensionless; edges run from ``sender`` to ``receiver``.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.graph import Edges
from giorom.layers.aggregation import Grouping, take, weighted_sum
from giorom.layers.mlp import MLP, relu

__all__ = ["MessagePassing", "Neighborhood"]


@dataclass(frozen=True, kw_only=True)
class Neighborhood:
    """What every layer needs of a graph, worked out once per graph."""

    receiver: Grouping
    """Edges of each receiver."""

    sender: Grouping
    """Edges of each sender."""

    weight: Float[Tensor, " e"]
    """Weight of each edge in the mean or sum over its receiver."""

    @classmethod
    def of(
        cls,
        edges: Edges,
        *,
        distance: Float[Tensor, " e"],
        distance_weight: bool,
    ) -> "Neighborhood":
        """Prepare a graph.

        Args:
            edges: Edges sorted by receiver.
            distance: Edge lengths over the graph radius.
            distance_weight: Weigh each message with 1 / (1 + distance).

        Returns:
            The prepared graph.
        """
        order = torch.arange(len(edges.receiver), device=edges.receiver.device)
        receiver = Grouping(point=edges.receiver, order=order, offset=edges.offset)
        sender = Grouping.by(edges.sender, len(edges.offset) - 1)
        weight = receiver.mean_weight(dtype=distance.dtype)
        if distance_weight:
            weight = weight / (1.0 + distance)
        return cls(receiver=receiver, sender=sender, weight=weight)

    @classmethod
    def summed(cls, edges: Edges, *, dtype: torch.dtype) -> "Neighborhood":
        """Prepare a graph whose layers add the messages up instead of averaging them.

        Args:
            edges: Edges sorted by receiver.
            dtype: Precision of the weights, which are one.
        """
        mean = cls.of(
            edges,
            distance=torch.zeros(len(edges.receiver), dtype=dtype, device=edges.receiver.device),
            distance_weight=False,
        )
        return replace(mean, weight=torch.ones_like(mean.weight))


class MessagePassing(nn.Module):
    r"""One message-passing layer with node and edge residuals.

    For the edge from j to i with features :math:`e_{ij}` and length :math:`s_{ij} r`,

    .. math::
        m_{ij} = \kappa(v_i, v_j, e_{ij}), \qquad
        a_i = \frac{1}{|N(i)|} \sum_{j \in N(i)} \frac{m_{ij}}{1 + s_{ij}},

        v_i \leftarrow v_i + f(v_i, a_i), \qquad e_{ij} \leftarrow e_{ij} + m_{ij}.

    Source:
        Equation 8 of arXiv:2407.03925v2, with the official code's distance weight (which the
        paper does not mention) and concatenation order. ``node_skip="linear"`` adds a linear
        map of :math:`v_i`, to which the official code's graph-convolution branch reduces.
    """

    def __init__(self, width: int, *, depth: int = 3, node_skip: str = "none") -> None:
        """Make the two networks.

        Args:
            width: Channels of node and edge features.
            depth: Linear layers of each network.
            node_skip: ``none`` or ``linear``.
        """
        super().__init__()
        hidden = [width] * depth
        self.edge_net = MLP(
            [3 * width, *hidden], activation=relu, layer_norm=True, unit_variance=True
        )
        self.node_net = MLP(
            [2 * width, *hidden], activation=relu, layer_norm=True, unit_variance=True
        )
        self.skip = nn.Linear(width, width) if node_skip == "linear" else None

    def forward(
        self,
        node: Float[Tensor, "q h"],
        edge: Float[Tensor, "e h"],
        neighborhood: Neighborhood,
    ) -> tuple[Float[Tensor, "q h"], Float[Tensor, "e h"]]:
        """Update node and edge features.

        Args:
            node: Node features.
            edge: Edge features.
            neighborhood: The graph.

        Returns:
            The new node and edge features.
        """
        message = self.messages(node, edge, neighborhood)
        mean = weighted_sum(message, neighborhood.receiver, neighborhood.weight)
        update = self.node_net(torch.cat([node, mean], dim=-1))
        if self.skip is not None:
            update = update + self.skip(node)
        return node + update, edge + message

    def messages(
        self,
        node: Float[Tensor, "q h"],
        edge: Float[Tensor, "e h"],
        neighborhood: Neighborhood,
    ) -> Float[Tensor, "e h"]:
        """Evaluate the kernel on (target, source, edge) without concatenating them.

        The first linear layer of a concatenation is the sum of three linear layers; those of
        the two nodes are evaluated once per node and copied, not once per edge.

        Args:
            node: Node features.
            edge: Edge features.
            neighborhood: The graph.

        Returns:
            The message of each edge.
        """
        first = self.edge_net.layers[0]
        of_target, of_source, of_edge = first.weight.split(node.shape[-1], dim=1)
        value = functional.linear(edge, of_edge, first.bias)
        value = value + take(functional.linear(node, of_target), neighborhood.receiver)
        value = value + take(functional.linear(node, of_source), neighborhood.sender)
        return self.edge_net.finish(value)
