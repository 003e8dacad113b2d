"""The grid with multilinear weights: laws of a partition of one, and SciPy's interpolation."""

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from giorom.layers.linear_grid import LinearGrid

BOUNDS = [[-0.3, 1.2], [0.1, 2.0], [-1.0, 1.5]]


@pytest.fixture(params=[2, 3])
def case(request):
    """A grid of five nodes along each axis, thirty points of two scenes, their stencil."""
    dimension = request.param
    grid = LinearGrid(bounds=BOUNDS[:dimension], side=5)
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(BOUNDS[:dimension], dtype=torch.float64).unbind(dim=1)
    share = torch.rand(30, dimension, generator=generator, dtype=torch.float64)
    position = low + share * (high - low)
    batch = torch.arange(2).repeat_interleave(15)
    return grid, position, batch, grid.stencil(position, batch, scenes=2)


def test_a_constant_is_read_exactly(case):
    """The weights of a point add up to one."""
    grid, _, _, stencil = case
    nodes = torch.full((2 * grid.node_count, 3), 0.7, dtype=torch.float64)
    torch.testing.assert_close(stencil.to_points(nodes), nodes[:30], rtol=0, atol=1e-15)


def test_mass_and_momentum_are_kept_in_every_scene(case):
    """What 15 particles of mass one and some momentum give to the nodes is what they have."""
    _, position, _, stencil = case
    given = torch.cat([torch.ones_like(position[:, :1]), torch.randn(30, 3).double()], dim=1)
    found = stencil.to_nodes(given).view(2, -1, 4).sum(dim=1)
    assert found[:, 0].tolist() == pytest.approx([15.0, 15.0], abs=1e-13)
    torch.testing.assert_close(found, given.view(2, 15, 4).sum(dim=1), rtol=0, atol=1e-12)


def test_both_ways_are_adjoint(case):
    """<to_nodes u, v> = <u, to_points v>: the same weights in both directions."""
    grid, _, _, stencil = case
    at_points = torch.randn(30, 2, dtype=torch.float64)
    at_nodes = torch.randn(2 * grid.node_count, 2, dtype=torch.float64)
    left = (stencil.to_nodes(at_points) * at_nodes).sum()
    right = (at_points * stencil.to_points(at_nodes)).sum()
    torch.testing.assert_close(left, right, rtol=1e-12, atol=0)


def test_fields_are_read_as_by_scipy(case):
    """Its RegularGridInterpolator on random nodes, each scene on its own grid."""
    grid, position, batch, stencil = case
    dimension, side = position.shape[1], grid.side
    nodes = torch.randn(2, *[side] * dimension, dtype=torch.float64)
    axes = [np.linspace(low, high, side) for low, high in grid.bounds]
    expected = torch.empty(30, dtype=torch.float64)
    for scene in range(2):
        read = RegularGridInterpolator(axes, nodes[scene].numpy())
        own = batch == scene
        expected[own] = torch.from_numpy(read(position[own].numpy()))
    found = stencil.to_points(nodes.flatten()[:, None])[:, 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_gradients_reach_values_and_positions(case):
    """Against finite differences along random directions."""
    grid, position, batch, _ = case
    position = position[::6].requires_grad_()
    nodes = torch.randn(2 * grid.node_count, 2, dtype=torch.float64, requires_grad=True)
    value = torch.randn(5, 1, dtype=torch.float64, requires_grad=True)

    def both(position, nodes, value):
        stencil = grid.stencil(position, batch[::6], scenes=2)
        return stencil.to_points(nodes), stencil.to_nodes(value)

    assert torch.autograd.gradcheck(both, (position, nodes, value), fast_mode=True)


def test_points_beyond_the_nodes_count_as_lying_on_the_outermost_ones(case):
    """They keep a weight of one and are not covered."""
    grid, position, batch, stencil = case
    far = position.clone()
    far[:3] += 100.0
    far[3] = -100.0
    corner = torch.tensor(grid.bounds, dtype=torch.float64)
    held = far.clone()
    held[:3], held[3] = corner[:, 1], corner[:, 0]
    nodes = torch.randn(2 * grid.node_count, 1, dtype=torch.float64)
    one, other = (grid.stencil(at, batch, scenes=2).to_points(nodes) for at in (far, held))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    assert float(grid.coverage(position)) == 1.0
    assert float(grid.coverage(far)) == pytest.approx(26 / 30)
    assert float(stencil.to_nodes(torch.ones(30, 1).double()).sum()) == pytest.approx(30.0)
