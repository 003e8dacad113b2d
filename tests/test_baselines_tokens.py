"""Networks on particles as tokens against their equations and the numbers of their papers."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from giorom.baselines.gnot import GNOT, GNOTConfig
from giorom.baselines.ipot import (
    IPOT,
    Attention,
    FourierFeatures,
    GatedPointwise,
    IPOTConfig,
)
from giorom.baselines.operator import OperatorConfig, OperatorStepper
from giorom.baselines.shape import NetworkShape
from giorom.baselines.transolver import Transolver, TransolverConfig
from giorom.features import Features
from giorom.graph import Edges

BOUNDS = [[-1.0, 3.0], [0.0, 0.5], [10.0, 12.0]]

SMALL = {
    GNOT: GNOTConfig(width=16, layers=2, heads=2, inner=2, depth=1),
    IPOT: IPOTConfig(width=16, latents=6, bands=3, heads=4, cross_heads=2, repeats=2),
    Transolver: TransolverConfig(width=16, layers=2, heads=4, slices=5),
    OperatorStepper: OperatorConfig(width=16, layers=2, heads=2),
}
"""A small size of every network."""

EMBEDDING = 9 * 16
"""Parameters of the type embedding, which the published numbers leave out."""


def shape_of(dimension: int) -> NetworkShape:
    """Five velocities and the walls: 21 or 14 channels, 37 or 30 with the type."""
    return NetworkShape(
        dimension=dimension,
        node_width=7 * dimension,
        edge_width=dimension + 1,
        bounds=BOUNDS[:dimension],
    )


def features_of(counts: list[int], *, seed: int = 0, dimension: int = 3) -> Features:
    """Random particles without edges in the bounds of the domain."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(counts)
    low, high = torch.tensor(BOUNDS[:dimension], dtype=torch.float64).unbind(dim=1)
    unit = torch.rand(total, dimension, generator=generator, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.long)
    return Features(
        node=torch.randn(total, 7 * dimension, generator=generator, dtype=torch.float64),
        particle_type=torch.randint(5, 8, (total,), generator=generator),
        edge=torch.zeros(0, dimension + 1, dtype=torch.float64),
        edges=Edges(sender=none, receiver=none, offset=none.new_zeros(total + 1)),
        position=low + (high - low) * unit,
        batch=torch.arange(len(counts)).repeat_interleave(torch.tensor(counts)),
        batch_size=len(counts),
    )


def scene(features: Features, index: int) -> Features:
    """One scene of a batch alone."""
    own = features.batch == index
    return replace(
        features,
        node=features.node[own],
        particle_type=features.particle_type[own],
        position=features.position[own],
        batch=features.batch[own] * 0,
        batch_size=1,
        edges=replace(features.edges, offset=features.edges.offset[: int(own.sum()) + 1]),
    )


def build(kind: type[nn.Module], **changes: object) -> nn.Module:
    """A small network in float64 whose weights are large enough to tell differences."""
    torch.manual_seed(0)
    network = kind(replace(SMALL[kind], **changes), shape_of(3)).double().eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    return network


