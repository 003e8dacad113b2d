"""The U-Net on a grid: what is spread, what is read, its levels written out, its size."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from giorom.baselines.shape import NetworkShape
from giorom.baselines.unet import GridUNet, UNet, UNetConfig
from giorom.features import Features
from giorom.graph import Edges

SMALL = {"side": 4, "channels": [8, 16], "groups": 4, "embedding": 3}


def shape_of(dimension: int) -> NetworkShape:
    """The ends of a network for five velocities and walls, in the unit box."""
    return NetworkShape(
        dimension=dimension,
        node_width=7 * dimension,
        edge_width=dimension + 1,
        bounds=[[0.0, 1.0]] * dimension,
    )


def make(dimension: int = 2, **options: object) -> UNet:
    """A small network in float64, always with the same weights."""
    torch.manual_seed(0)
    return UNet(UNetConfig(**(SMALL | options)), shape_of(dimension)).double()


def features(dimension: int = 2, counts: tuple[int, ...] = (40, 25)) -> Features:
    """Random scenes of water, sand and goop in a corner of the box, without edges."""
    generator = torch.Generator().manual_seed(0)
    total = sum(counts)
    none = torch.zeros(0, dtype=torch.long)
    return Features(
        node=torch.randn(total, 7 * dimension, generator=generator, dtype=torch.float64),
        particle_type=torch.randint(5, 8, (total,), generator=generator),
        edge=torch.zeros(0, dimension + 1, dtype=torch.float64),
        edges=Edges(sender=none, receiver=none, offset=none.new_zeros(total + 1)),
        position=0.6 * torch.rand(total, dimension, generator=generator, dtype=torch.float64),
        batch=torch.arange(len(counts)).repeat_interleave(torch.tensor(counts)),
        batch_size=len(counts),
    )


def spread(network: UNet, given: Features) -> torch.Tensor:
    """What the network sees, scene by scene (b n c)."""
    seen = []
    network.network.register_forward_pre_hook(lambda _, values: seen.append(values[0]))
    network(given)
    return seen[-1].flatten(2).transpose(1, 2).detach()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_grid_holds_density_and_means_of_its_particles(dimension):
    """Density times the mean of a feature, summed over the nodes, is the sum over the particles."""
    network, given = make(dimension, types=[6]), features(dimension)
    fields, width = spread(network, given), 7 * dimension
    embedded = network.type_embedding(given.particle_type)
    content = torch.cat([given.node, embedded], dim=1).detach()
    sand = (given.particle_type == 6).double()[:, None]
    for scene, count in enumerate((40, 25)):
        own = given.batch == scene
        density = fields[scene, :, :1] * (count / fields[scene, :, 0].sum())
        mean = fields[scene, :, 1 : 1 + width + 3]
        torch.testing.assert_close((density * mean).sum(dim=0), content[own].sum(dim=0))
        of_sand = fields[scene, :, 1 + width + 3 :]
        mass = of_sand[:, :1] * (count / fields[scene, :, 0].sum())
        torch.testing.assert_close(mass.sum(), sand[own].sum())
        torch.testing.assert_close(
            (mass * of_sand[:, 1:]).sum(dim=0), (sand * given.node)[own].sum(dim=0)
        )
        seen = (density * fields[scene, :, :1]).sum() / count
        torch.testing.assert_close(seen, torch.ones_like(seen))  # what particles see in the mean
    empty = fields[:, :, 0] == 0.0
    assert empty.any()
    assert not fields[empty].any()


def test_a_constant_field_accelerates_all_particles_alike():
    """Wherever they are: the weights of a particle add up to one."""
    network, given = make(), features()
    with torch.no_grad():
        network.network.out.weight.zero_()
        network.network.out.bias.copy_(torch.tensor([0.25, -9.75]))
    expected = torch.tensor([0.25, -9.75], dtype=torch.float64).expand(65, 2)
    torch.testing.assert_close(network(given), expected, rtol=0, atol=1e-14)


def test_more_samples_of_the_same_body_change_nothing():
    """Every particle three times: the density in units of its mean and the means stay."""
    network, given = make(types=[5, 6]), features()
    order = torch.arange(65).repeat_interleave(3)
    names = ("node", "particle_type", "position", "batch")
    repeated = {name: getattr(given, name)[order] for name in names}
    edges = replace(given.edges, offset=torch.zeros(3 * 65 + 1, dtype=torch.long))
    thrice = replace(given, edges=edges, **repeated)
    torch.testing.assert_close(network(thrice), network(given)[order], rtol=0, atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_levels_are_convolutions_on_coarser_grids_and_back(dimension):
    """Two levels from functional operations, the transposed convolution as a loop over corners."""
    torch.manual_seed(0)
    network = GridUNet(3, [4, 6], 2, dimension=dimension, groups=2).double()
    convolve = (functional.conv2d, functional.conv3d)[dimension - 2]
    weights = {name: value.detach() for name, value in network.named_parameters()}

    def stage(field, name):
        for first, second in ((0, 1), (3, 4)):
            field = convolve(field, weights[f"{name}.{first}.weight"], padding=1)
            parts = field.unflatten(1, (2, -1))
            axes = tuple(range(2, parts.ndim))
            mean = parts.mean(dim=axes, keepdim=True)
            variance = parts.var(dim=axes, keepdim=True, unbiased=False)
            field = ((parts - mean) / (variance + 1e-5).sqrt()).flatten(1, 2)
            scale, shift = (
                weights[f"{name}.{second}.{which}"].view(-1, *[1] * dimension)
                for which in ("weight", "bias")
            )
            field = functional.gelu(scale * field + shift)
        return field

    given = torch.randn(2, 3, *[4] * dimension, dtype=torch.float64)
    fine = stage(given, "down.0")
    halves = fine
    for axis in range(2, 2 + dimension):
        halves = halves.unflatten(axis, (-1, 2)).mean(dim=axis + 1)
    coarse = stage(halves, "down.1")
    lifted = torch.zeros_like(fine)
    for corner in torch.cartesian_prod(*[torch.arange(2)] * dimension).tolist():
        place = (..., *(slice(step, None, 2) for step in corner))
        weight = weights["lift.0.weight"][(..., *corner)]
        bias = weights["lift.0.bias"].view(-1, *[1] * dimension)
        lifted[place] = torch.einsum("bi...,io->bo...", coarse, weight) + bias
    field = stage(torch.cat([fine, lifted], dim=1), "up.0")
    last = weights["out.weight"].flatten(1)
    expected = torch.einsum("bi...,oi->bo...", field, last)
    expected = expected + weights["out.bias"].view(-1, *[1] * dimension)
    torch.testing.assert_close(network(given), expected)


@pytest.mark.parametrize("dimension", [2, 3])
def test_size_is_that_of_the_other_networks(dimension):
    """1.6 million within a tenth; from kernels, norms and steps between the levels."""
    network = UNet(UNetConfig(), shape_of(dimension))
    side, channels = UNetConfig().size(dimension)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == pytest.approx(1.6e6, rel=0.1)
    assert network.grid.side == side
    cells, seen = 3**dimension, 1 + 7 * dimension + 16
    first, second, third = channels
    kernels = seen * first + first**2 + first * second + second**2 + second * third + third**2
    kernels += 2 * second * second + second**2 + 2 * first * first + first**2
    norms = 2 * 2 * (2 * first + 2 * second + third)
    steps = 2**dimension * (third * second + second * first) + second + first
    ends = 9 * 16 + first * dimension + dimension
    assert count == cells * kernels + norms + steps + ends


def test_the_published_size_is_that_of_its_configuration():
    """64 nodes a side and four levels of 64 channels."""
    assert UNetConfig.published().size(2) == (64, [64, 64, 64, 64])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": [32, 20]}, r"multiples of groups=8, one for each level, got \[32, 20\]"),
        ({"channels": []}, "multiples of groups"),
        ({"side": 18}, "side=18 must be >= 2 and divisible by 4"),
        ({"embedding": 0}, "embedding and groups must be >= 1, got 0"),
    ],
)
def test_impossible_values_are_refused(changes, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        UNetConfig(**changes)
