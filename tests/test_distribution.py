"""Distances between clouds: blind to numbering, known on a shift, a scaling and disjoint clouds."""

import math

import pytest
import torch
from torch import Tensor

from giorom.evaluation.distribution import (
    chamfer_distance,
    density_difference,
    sliced_wasserstein,
)
from giorom.evaluation.metrics import bounding_box_error, centroid_error

UNIT = {2: torch.tensor([[0.0, 1.0]] * 2), 3: torch.tensor([[0.0, 1.0]] * 3)}


def cloud(dimension: int, *, count: int = 60, seed: int = 0) -> Tensor:
    """Random points of the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def distances(first: Tensor, second: Tensor) -> tuple[float, float, float]:
    """All three."""
    density = density_difference(first, second, bounds=UNIT[first.shape[1]])
    return chamfer_distance(first, second), density, sliced_wasserstein(first, second)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_renumbered_cloud_is_the_same_cloud(dimension):
    """Zero on any permutation; the identity-wise error is not."""
    points = cloud(dimension)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(1))
    assert distances(points, points[order]) == pytest.approx((0.0, 0.0, 0.0), abs=1e-30)
    assert float((points - points[order]).square().sum(1).mean()) > 0.1


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_distances_are_symmetric(dimension):
    """d(a, b) = d(b, a)."""
    a, b = cloud(dimension), cloud(dimension, seed=2)
    assert distances(a, b) == pytest.approx(distances(b, a), rel=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_shift_has_the_sliced_distance_of_its_square_over_the_dimension(dimension):
    """Mean of (n.s)^2 over a spherical design is |s|^2 / d, whatever the direction of s."""
    points = cloud(dimension)
    for seed in range(3):
        shift = cloud(dimension, count=1, seed=seed) - 0.5
        found = sliced_wasserstein(points, points + shift)
        assert found == pytest.approx(float(shift.square().sum()) / dimension, rel=1e-12)


def test_a_scaled_cloud_has_the_sliced_distance_of_its_second_moment():
    """Sorted projections keep their order: (s - 1)^2 <|x|^2> / d."""
    points = cloud(3) - 0.5
    expected = 0.25 * float(points.square().sum(1).mean()) / 3
    assert sliced_wasserstein(points, 1.5 * points) == pytest.approx(expected, rel=1e-12)


def test_the_chamfer_distance_of_a_small_shift_is_twice_its_square():
    """Points of a lattice stay nearest to their own image: |s|^2 there and |s|^2 back."""
    axis = torch.arange(4, dtype=torch.float64)
    lattice = torch.cartesian_prod(axis, axis, axis)
    shift = torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64)
    expected = 2.0 * float(shift.square().sum())
    assert chamfer_distance(lattice, lattice + shift) == pytest.approx(expected)


def test_the_chamfer_distance_takes_clouds_of_different_sizes():
    """One point against two at distances 1 and 2: 1 there, (1 + 4) / 2 back."""
    one = torch.zeros(1, 2, dtype=torch.float64)
    two = torch.tensor([[1.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    assert chamfer_distance(one, two) == pytest.approx(1.0 + 2.5)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_density_difference_is_the_share_that_has_moved(dimension):
    """A quarter of a cloud in a far cell: 1/4; all of it: 1; beyond the wall: the cell inside."""
    here = torch.full((8, dimension), 0.01, dtype=torch.float64)
    there = here.clone()
    there[:2] = 0.99
    bounds = UNIT[dimension]
    assert density_difference(here, there, bounds=bounds) == 0.25
    assert density_difference(here, here + 0.98, bounds=bounds) == 1.0
    assert density_difference(here, here - 0.5, bounds=bounds) == 0.0


def test_unequal_clouds_have_no_sliced_distance():
    """Sorted projections are compared one by one."""
    with pytest.raises(ValueError, match="got 60 and 59 points"):
        sliced_wasserstein(cloud(2), cloud(2, count=59))


def test_centroid_and_box_of_a_shift_and_of_a_stretch():
    """A shift moves both by its length; a stretch about the centroid moves the sides alone."""
    points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    shift = torch.tensor([3.0, 4.0])
    assert centroid_error(points + shift, points) == 5.0
    assert bounding_box_error(points + shift, points) == 3.5
    stretched = torch.tensor([1.0, 1.0]) + 1.5 * (points - 1.0)
    assert centroid_error(stretched, points) == 0.0
    assert bounding_box_error(stretched, points) == 0.5


def test_distances_of_half_and_single_precision_are_computed_in_double():
    """A shift of 2^-20 of float32 points on a grid of 2^-20."""
    points = (cloud(3) * 2**19).round().float() / 2**19
    found = sliced_wasserstein(points, points + 2.0**-20)
    assert found == pytest.approx(2.0**-40, rel=1e-12)
    assert math.sqrt(chamfer_distance(points, points + 2.0**-20) / 2) < 2.0**-18
