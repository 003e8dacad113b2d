"""Optimal transport: zero on the same cloud, known on shifts, checked by other algorithms."""

import sys

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp
from torch import Tensor

from giorom.evaluation import transport
from giorom.evaluation.transport import (
    earth_mover_distance,
    sinkhorn_divergence,
    typical_spacing,
)

SPACING = 0.1


def cloud(dimension: int = 3, *, count: int = 40, seed: int = 0) -> Tensor:
    """Random points of the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def renumbered(points: Tensor) -> Tensor:
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))]


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_renumbered_cloud_costs_nothing(dimension):
    """Zero on any permutation."""
    points = cloud(dimension)
    for exponent in (1, 2):
        assert earth_mover_distance(points, renumbered(points), exponent=exponent) == 0.0
    assert abs(sinkhorn_divergence(points, renumbered(points), spacing=SPACING)) < 1e-9


@pytest.mark.parametrize("length", [1e-3, 0.5, 40.0])
def test_a_shift_costs_its_length_whatever_the_regularisation(length):
    """W_1 = W_2 = |s|; |x - y - s|^2 differs from |x - y|^2 by separable terms, so S = |s|^2."""
    points = cloud()
    shift = length * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3.0
    moved = renumbered(points + shift)
    assert earth_mover_distance(points, moved, exponent=2) == pytest.approx(length, rel=1e-9)
    assert earth_mover_distance(points, moved) <= length * (1.0 + 1e-9)
    for spacing in (0.02, 0.3):
        found = sinkhorn_divergence(points, moved, spacing=spacing)
        assert found == pytest.approx(length**2, rel=1e-6, abs=1e-9)


def test_the_shift_of_a_line_along_itself_has_the_sorted_cost():
    """On a line the sorted assignment is best: W_1 = mean |x_(i) - y_(i)|."""
    one, two = (cloud(2, seed=seed) * torch.tensor([1.0, 0.0]) for seed in (1, 2))
    sorted_cost = (one[:, 0].sort().values - two[:, 0].sort().values).abs()
    assert earth_mover_distance(one, two) == pytest.approx(float(sorted_cost.mean()), rel=1e-12)
    squared = float(sorted_cost.square().mean())
    assert earth_mover_distance(one, two, exponent=2) ** 2 == pytest.approx(squared, rel=1e-12)


@pytest.mark.parametrize("exponent", [1, 2])
def test_the_assignment_is_the_optimum_of_a_network_simplex(exponent):
    """Another algorithm for the same linear programme: that of POT."""
    import ot

    one, two = cloud(seed=3), cloud(seed=4)
    cost = torch.cdist(one, two, compute_mode="donot_use_mm_for_euclid_dist").numpy() ** exponent
    expected = ot.emd2([], [], cost) ** (1.0 / exponent)
    assert earth_mover_distance(one, two, exponent=exponent) == pytest.approx(expected, rel=1e-9)


def entropic_cost(one: np.ndarray, two: np.ndarray, epsilon: float) -> float:
    """Maximum of the smooth concave dual in one potential, by a quasi-Newton method."""
    cost = np.square(one[:, None] - two[None]).sum(axis=2)

    def negative_dual(f: np.ndarray) -> tuple[float, np.ndarray]:
        exponents = (f[:, None] - cost) / epsilon - np.log(len(one))
        g = -epsilon * logsumexp(exponents, axis=0)
        plan = np.exp(exponents + g / epsilon) / len(two)
        return -(f.mean() + g.mean()), plan.sum(axis=1) - 1.0 / len(one)

    found = minimize(negative_dual, np.zeros(len(one)), jac=True, method="L-BFGS-B", tol=1e-13)
    return -found.fun


@pytest.mark.parametrize(("dimension", "spacing"), [(2, 0.05), (3, 0.1), (3, 0.4)])
def test_the_divergence_is_that_of_the_dual_maximised_directly(dimension, spacing):
    """No Sinkhorn iteration in the reference, and no centring."""
    one, two = cloud(dimension, count=15).numpy(), 0.7 * cloud(dimension, seed=5, count=12).numpy()
    pairs = ((1.0, one, two), (-0.5, one, one), (-0.5, two, two))
    expected = sum(sign * entropic_cost(a, b, (2.0 * spacing) ** 2) for sign, a, b in pairs)
    found = sinkhorn_divergence(torch.from_numpy(one), torch.from_numpy(two), spacing=spacing)
    assert found == pytest.approx(expected, rel=1e-4)


def test_a_weak_regularisation_gives_the_squared_distance_of_the_assignment():
    """S -> W_2^2 as epsilon -> 0; computed with logarithms there."""
    one, two = cloud(2, count=12), cloud(2, count=12, seed=6)
    exact = earth_mover_distance(one, two, exponent=2) ** 2
    assert sinkhorn_divergence(one, two, spacing=0.01) == pytest.approx(exact, rel=0.02)


def test_many_points_are_carried_by_the_divergence(monkeypatch):
    """Above the limit the root of the divergence stands for the distance: exact on a shift."""
    monkeypatch.setattr(transport, "MOST_ASSIGNED", 10)
    points = cloud()
    moved = points + torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    assert earth_mover_distance(points, moved, exponent=2) == pytest.approx(0.05, rel=1e-6)


def test_the_spacing_of_a_lattice_is_its_constant():
    axis = 0.3 * torch.arange(4, dtype=torch.float64)
    assert typical_spacing(torch.cartesian_prod(axis, axis, axis)) == pytest.approx(0.3)


def test_what_cannot_be_compared_is_refused(monkeypatch):
    """Unequal clouds, too many points, no spacing, no library: each says what to do."""
    with pytest.raises(ValueError, match=r"40 and 39 points\. Compare the same points"):
        earth_mover_distance(cloud(), cloud(count=39))
    with pytest.raises(ValueError, match=r"got 0\.0"):
        sinkhorn_divergence(cloud(), cloud(), spacing=0.0)
    monkeypatch.setitem(sys.modules, "ot", None)
    with pytest.raises(ModuleNotFoundError, match=r"giorom\[baselines\]"):
        sinkhorn_divergence(cloud(), cloud(seed=1))
    monkeypatch.setattr(transport, "MOST_TRANSPORTED", 10)
    with pytest.raises(ValueError, match=r"at most 10 points.*got 40"):
        sinkhorn_divergence(cloud(), cloud())
