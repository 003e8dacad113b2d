"""What every baseline must satisfy, whatever it is made of; kinds join by being registered."""

from collections.abc import Callable
from dataclasses import fields, replace

import pytest
import torch
from torch import nn

from giorom.baselines import BaselineConfig, NetworkShape, build_baseline, reads_edges
from giorom.baselines.choice import KINDS, settings_type
from giorom.features import Features
from giorom.graph import Edges

BOUNDS = [-0.2, 1.2]
"""Padded bounds on each axis [m]; the particles lie in the unit box."""

SMALL: dict[str, dict[str, object]] = {
    "gns": {"layers": 3, "hidden": 16},
    "gat": {"layers": 3, "hidden": 16, "heads": 2},
    "gnot": {"layers": 2, "width": 16, "heads": 2, "inner": 2},
    "ipot": {"latents": 8, "width": 16, "repeats": 2, "cross_heads": 2, "heads": 2, "bands": 3},
    "transolver": {"layers": 2, "width": 16, "heads": 2, "slices": 4},
    "operator": {"width": 16, "heads": 2},
    "gino": {"side": 6, "modes": 3, "width": 8, "layers": 2, "in_hidden": [8], "out_hidden": [8]},
    "unet": {"side": 8, "channels": [8, 8, 16], "types": [5, 6]},
}
"""Settings that make a kind small; without an entry it is tested in its full size."""

TRANSLATION_INVARIANT = {"linear", "gns", "gat"}
"""Kinds that never read a position. The others see where a particle is in the domain, so that a
translation of the body alone is another input to them."""


def config_of(kind: str, dimension: int, **overrides: object) -> BaselineConfig:
    """A small network of a kind for the features of these tests."""
    shape = NetworkShape(
        dimension=dimension,
        node_width=7 * dimension,
        edge_width=dimension + 1,
        bounds=[BOUNDS] * dimension,
    )
    settings = settings_type(kind)(**(SMALL.get(kind, {}) | overrides))
    return BaselineConfig(kind=kind, shape=shape, **{kind: settings})


@pytest.fixture(params=[f"{kind}-{d}d" for kind in KINDS for d in (2, 3)])
def config(request: pytest.FixtureRequest) -> BaselineConfig:
    """Every kind in the plane and in space."""
    kind, dimension = request.param.split("-")
    return config_of(kind, int(dimension[0]))


@pytest.fixture
def dimension(config: BaselineConfig) -> int:
    """Space dimension."""
    return config.shape.dimension


@pytest.fixture
def network(config: BaselineConfig) -> nn.Module:
    """The network in float64, always with the same weights, none of them zero.

    Gates and last layers that start at zero would hide what lies behind them.
    """
    torch.manual_seed(0)
    network = build_baseline(config).double().eval()
    with torch.no_grad():
        for parameter in network.parameters():
            if not parameter.any():
                parameter.normal_(std=0.1)
    return network


def type_embedding(network: nn.Module) -> nn.Embedding:
    """The embedding of the particle types, wherever the network keeps it."""
    return next(part for part in network.modules() if isinstance(part, nn.Embedding))


def relative_difference(one: torch.Tensor, other: torch.Tensor) -> float:
    """Root of the mean squared difference over that of the second."""
    one, other = one.detach(), other.detach()
    return float(((one - other).square().mean() / other.square().mean()).sqrt())


def without_edges(features: Features) -> Features:
    """The same particles, no two of them connected, not even to themselves."""
    none = features.edges.sender[:0]
    offset = torch.zeros(len(features.node) + 1, dtype=none.dtype)
    edges = Edges(sender=none, receiver=none, offset=offset)
    return replace(features, edge=features.edge[:0], edges=edges)


def test_permuting_the_particles_permutes_the_accelerations(
    network, dimension, random_features, make_features
):
    """The samples are a set: f(P x) = P f(x), up to the order of the sums."""
    features = random_features([40], dimension=dimension)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    permuted = make_features(
        features.position[order],
        features.node[order],
        features.particle_type[order],
        features.batch,
    )
    torch.testing.assert_close(network(permuted), network(features)[order], rtol=0, atol=1e-10)


def test_a_scene_does_not_feel_the_others_of_its_batch(
    network, dimension, random_features, make_features
):
    """f(A and B) = f(A) and f(B), for scenes of any sizes that overlap in space."""
    both = random_features([30, 1, 25], dimension=dimension)
    alone = []
    for scene in range(3):
        own = both.batch == scene
        alone.append(
            network(
                make_features(
                    both.position[own],
                    both.node[own],
                    both.particle_type[own],
                    both.batch[own] * 0,
                )
            )
        )
    torch.testing.assert_close(network(both), torch.cat(alone), rtol=0, atol=1e-10)


def test_a_translation_matters_to_those_alone_that_read_positions(
    config, network, dimension, random_features, make_features
):
    """f(x + c) = f(x) where that is claimed, and another answer where it is not."""
    features = random_features([40], dimension=dimension)
    moved = make_features(
        features.position + 0.1, features.node, features.particle_type, features.batch
    )
    difference = relative_difference(network(moved), network(features))
    assert (difference < 1e-11) == (config.kind in TRANSLATION_INVARIANT)


