"""The closed-form neighbours of a regular grid against a table of all distances."""

import math

import pytest
import torch
from torch import Tensor

from giorom.layers.latent_grid import LatentGrid

GRIDS = {
    "cube": LatentGrid(bounds=[[0.0, 1.0]] * 3, side=6),
    "far": LatentGrid(bounds=[[0.0, 1.0]] * 3, side=6, radius=0.37),
    "blind": LatentGrid(bounds=[[0.0, 1.0]] * 2, side=9, radius=0.04),
    "box": LatentGrid(bounds=[[-1.0, 2.0], [0.0, 0.5]], side=7),
}


@pytest.fixture(params=list(GRIDS))
def grid(request: pytest.FixtureRequest) -> LatentGrid:
    """A grid."""
    return GRIDS[request.param]


def points(grid: LatentGrid, count: int = 200) -> Tensor:
    """Points in and a little around the grid."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(count, len(grid.bounds), generator=generator, dtype=torch.float64) * 1.4
    low, high = torch.tensor(grid.bounds, dtype=torch.float64).unbind(dim=1)
    return low + (unit - 0.2) * (high - low)


def nodes(grid: LatentGrid) -> Tensor:
    """All nodes, last axis fastest [m]."""
    axes = [torch.linspace(low, high, grid.side, dtype=torch.float64) for low, high in grid.bounds]
    return torch.cartesian_prod(*axes)


def brute_force(grid: LatentGrid, position: Tensor) -> Tensor:
    """Table (q nodes) of who is in reach."""
    offset = position[:, None] - nodes(grid)
    return offset.norm(dim=-1) <= grid.reach


def test_pairs_are_those_of_the_table_of_all_distances(grid):
    """Every pair in reach, once, sorted by particle, with its offset."""
    position = points(grid)
    pairs = grid.pairs(position)
    particle, node = brute_force(grid, position).nonzero(as_tuple=True)
    assert torch.equal(pairs.particle, particle)
    assert torch.equal(pairs.node, node)
    expected = (position[particle] - nodes(grid)[node]) / grid.reach
    torch.testing.assert_close(pairs.relative, expected, rtol=0, atol=1e-12)


def test_coverage_is_that_of_the_table_of_all_distances(grid):
    """Share of the rows of the table that hold at least one node."""
    position = points(grid)
    expected = brute_force(grid, position).any(dim=1).double().mean()
    assert float(grid.coverage(position)) == pytest.approx(float(expected), abs=1e-6)


def test_half_the_diagonal_of_a_cell_reaches_every_point_inside():
    """The farthest point from every node is the middle of a cell (method notes, 1.6)."""
    bounds, middle = [[0.0, 1.0]] * 3, torch.full((1, 3), 0.1, dtype=torch.float64)
    reach = LatentGrid(bounds=bounds, side=6).covering_radius
    assert reach == pytest.approx(0.5 * math.sqrt(3) * 0.2)
    for factor, expected in ((1.001, 1.0), (0.999, 0.0)):
        grid = LatentGrid(bounds=bounds, side=6, radius=factor * reach)
        assert float(grid.coverage(middle)) == expected


def test_the_published_two_dimensional_grid_misses_half_of_the_points():
    """32^2 nodes on [-1, 1]^2 with reach 0.024 cover 43 %: pi 0.024^2 / (2/31)^2."""
    grid = LatentGrid(bounds=[[-1.0, 1.0]] * 2, side=32, radius=0.024)
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(20_000, 2, generator=generator, dtype=torch.float64) * 1.8 - 0.9
    expected = math.pi * 0.024**2 / (2 / 31) ** 2
    assert float(grid.coverage(position)) == pytest.approx(expected, abs=0.02)


def test_unit_coordinates_of_the_nodes_are_their_places(grid):
    """Node k seen as a point of space has the unit coordinates of node k."""
    index = torch.arange(grid.node_count)
    place = nodes(grid)
    torch.testing.assert_close(grid.node_unit(index, place), grid.unit(place), rtol=0, atol=1e-12)


def test_occupied_tokens_are_the_reached_nodes_of_each_scene(grid):
    """Per scene: the columns of the table with an entry, in ascending order."""
    position, batch = points(grid), torch.arange(3).repeat_interleave(torch.tensor([120, 60, 20]))
    pairs = grid.pairs(position)
    tokens = grid.tokens(pairs, batch, 3, occupied=True)
    table = brute_force(grid, position)
    for scene in range(3):
        expected = table[batch == scene].any(dim=0).nonzero()[:, 0]
        assert torch.equal(tokens.node[scene, tokens.mask[scene]], expected)
    assert torch.equal(tokens.node.flatten()[tokens.slot], pairs.node)
    size = tokens.node.shape[1]
    assert torch.equal(tokens.slot // size, batch[pairs.particle])


def test_all_tokens_are_all_nodes(grid):
    """Slot = scene times nodes + node."""
    position, batch = points(grid), torch.arange(2).repeat_interleave(100)
    pairs = grid.pairs(position)
    tokens = grid.tokens(pairs, batch, 2, occupied=False)
    assert torch.equal(tokens.node, torch.arange(grid.node_count)[None])
    assert torch.equal(tokens.slot, batch[pairs.particle] * grid.node_count + pairs.node)
    assert tokens.mask is None
