"""The convolutions on the latent grid against loops over the nodes, and against a moved field."""

from itertools import product

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from giorom.layers.grid_convolution import DILATIONS, ConvolutionLayer, GridConvolution


def looped(layer: ConvolutionLayer, field: Tensor) -> Tensor:
    """The layer on a field (c *grid), node by node: nothing beyond the boundary."""
    sides, (distance, *_) = field.shape[1:], layer.kernel.dilation
    seen = functional.gelu(field)
    result = field.clone()
    for node in product(*map(range, sides)):
        total = layer.kernel.bias.clone()
        for step in product((-1, 0, 1), repeat=len(sides)):
            other = tuple(n + distance * s for n, s in zip(node, step, strict=True))
            if all(0 <= o < side for o, side in zip(other, sides, strict=True)):
                weight = layer.kernel.weight[(..., *(s + 1 for s in step))]
                total = total + weight @ seen[(slice(None), *other)]
        matrix = layer.matrix.weight.flatten(1)
        added = matrix @ functional.gelu(total) + layer.matrix.bias
        result[(slice(None), *node)] = field[(slice(None), *node)] + added
    return result


@pytest.mark.parametrize(("dimension", "side", "dilation"), [(2, 5, 1), (2, 5, 2), (3, 4, 1)])
def test_a_layer_is_a_sum_over_the_nodes_around_each_node(dimension, side, dilation):
    """The formula of its docstring, written out."""
    torch.manual_seed(0)
    layer = ConvolutionLayer(3, dimension=dimension, dilation=dilation).double()
    field = torch.randn(2, 3, *[side] * dimension, dtype=torch.float64)
    expected = torch.stack([looped(layer, one) for one in field])
    torch.testing.assert_close(layer(field), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("dimension", "side"), [(2, 22), (3, 19)])
def test_a_field_moved_by_a_cell_gives_the_result_moved_by_a_cell(dimension, side):
    """Along every axis, at nodes farther from the boundary than the three layers see."""
    torch.manual_seed(0)
    network = GridConvolution(2, 4, 3, dimension=dimension, layers=3).double()
    field = torch.randn(*[side] * dimension, 2, dtype=torch.float64)
    reach = sum(DILATIONS) + 1
    inside = (slice(reach, side - reach),) * dimension

    def processed(value: Tensor) -> Tensor:
        return network(value.flatten(0, -2)[None])[0].unflatten(0, [side] * dimension)

    before = processed(field)
    for axis in range(dimension):
        after = processed(field.roll(1, dims=axis))
        torch.testing.assert_close(
            after[inside], before.roll(1, dims=axis)[inside], rtol=0, atol=1e-12
        )
        assert (after - before)[inside].abs().max() > 1e-3


def test_the_layers_see_twice_as_far_from_one_to_the_next():
    """A disturbed node is felt 1 + 2 + 4 nodes away along an axis, and no farther."""
    torch.manual_seed(0)
    side, middle = 21, 10
    network = GridConvolution(1, 4, 1, dimension=2, layers=3).double()
    field = torch.zeros(1, side * side, 1, dtype=torch.float64)
    disturbed = field.clone()
    disturbed[0, middle * side + middle] = 1.0
    change = (network(disturbed) - network(field)).detach()[0, :, 0].unflatten(0, [side] * 2).abs()
    felt = (change.amax(dim=1) > 1e-12).nonzero()[:, 0] - middle
    assert (int(felt.min()), int(felt.max())) == (-7, 7)


def test_scenes_of_a_batch_do_not_mix():
    """Each on a grid of its own."""
    network = GridConvolution(2, 4, 3, dimension=2, layers=2).double()
    token = torch.randn(3, 16, 2, dtype=torch.float64)
    alone = torch.cat([network(one[None]) for one in token])
    torch.testing.assert_close(network(token), alone, rtol=0, atol=1e-12)
