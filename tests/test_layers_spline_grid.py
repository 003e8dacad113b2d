"""The background grid against the moments of quadratic B-splines."""

import pytest
import torch

from giorom.layers.spline_grid import SplineGrid

SPACING = 0.05


def grid_and_points(dimension, count=200):
    bounds = torch.tensor([[0.1, 0.9]] * dimension, dtype=torch.float64)
    generator = torch.Generator().manual_seed(dimension)
    points = 0.1 + 0.8 * torch.rand(count, dimension, generator=generator, dtype=torch.float64)
    return SplineGrid(bounds, spacing=SPACING), points


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_weights_have_the_moments_of_a_quadratic_spline(dimension):
    """Sum one, mean zero, second moment h^2 / 4 on every axis, no mixed moment."""
    grid, points = grid_and_points(dimension)
    found = grid.stencil(points, torch.zeros(len(points), dtype=torch.long))
    assert found.weight.min() >= 0.0
    one = torch.ones(len(points), dtype=torch.float64)
    torch.testing.assert_close(found.weight.sum(dim=1), one)
    mean = torch.einsum("qk,qkd->qd", found.weight, found.offset)
    torch.testing.assert_close(mean, torch.zeros_like(mean), atol=1e-12, rtol=0.0)
    second = torch.einsum("qk,qkd,qke->qde", found.weight, found.offset, found.offset)
    wanted = torch.eye(dimension, dtype=torch.float64).expand_as(second) / grid.inverse_moment
    torch.testing.assert_close(second, wanted, atol=1e-12, rtol=0.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_offsets_lead_from_each_point_to_its_nodes(dimension):
    grid, points = grid_and_points(dimension)
    batch = torch.arange(len(points)) % 3
    found = grid.stencil(points, batch.sort().values)
    scene = found.node // grid.node_count
    assert torch.equal(scene[:, 0], batch.sort().values)
    place = grid.node_position[found.node % grid.node_count]
    torch.testing.assert_close(points[:, None] + found.offset, place)


def test_what_the_points_give_arrives_whole():
    grid, points = grid_and_points(2)
    batch = (torch.arange(len(points)) >= 100).long()
    found = grid.stencil(points, batch)
    value = torch.arange(len(points), dtype=torch.float64)[:, None, None] * found.weight[..., None]
    total = grid.gather(found, value, scenes=2).reshape(2, -1).sum(dim=1)
    wanted = torch.arange(len(points), dtype=torch.float64).reshape(2, -1).sum(dim=1)
    torch.testing.assert_close(total, wanted)


@pytest.mark.parametrize("far", [-5.0, 7.0, 1e12])
def test_points_far_outside_touch_nodes_that_exist(far):
    grid, _ = grid_and_points(3)
    found = grid.stencil(torch.full((1, 3), far, dtype=torch.float64), torch.zeros(1).long())
    assert int(found.node.min()) >= 0
    assert int(found.node.max()) < grid.node_count
    assert torch.isfinite(found.weight).all()


def test_walls_lie_on_nodes():
    grid, _ = grid_and_points(2)
    for wall in (0.1, 0.9):
        assert float((grid.node_position[:, 0] - wall).abs().min()) < 1e-9


@pytest.mark.parametrize(
    ("spacing", "message"), [(1e-30, "would have"), (1e-4, "would have"), (0.9, "not one cell")]
)
def test_a_grid_that_cannot_be_held_or_used_is_refused(spacing, message):
    """Before it takes any memory, with the way out."""
    with pytest.raises(ValueError, match=rf"{message}.*GridStepperConfig\.spacing"):
        SplineGrid(torch.tensor([[0.1, 0.9]] * 2), spacing=spacing)