def test_edges_matter_to_those_that_read_them_alone(config, network, dimension, random_features):
    """A kind that claims to read no edges gives the same answer without any."""
    features = random_features([40], dimension=dimension)
    difference = relative_difference(network(without_edges(features)), network(features))
    assert (difference > 1e-9) == reads_edges(config)


def test_gradients_are_finite_and_reach_every_parameter(network, dimension, random_features):
    """No parameter is dead: each live one is counted, and no other."""
    features = random_features([60, 40], dimension=dimension)
    embedding = type_embedding(network)
    types = torch.arange(100) % embedding.num_embeddings
    network(replace(features, particle_type=types)).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
    assert embedding.weight.grad.any(dim=1).all()


def test_one_particle_and_no_edges_give_finite_numbers(network, dimension, random_features):
    """No neighbour, a scene of one, an empty graph: empty means are zero, not 0/0."""
    for counts in ([1], [20, 1, 1]):
        features = random_features(counts, dimension=dimension)
        for seen in (features, without_edges(features)):
            network.zero_grad()
            acceleration = network(seen)
            acceleration.square().sum().backward()
            assert acceleration.isfinite().all()
            grads = [p.grad for p in network.parameters() if p.grad is not None]
            assert all(grad.isfinite().all() for grad in grads)


def test_particles_far_outside_the_bounds_give_finite_numbers(network, dimension, random_features):
    """A rollout that goes astray has to be recognised by its error, not by a crash."""
    features = random_features([30], dimension=dimension)
    position = features.position.clone()
    position[0] += 40.0
    assert network(replace(features, position=position)).isfinite().all()


def test_the_input_is_not_changed(network, dimension, random_features):
    """Two draws from one seed are equal; one is used, and must stay equal to the other."""
    used, kept = (random_features([30], dimension=dimension) for _ in range(2))
    network(used).sum().backward()
    for name in (item.name for item in fields(Features)):
        if name not in ("edges", "batch_size"):
            torch.testing.assert_close(getattr(used, name), getattr(kept, name), rtol=0, atol=0)
    torch.testing.assert_close(used.edges.sender, kept.edges.sender, rtol=0, atol=0)


def test_single_precision_differs_by_rounding_alone(network, dimension, random_features):
    """1e-7 times the depth and no more; the output has the shape and precision of the input."""
    double = network(random_features([30], dimension=dimension))
    single = network.float()(random_features([30], dimension=dimension, dtype=torch.float32))
    assert double.shape == single.shape == (30, dimension)
    assert (double.dtype, single.dtype) == (torch.float64, torch.float32)
    assert relative_difference(single.double(), double) < 1e-4


def test_autocast_is_close_to_single_precision(network, dimension, random_features):
    """bfloat16 keeps 8 bits: a few per cent of the spread of the output, with gradients."""
    features = random_features([30, 20], dimension=dimension, dtype=torch.float32)
    single = network.float()(features)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = network(features)
    mixed.float().square().sum().backward()
    assert relative_difference(mixed.float(), single) < 0.1
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())


def test_repeating_a_step_repeats_every_bit(network, dimension, random_features):
    """On the CPU sums run in a fixed order, forwards and backwards."""
    features = random_features([30, 20], dimension=dimension, dtype=torch.float32)
    runs = []
    for _ in range(2):
        network.float().zero_grad()
        output = network(features)
        output.square().sum().backward()
        runs.append([output.detach(), *(p.grad.clone() for p in network.parameters())])
    assert all(torch.equal(first, second) for first, second in zip(*runs, strict=True))


def test_coverage_is_a_share(network, dimension, random_features):
    """One for all particles inside the bounds, or what a grid with gaps reaches."""
    position = random_features([30], dimension=dimension).position
    coverage = network.coverage(position)
    assert coverage.shape == ()
    assert 0.9 <= float(coverage) <= 1.0


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_stored_simulator_with_a_baseline_is_the_same_one(
    kind, simulator, random_features, tmp_path
):
    """Configuration and weights through JSON and safetensors, bit for bit."""
    from giorom.simulator import Simulator

    config = config_of(kind, 3)
    shape = replace(
        config.shape,
        node_width=simulator.config.features.node_width(3),
        edge_width=simulator.config.features.edge_width(3),
    )
    whole = replace(simulator.config, time_stepper=None, baseline=replace(config, shape=shape))
    torch.manual_seed(0)
    first = Simulator(whole).eval()
    first.save_pretrained(tmp_path)
    torch.manual_seed(1)
    second = Simulator.from_pretrained(tmp_path)
    assert second.config == first.config
    features = random_features([30], dimension=3, dtype=torch.float32)
    wide = torch.randn(30, shape.node_width, generator=torch.Generator().manual_seed(0))
    edge = features.edge.repeat(1, 3)[:, : shape.edge_width]
    features = replace(features, node=wide, edge=edge)
    networks = [simulator.dynamics.time_stepper for simulator in (first, second)]
    assert torch.equal(networks[0](features), networks[1](features))


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_size_of_the_authors_can_be_built(kind):
    """On the meta device: no memory is taken, every width has to fit."""
    for dimension in (2, 3):
        shape = config_of(kind, dimension).shape
        settings: Callable = settings_type(kind).published
        with torch.device("meta"):
            build_baseline(BaselineConfig(kind=kind, shape=shape, **{kind: settings()}))
