"""GNS and graph attention against their equations, written out edge by edge."""

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from giorom.baselines import NetworkShape
from giorom.baselines.gat import DEGREE_SCALE, GAT, GATConfig
from giorom.baselines.gns import GNS, GNSConfig
from giorom.features import Features
from giorom.graph import radius_edges


def shape_in(dimension: int) -> NetworkShape:
    """Five velocities, the walls and relative positions, as in the common training."""
    return NetworkShape(
        dimension=dimension,
        node_width=7 * dimension,
        edge_width=dimension + 1,
        bounds=[[0.0, 1.0]] * dimension,
    )


def parameter_count(model: nn.Module) -> int:
    """All numbers of a network."""
    return sum(parameter.numel() for parameter in model.parameters())


@pytest.fixture
def features() -> Features:
    """Twelve particles of several types in the plane, some of them alone, in float64."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(12, 2, generator=generator, dtype=torch.float64)
    batch = torch.arange(2).repeat_interleave(6)
    edges = radius_edges(position, batch, 0.4)
    vector = (position[edges.sender] - position[edges.receiver]) / 0.4
    return Features(
        node=torch.randn(12, 14, generator=generator, dtype=torch.float64),
        particle_type=torch.randint(9, (12,), generator=generator),
        edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
        edges=edges,
        position=position,
        batch=batch,
        batch_size=2,
    )


def network(weights: dict[str, Tensor], name: str, value: Tensor, *, norm: bool = True) -> Tensor:
    """Linear, ReLU, linear, ReLU, linear and, if wanted, a LayerNorm, from stored weights."""
    for layer in range(3):
        value = value if layer == 0 else value.clamp_min(0.0)
        matrix, bias = (weights[f"{name}.layers.{layer}.{part}"] for part in ("weight", "bias"))
        value = matrix @ value + bias
    if not norm:
        return value
    centered = value - value.mean()
    value = centered / (centered.square().mean() + 1e-5).sqrt()
    return value * weights[f"{name}.norm.weight"] + weights[f"{name}.norm.bias"]


@pytest.mark.parametrize(
    ("dimension", "layers", "expected"),
    [(3, 10, 1_592_979), (3, 5, 849_299), (3, 2, 403_091), (2, 10, 1_591_826)],
)
def test_gns_has_the_published_number_of_parameters(dimension, layers, expected):
    """The sum over all layers, 148,736 a block.

    Table 8 of arXiv:2407.03925v2 prints eight more: a map that nothing calls.
    """
    model = GNS(GNSConfig(layers=layers), shape_in(dimension))
    assert parameter_count(model) == expected
    assert GNSConfig() == GNSConfig.published()


def test_gns_is_its_equations_edge_by_edge(features):
    """A loop over edges and particles, with a sum over the neighbours."""
    torch.manual_seed(0)
    model = GNS(GNSConfig(layers=2, hidden=8), shape_in(2)).double()
    weights, edges = model.state_dict(), features.edges
    node = [
        network(
            weights,
            "node_in",
            torch.cat([weights["type_embedding.weight"][kind], features.node[particle]]),
        )
        for particle, kind in enumerate(features.particle_type)
    ]
    pairs = list(zip(edges.sender.tolist(), edges.receiver.tolist(), strict=True))
    edge = [network(weights, "edge_in", value) for value in features.edge]
    for layer in range(2):
        message = [
            network(weights, f"layers.{layer}.edge_net", torch.cat([node[to], node[source], own]))
            for (source, to), own in zip(pairs, edge, strict=True)
        ]
        total = [torch.zeros(8, dtype=torch.float64) for _ in node]
        for (_, to), value in zip(pairs, message, strict=True):
            total[to] = total[to] + value
        update = [
            network(weights, f"layers.{layer}.node_net", torch.cat([own, heard]))
            for own, heard in zip(node, total, strict=True)
        ]
        node = [own + new for own, new in zip(node, update, strict=True)]
        edge = [own + new for own, new in zip(edge, message, strict=True)]
    expected = torch.stack([network(weights, "node_out", own, norm=False) for own in node])
    torch.testing.assert_close(model(features), expected, rtol=0, atol=1e-12)


def test_gns_feels_how_many_neighbours_there_are(features):
    """Every edge twice: a mean would not notice, a sum does."""
    from dataclasses import replace

    from giorom.graph import Edges

    torch.manual_seed(0)
    model = GNS(GNSConfig(layers=1, hidden=8), shape_in(2)).double()
    edges = features.edges
    twice = replace(
        features,
        edge=features.edge.repeat_interleave(2, dim=0),
        edges=Edges(
            sender=edges.sender.repeat_interleave(2),
            receiver=edges.receiver.repeat_interleave(2),
            offset=2 * edges.offset,
        ),
    )
    assert (model(twice) - model(features)).abs().max() > 1e-2


def test_a_particle_is_out_of_reach_beyond_as_many_hops_as_layers():
    """Particles on a line, each seeing its two neighbours: the light cone of message passing."""
    position = torch.stack([torch.arange(9) * 0.1, torch.zeros(9)], dim=1).double()
    edges = radius_edges(position, torch.zeros(9, dtype=torch.long), 0.15)
    vector = (position[edges.sender] - position[edges.receiver]) / 0.15
    node = torch.randn(9, 14, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    node.requires_grad_()
    for layers in (1, 3):
        torch.manual_seed(0)
        model = GNS(GNSConfig(layers=layers, hidden=8), shape_in(2)).double()
        acceleration = model(
            Features(
                node=node,
                particle_type=torch.full((9,), 5),
                edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
                edges=edges,
                position=position,
                batch=torch.zeros(9, dtype=torch.long),
            )
        )
        (gradient,) = torch.autograd.grad(acceleration[0].sum(), node)
        reached = gradient.abs().sum(dim=1) > 0.0
        assert reached.tolist() == [hop <= layers for hop in range(9)]


@pytest.mark.parametrize(("dimension", "expected"), [(3, 1_595_667), (2, 1_594_514)])
def test_graph_attention_has_the_size_of_gns_and_norms_and_a_degree(dimension, expected):
    """148,736 a layer, as a block of GNS by chance; ten norms and one more input channel.

    Without the degree, 128 weights, it would have 1,595,539 in space.
    """
    model = GAT(GATConfig(), shape_in(dimension))
    assert sum(p.numel() for p in model.layers[0].parameters()) == 148_736
    gns = parameter_count(GNS(GNSConfig(), shape_in(dimension)))
    assert parameter_count(model) == gns + 10 * 256 + 128 == expected
    assert GATConfig() == GATConfig.published()


def test_graph_attention_is_its_equations_particle_by_particle(features):
    """GATv2 as a loop over particles and heads."""
    torch.manual_seed(0)
    model = GAT(GATConfig(layers=2, hidden=8, heads=2), shape_in(2)).double()
    weights, edges = model.state_dict(), features.edges
    node = []
    for particle, kind in enumerate(features.particle_type):
        degree = (edges.receiver == particle).double().sum() / DEGREE_SCALE
        own = [weights["type_embedding.weight"][kind], features.node[particle], degree[None]]
        node.append(network(weights, "node_in", torch.cat(own)))
    edge = [network(weights, "edge_in", value) for value in features.edge]
    for layer in range(2):
        part = {k.removeprefix(f"layers.{layer}."): v for k, v in weights.items()}
        source = [part["lin_l.weight"] @ own + part["lin_l.bias"] for own in node]
        target = [part["lin_r.weight"] @ own + part["lin_r.bias"] for own in node]
        moved = []
        for particle, own in enumerate(node):
            heard = torch.zeros(8, dtype=torch.float64)
            incoming = (edges.receiver == particle).nonzero().flatten().tolist()
            for head in range(2):
                rows = slice(8 * head, 8 * head + 8)
                said, scores = [], []
                for number in incoming:
                    said.append(source[int(edges.sender[number])][rows])
                    between = (part["lin_edge.weight"] @ edge[number])[rows]
                    total = said[-1] + target[particle][rows] + between
                    scores.append(part["att"][0, head] @ functional.leaky_relu(total, 0.2))
                share = torch.stack(scores).softmax(dim=0)
                heard = heard + sum(s * v for s, v in zip(share, said, strict=True)) / 2
            heard = heard + part["bias"]
            centered = heard - heard.mean()
            scaled = centered / (centered.square().mean() + 1e-5).sqrt()
            gain, offset = (weights[f"norms.{layer}.{name}"] for name in ("weight", "bias"))
            moved.append(own + scaled * gain + offset)
        node = moved
    expected = torch.stack([network(weights, "node_out", own, norm=False) for own in node])
    torch.testing.assert_close(model(features), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("config", "values"),
    [(GNSConfig, {"layers": 0}), (GNSConfig, {"hidden": 0}), (GATConfig, {"heads": 0})],
)
def test_a_network_without_layers_channels_or_heads_is_refused(config, values):
    """The message names the field and the value."""
    with pytest.raises(ValueError, match=rf"{config.__name__}\.{next(iter(values))} must be >= 1"):
        config(**values)


def test_messages_keep_their_size_on_their_way_into_a_fresh_network(features):
    """Weights of variance 1 / fan-in and norms: no power of the number of layers."""
    torch.manual_seed(0)
    outputs = [GNS(GNSConfig(), shape_in(2)).double()(features) for _ in range(5)]
    spread = math.sqrt(float(torch.stack(outputs).detach().square().mean()))
    assert 0.1 < spread < 10.0