def size(network: nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def randn(*shape: int, seed: int = 0) -> Tensor:
    """Random numbers in float64."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("kind", SMALL)
def test_padded_scenes_equal_separate_ones(kind):
    """f(A and B and C) = f(A), f(B), f(C), of 7, 2 and 5 particles."""
    network, together = build(kind), features_of([7, 2, 5])
    alone = [network(scene(together, index)) for index in range(3)]
    torch.testing.assert_close(network(together), torch.cat(alone))
    assert bool((network.coverage(together.position) == 1.0).all())


@pytest.mark.parametrize("kind", SMALL)
def test_an_empty_scene_disturbs_nobody(kind):
    """No 0 / 0 forwards or backwards where a scene of a batch has lost its particles."""
    network, together = build(kind), features_of([4, 0, 3])
    result = network(together)
    alone = [network(scene(together, index)) for index in (0, 2)]
    torch.testing.assert_close(result, torch.cat(alone))
    result.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        *((kind, {}) for kind in SMALL),
        (GNOT, {"experts": 1}),
        (IPOT, {"query_features": True}),
        (OperatorStepper, {"gate_input": "features"}),
    ],
)
def test_gradients_reach_every_parameter(kind, changes):
    """No parameter is dead, in the structure of the published sizes either."""
    network = build(kind, **changes)
    network(features_of([6, 4])).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        # a weight to which the output is blind would have a gradient of rounding size
        assert parameter.grad.abs().max() > 1e-9, name


@pytest.mark.parametrize("kind", SMALL)
def test_places_are_in_units_of_the_bounds(kind):
    """Stretching the domain and everything in it changes nothing: f(s x + c, s B + c) = f(x, B)."""
    network, features = build(kind), features_of([6, 4])
    shape = shape_of(3)
    stretched = replace(shape, bounds=[[3 * low + 1, 3 * high + 1] for low, high in BOUNDS])
    other = kind(SMALL[kind], stretched).double().eval()
    other.load_state_dict(network.state_dict())
    moved = replace(features, position=3.0 * features.position + 1.0)
    torch.testing.assert_close(other(moved), network(features), rtol=1e-6, atol=1e-8)
    assert not torch.allclose(network(moved), network(features))


def test_gnot_follows_its_equations():
    """Blocks with the explicit T x S matrix q k^T / sum_s q k^T instead of two sums."""
    network, features = build(GNOT), features_of([6])
    embedded = network.tokens.type_embedding(features.particle_type)
    low, high = torch.tensor(BOUNDS, dtype=torch.float64).unbind(dim=1)
    place = (features.position - low) / (high - low)
    token = torch.cat([place, embedded, features.node], dim=1)

    def attend(layer: nn.Module, target: Tensor, source: Tensor) -> Tensor:
        heads = []
        for q, k, v in zip(
            layer.query(target).chunk(2, dim=1),
            layer.key(source).chunk(2, dim=1),
            layer.value(source).chunk(2, dim=1),
            strict=True,
        ):
            matrix = q.softmax(dim=1) @ k.softmax(dim=1).T
            heads.append(q.softmax(dim=1) + matrix / matrix.sum(dim=1, keepdim=True) @ v)
        return layer.out(torch.cat(heads, dim=1))

    x, y = network.trunk(token), network.branch(token)
    for block in network.blocks:
        ln, gate = block.norms, block.gate(place).softmax(dim=1)
        x = x + attend(block.cross, ln[0](x), ln[1](y))
        mixture = [gate[:, e : e + 1] * block.cross_experts.experts[e](x) for e in range(2)]
        x = x + ln[2](sum(mixture))
        x = x + attend(block.own, ln[3](x), ln[3](x))
        mixture = [gate[:, e : e + 1] * block.own_experts.experts[e](x) for e in range(2)]
        x = x + ln[4](sum(mixture))
    torch.testing.assert_close(network(features), network.out(x))


def test_one_expert_has_no_gate():
    """Its share is one whatever the gate says."""
    network = build(GNOT, experts=1)
    assert not any("gate" in name for name, _ in network.named_parameters())


def test_attention_agrees_with_the_explicit_matrix():
    """softmax(q k^T / sqrt(c)) v per head, by einsum, with and without a mask."""
    torch.manual_seed(0)
    layer = Attention(5, 7, 3, heads=2, width=8).double()
    query, context = randn(2, 4, 5), randn(2, 6, 7, seed=1)
    mask = torch.tensor([[True] * 6, [True, False, True, True, False, False]])
    for known in (None, mask):
        parts = layer.query(query), layer.key(context), layer.value(context)
        q, k, v = (part.unflatten(-1, (2, 4)) for part in parts)
        share = (torch.einsum("bthc,bshc->bhts", q, k) / 2.0).exp()
        if known is not None:
            share = share * known[:, None, None, :]
        share = share / share.sum(dim=-1, keepdim=True)
        expected = layer.out(torch.einsum("bhts,bshc->bthc", share, v).flatten(2))
        torch.testing.assert_close(layer(query, context, known), expected)


def test_attention_agrees_with_that_of_pytorch():
    """``nn.MultiheadAttention`` with the same weights and no biases but the last."""
    torch.manual_seed(0)
    layer = Attention(8, 6, 8, heads=4, width=8).double()
    other = nn.MultiheadAttention(8, 4, kdim=6, vdim=6, batch_first=True).double()
    with torch.no_grad():
        other.in_proj_bias.zero_()
        other.q_proj_weight.copy_(layer.query.weight)
        other.k_proj_weight.copy_(layer.key.weight)
        other.v_proj_weight.copy_(layer.value.weight)
        other.out_proj.load_state_dict(layer.out.state_dict())
    query, context = randn(2, 4, 8), randn(2, 5, 6, seed=1)
    mask = torch.tensor([[True] * 5, [True, False, True, True, False]])
    expected, _ = other(query, context, context, key_padding_mask=~mask)
    torch.testing.assert_close(layer(query, context, mask), expected)


def test_waves_are_sines_and_cosines_of_equally_spaced_frequencies():
    """Frequency by frequency: from one to half the resolution, on coordinates from -1 to 1."""
    waves = FourierFeatures(2, bands=3, resolution=10.0)
    unit = torch.rand(1, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    place, pi = 2.0 * unit - 1.0, torch.pi
    phases = [place[..., axis] * pi * f for axis in range(2) for f in (1.0, 3.0, 5.0)]
    parts = [phase.sin() for phase in phases] + [phase.cos() for phase in phases]
    expected = torch.cat([torch.stack(parts, dim=-1), place], dim=-1)
    torch.testing.assert_close(waves(unit), expected)
    assert waves.width == expected.shape[-1]


def test_gated_pointwise_network_agrees_with_pytorch():
    """A gated linear unit with GELU for the sigmoid."""
    torch.manual_seed(0)
    layer, value = GatedPointwise(3, ratio=2).double(), randn(1, 4, 3)
    content = value @ layer.first.weight[:6].T + layer.first.bias[:6]
    gate = value @ layer.first.weight[6:].T + layer.first.bias[6:]
    torch.testing.assert_close(layer(value), layer.last(content * functional.gelu(gate)))


@pytest.mark.parametrize("query_features", [False, True])
def test_ipot_follows_its_equations(query_features):
    """Read, think twice with the same weights, be read, times 0.1."""
    network = build(IPOT, query_features=query_features)
    features, ln = features_of([6]), network.norms
    tokens = network.tokens(features)
    place = network.waves(tokens.coordinate)
    y = torch.cat([tokens.feature, place], dim=-1)
    latent = network.latents[None] + network.encode(
        ln["latents"](network.latents[None]), ln["context"](y)
    )
    for _ in range(2):
        latent = latent + network.attend(ln["attend"](latent), ln["attend"](latent))
        latent = latent + network.think(ln["think"](latent))
    query = y if query_features else place
    read = network.decode(ln["query"](query), ln["read"](latent))
    expected = 0.1 * (read + network.finish(ln["finish"](read)))
    torch.testing.assert_close(network(features), expected[0])


@pytest.mark.parametrize("query_features", [False, True])
def test_ipot_as_published_cannot_tell_two_particles_at_one_place_apart(query_features):
    """Other velocities, same place: the published decoder gives both one acceleration."""
    network, features = build(IPOT, query_features=query_features), features_of([5])
    position = features.position.clone()
    position[1] = position[0]
    first, second = network(replace(features, position=position))[:2]
    assert torch.allclose(first, second) != query_features


def test_transolver_is_its_transformer_on_the_particles():
    """Coordinates in units of the domain, embedded type and features are the tokens."""
    network, features = build(Transolver), features_of([6])
    embedded = network.tokens.type_embedding(features.particle_type)
    low, high = torch.tensor(BOUNDS, dtype=torch.float64).unbind(dim=1)
    place = (features.position - low) / (high - low)
    token = torch.cat([embedded, features.node], dim=1)
    expected = network.transformer(token[None], place[None])[0]
    torch.testing.assert_close(network(features), expected)


def test_gnot_has_the_parameters_of_the_official_one_that_are_alive():
    """1,683,369 with 37 channels in the trunk and 3 in the branch; here both see 40.

    At its published size 201,219 of 554,310 belong to the gates of a single expert.
    """
    official, wider = 1_683_369, 3 * 96 + 37 * 96
    assert size(GNOT(GNOTConfig(), shape_of(3))) == official + wider + EMBEDDING == 1_687_353
    gates = 3 * ((3 + 1) * 256 + (256 + 1) * 256 + 256 + 1)
    official, wider = 554_310, 3 * 64 + 37 * 64
    published = size(GNOT(GNOTConfig.published(), shape_of(3)))
    assert published == official - gates + wider + EMBEDDING


def test_ipot_has_the_parameters_of_the_official_one_that_are_alive():
    """1,459,652 of which 395,008 are never called; 197,284 of which 25,024 at its own size."""
    same = IPOTConfig(width=256, cross_heads=4)
    assert size(IPOT(same, shape_of(3))) == 1_459_652 - 395_008 + EMBEDDING
    published = size(IPOT(IPOTConfig.published(), shape_of(3)))
    assert published == 197_284 - 25_024 + EMBEDDING
    assert size(IPOT(IPOTConfig(), shape_of(3))) == 1_617_556
    asked = size(IPOT(IPOTConfig(query_features=True), shape_of(3)))
    assert asked == 1_617_556 + 37 * (320 + 2)


def test_transolver_has_the_parameters_of_the_official_one():
    """1,605,891 less the 192 of a vector that does what a bias does; 723,523 at its own size."""
    assert size(Transolver(TransolverConfig(), shape_of(3))) == 1_605_891 - 192 + EMBEDDING
    published = size(Transolver(TransolverConfig.published(), shape_of(3)))
    assert published == 723_523 + EMBEDDING


def test_the_operator_transformer_has_the_size_it_has_on_the_grid():
    """16 maps in a block beside gate and norms, and three networks of two maps and an end."""
    width, square = 256, (256 + 1) * 256
    gate = (3 + 1) * width + square + (width + 1) * 2
    block = 16 * square + gate + 5 * 2 * width
    around = 6 * square + (40 + 1) * width + (3 + 1) * width + (width + 1) * 3
    assert size(OperatorStepper(OperatorConfig(), shape_of(3))) == block + around + EMBEDDING


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("dimension", [2, 3])
def test_matched_sizes_are_within_a_tenth(kind, dimension):
    """1.6 million parameters, in the plane and in space."""
    matched = size(kind(type(SMALL[kind])(), shape_of(dimension)))
    assert abs(matched / 1.6e6 - 1.0) < 0.1


@pytest.mark.parametrize(
    ("record", "changes", "message"),
    [
        (GNOTConfig, {"heads": 5}, r"GNOTConfig.heads=5 must divide width=96"),
        (GNOTConfig, {"experts": 0}, r"GNOTConfig.experts must be >= 1, got 0"),
        (GNOTConfig, {"dropout": 1.0}, r"GNOTConfig.dropout is a share .* got 1.0"),
        (IPOTConfig, {"cross_heads": 7}, r"IPOTConfig.cross_heads=7 must divide width=320"),
        (IPOTConfig, {"resolution": 1.0}, r"IPOTConfig.resolution must be >= 2 .* got 1.0"),
        (TransolverConfig, {"slices": 0}, r"TransolverConfig.slices must be >= 1, got 0"),
        (OperatorConfig, {"heads": 3}, r"OperatorConfig.heads=3 must divide width=256"),
    ],
)
def test_impossible_settings_are_refused_with_rule_and_value(record, changes, message):
    """Before a network is built."""
    with pytest.raises(ValueError, match=message):
        record(**changes)
