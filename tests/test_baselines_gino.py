"""GINO against its formula written as loops, and against the library its blocks come from."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom.baselines.gino import GINO, GINOConfig
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.graph import Edges

SMALL = {
    "side": 4,
    "modes": 2,
    "width": 6,
    "layers": 2,
    "in_hidden": [7],
    "out_hidden": [5, 6],
    "embedding": 3,
    "padding": 0.25,
}
BOUNDS = [[0.0, 1.0], [-1.0, 0.5], [2.0, 3.0]]


def shape_of(dimension: int) -> NetworkShape:
    """The ends of a network for five velocities and walls."""
    return NetworkShape(
        dimension=dimension,
        node_width=7 * dimension,
        edge_width=dimension + 1,
        bounds=BOUNDS[:dimension],
    )


def make(dimension: int, **options: object) -> GINO:
    """A small network in float64, always with the same weights."""
    torch.manual_seed(0)
    return GINO(GINOConfig(**(SMALL | options)), shape_of(dimension)).double()


def features(dimension: int, count: int = 5) -> Features:
    """A handful of particles in one scene, without edges; those with other types than the first."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(BOUNDS[:dimension], dtype=torch.float64).unbind(dim=1)
    share = torch.rand(count, dimension, generator=generator, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.long)
    return Features(
        node=torch.randn(count, 7 * dimension, generator=generator, dtype=torch.float64),
        particle_type=torch.arange(count) % 9,
        edge=torch.zeros(0, dimension + 1, dtype=torch.float64),
        edges=Edges(sender=none, receiver=none, offset=none.new_zeros(count + 1)),
        position=low + share * (high - low),
        batch=torch.zeros(count, dtype=torch.long),
    )


def looped(network: GINO, given: Features) -> Tensor:
    """The formula: a mean over near particles, the blocks, a sum over near nodes."""
    low, high = torch.tensor(BOUNDS[: given.position.shape[1]]).double().unbind(dim=1)
    low, high = low - 0.25 * (high - low), high + 0.25 * (high - low)
    axes = [torch.linspace(a, b, 4, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    nodes = torch.cartesian_prod(*axes)
    reach = float(1.5 * 0.5 * ((high - low) / 3).norm())
    value = torch.cat([network.type_embedding(given.particle_type), given.node], dim=1)

    def seen(target: Tensor, source: Tensor) -> Tensor:
        return torch.cat([(source - target) / reach, (target - low) / (high - low)])

    near = (nodes[:, None] - given.position).norm(dim=2) <= reach
    token = torch.zeros(len(nodes), value.shape[1], dtype=torch.float64)
    for g, node in enumerate(nodes):
        parts = [
            network.encode.kernel(torch.cat([seen(node, given.position[p]), value[p]]))
            for p in near[g].nonzero()[:, 0]
        ]
        if parts:
            token[g] = sum(parts) / len(parts)
    field = network.lifting(token).T.unflatten(1, [4] * given.position.shape[1])[None]
    for number in range(2):
        field = network.blocks(field.contiguous(), number)
    token = field[0].flatten(1).T
    rows = []
    for p, place in enumerate(given.position):
        close = near[:, p].nonzero()[:, 0]
        rows.append(sum(network.decode.kernel(seen(place, nodes[g])) * token[g] for g in close))
    return network.projection(torch.stack(rows))


@pytest.mark.parametrize("dimension", [2, 3])
def test_network_is_its_formula(dimension):
    """Loops over five particles and all nodes of a grid a quarter wider than the bounds."""
    network, given = make(dimension), features(dimension)
    torch.testing.assert_close(network(given), looped(network, given), rtol=0, atol=1e-11)
    assert float(network.coverage(given.position)) == 1.0


@pytest.mark.parametrize(("dimension", "side", "modes"), [(2, 8, 4), (3, 6, 2)])
def test_blocks_equal_those_with_the_convolution_of_the_library(dimension, side, modes):
    """The same weights in neuralop's blocks as it makes them."""
    from neuralop.layers.fno_block import FNOBlocks

    width = 6
    ours = make(dimension, side=side, modes=modes).float().blocks
    theirs = FNOBlocks(width, width, [modes] * dimension, n_layers=2)
    kept = {k: v for k, v in ours.state_dict().items() if "convs" not in k}
    missing = theirs.load_state_dict(kept, strict=False)
    assert not missing.unexpected_keys
    assert all("convs" in key for key in missing.missing_keys)
    with torch.no_grad():
        for their, our in zip(theirs.convs, ours.convs, strict=True):
            their.weight.tensor.copy_(torch.view_as_complex(our.inner.weight))
            their.bias.copy_(our.inner.bias.view_as(their.bias))
    expected = field = torch.randn(2, width, *[side] * dimension)
    for number in range(2):
        field, expected = ours(field, number), theirs(expected, number)
    torch.testing.assert_close(field, expected, rtol=1e-4, atol=1e-5)


def test_size_is_that_of_the_library_but_for_the_ends_of_the_kernels():
    """1,608,968 of neuralop's GINO: its kernels see 384 sinusoids of two places, ours 6 numbers.

    Ours knows the types of the particles; complex weights count twice. The baselines' notes give
    the number for the same sizes.
    """
    network = GINO(GINOConfig(), shape_of(3))
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == 1_608_968 - 2 * 128 * (384 - 6) + 9 * 16
    dead = 4 * 24**2  # the imaginary parts at frequency zero
    assert count - dead == pytest.approx(1.6e6, rel=0.1)
    plane = GINO(GINOConfig(), shape_of(2))
    assert sum(p.numel() for p in plane.parameters()) == pytest.approx(1.6e6, rel=0.1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_every_number_learns_but_the_imaginary_parts_at_frequency_zero(dimension):
    """The mean of a real field is real; all other frequencies within Nyquist's are used."""
    network, given = make(dimension), features(dimension, count=45)
    network(given).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad.any(), name
        if name.endswith("inner.weight"):
            dead = parameter.grad.abs().amax(dim=(0, 1)) < 1e-14
            zero = [1] * (dimension - 1) + [0]
            assert dead.nonzero().tolist() == [[*zero, 1]], name


def test_scenes_have_grids_of_their_own():
    """Two scenes in one place: each as if alone."""
    network, one = make(3), features(3)
    other = replace(one, node=one.node.flip(0), position=one.position.roll(1, 0))
    parts = ("node", "particle_type", "position")
    both = {name: torch.cat([getattr(one, name), getattr(other, name)]) for name in parts}
    edges = replace(one.edges, offset=torch.zeros(11, dtype=torch.long))
    batch = torch.arange(2).repeat_interleave(5)
    together = network(replace(one, edges=edges, batch=batch, batch_size=2, **both))
    alone = torch.cat([network(one), network(other)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modes": 9}, "modes must be between 1 and half of side=16.*Got 9"),
        ({"side": 8, "modes": 8}, "half of side=8"),
        ({"width": 0}, "width, layers, embedding and the hidden widths must be >= 1, got 0"),
        ({"out_hidden": [0]}, "hidden widths must be >= 1"),
        ({"padding": -0.1}, r"padding is a share .* must be in \[0, 1\], got -0.1"),
        ({"radius": 0.0}, "radius must be > 0 m, got 0.0"),
    ],
)
def test_impossible_values_are_refused(changes, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        GINOConfig(**changes)
