"""Message passing against equation 8 written as a loop over particles."""

import pytest
import torch
from torch import Tensor

from giorom.graph import Edges, radius_edges
from giorom.layers.message_passing import MessagePassing, Neighborhood

WIDTH = 6


@pytest.fixture
def graph() -> tuple[Edges, Tensor]:
    """A radius graph of 12 points in space and the edge lengths over the radius."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(12, 3, generator=generator, dtype=torch.float64)
    edges = radius_edges(position, torch.zeros(12, dtype=torch.int64), 0.5)
    vector = position[edges.sender] - position[edges.receiver]
    return edges, vector.norm(dim=1) / 0.5


def layer_and_input(edges: Edges, **options: object) -> tuple[MessagePassing, Tensor, Tensor]:
    """A float64 layer and random node and edge features."""
    torch.manual_seed(0)
    layer = MessagePassing(WIDTH, **options).double()
    node = torch.randn(len(edges.offset) - 1, WIDTH, dtype=torch.float64, requires_grad=True)
    edge = torch.randn(len(edges.sender), WIDTH, dtype=torch.float64, requires_grad=True)
    return layer, node, edge


def plain(
    layer: MessagePassing, node: Tensor, edge: Tensor, edges: Edges, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Concatenate (target, source, edge), loop over the receivers."""
    joined = torch.cat([node[edges.receiver], node[edges.sender], edge], dim=1)
    message = layer.edge_net(joined)
    mean = torch.stack(
        [
            (message * weight[:, None])[edges.receiver == i].sum(dim=0)
            / (edges.receiver == i).sum()
            for i in range(len(node))
        ]
    )
    new = node + layer.node_net(torch.cat([node, mean], dim=1))
    if layer.skip is not None:
        new = new + layer.skip(node)
    return new, edge + message


@pytest.mark.parametrize("node_skip", ["none", "linear"])
@pytest.mark.parametrize("distance_weight", [True, False])
def test_layer_and_gradients_agree_with_the_plain_loop(graph, node_skip, distance_weight):
    """Equation 8 with the concatenation spelled out; the first layer is a sum of three."""
    edges, distance = graph
    layer, node, edge = layer_and_input(edges, node_skip=node_skip)
    weight = 1 / (1 + distance) if distance_weight else torch.ones_like(distance)
    neighborhood = Neighborhood.of(edges, distance=distance, distance_weight=distance_weight)

    inputs = [node, edge, *layer.parameters()]
    results = layer(node, edge, neighborhood), plain(layer, node, edge, edges, weight)
    gradients = [torch.autograd.grad(n.square().sum() + e.pow(3).sum(), inputs) for n, e in results]
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, rtol=0, atol=1e-12)
    for ours, reference in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, reference, rtol=1e-9, atol=1e-9)


def test_repeating_every_edge_changes_no_particle(graph):
    """The integral of equation 8 is a mean over neighbours: twice the points, same mean."""
    edges, distance = graph
    layer, node, edge = layer_and_input(edges)
    twice = Edges(
        sender=edges.sender.repeat_interleave(2),
        receiver=edges.receiver.repeat_interleave(2),
        offset=edges.offset * 2,
    )
    once = Neighborhood.of(edges, distance=distance, distance_weight=True)
    repeated = Neighborhood.of(twice, distance=distance.repeat_interleave(2), distance_weight=True)
    expected, _ = layer(node, edge, once)
    got, _ = layer(node, edge.repeat_interleave(2, dim=0), repeated)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-12)


def test_the_published_layer_has_its_parameters():
    """148,736 weights, and 16,512 more with the linear skip (method notes, section 3.2)."""
    count = sum(p.numel() for p in MessagePassing(128).parameters())
    with_skip = sum(p.numel() for p in MessagePassing(128, node_skip="linear").parameters())
    assert (count, with_skip - count) == (148_736, 16_512)
