"""Moving least squares: closed forms, and neighbourhoods that cannot determine a polynomial."""

import math

import pytest
import torch
from torch import Tensor

from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.neighbors import body_labels, nearest_samples


def cloud(count: int, dimension: int = 2, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def field(dimension: int = 2, **values: object) -> LocalField:
    """A field with some settings."""
    return LocalField(LocalConfig(**values), dimension=dimension)


def quadratic(points: Tensor) -> Tensor:
    """A motion with every quadratic term."""
    x, y, z = points[:, 0], points[:, 1], points[:, -1]
    moved = points.clone()
    moved[:, 0] += 0.3 + 0.2 * x * y - 0.4 * z.square()
    moved[:, 1] += 0.1 * x.square() - 0.3 * y.square() + 0.2 * y * z
    return moved


@pytest.mark.parametrize("dimension", [2, 3])
def test_quadratic_motions_are_exact_in_degree_two(dimension):
    """A polynomial of the degree of the fit is its own fit; rounding grows by the conditioning."""
    samples, query = cloud(60, dimension), cloud(400, dimension, seed=1)
    found = field(dimension, degree=2).bind(samples, query)(quadratic(samples))
    torch.testing.assert_close(found, quadratic(query), rtol=0, atol=1e-9)
    first = field(dimension, degree=1).bind(samples, query)(quadratic(samples))
    assert float((first - quadratic(query)).abs().max()) > 1e-3


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("neighbors", [None, 4, 6])
def test_rotations_are_exact_however_few_neighbors(dimension, degree, neighbors):
    """The affine part is fitted first: too few neighbours for a parabola do not spoil it."""
    samples, query = cloud(40, dimension), cloud(50, dimension, seed=1)
    angle = math.radians(40.0)
    matrix = torch.eye(dimension, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    decode = field(dimension, degree=degree, neighbors=neighbors).bind(samples, query)
    torch.testing.assert_close(decode(samples @ matrix.T), query @ matrix.T, rtol=0, atol=1e-8)


@pytest.mark.parametrize("degree", [1, 2])
def test_samples_keep_their_own_motion(degree):
    """Interpolating weights: off by the floor of the weight, 1e-8, times the spread of the rest."""
    samples = cloud(50)
    moved = samples + 0.1 * cloud(50, seed=3)
    found = field(degree=degree).bind(samples, samples)(moved)
    torch.testing.assert_close(found, moved, rtol=0, atol=1e-6)


def test_the_error_of_a_smooth_motion_falls_with_the_cube_of_the_spacing():
    """Degree two leaves a remainder of order h^3: halving h divides it by eight, here by 5 to 13.

    Samples lie on a grid, queries inside it.
    """
    query = 0.25 + 0.5 * cloud(200, seed=1)

    def error(side: int) -> float:
        axis = torch.linspace(0.0, 1.0, side, dtype=torch.float64)
        samples = torch.cartesian_prod(axis, axis)
        wave = [p + 0.1 * torch.sin(5.0 * p.flip(1) + 1.0) for p in (samples, query)]
        found = field(degree=2).bind(samples, query)(wave[0])
        return float((found - wave[1]).square().mean().sqrt())

    ratio = error(11) / error(21)
    assert 5.0 < ratio < 13.0


@pytest.mark.parametrize("degree", [1, 2])
def test_samples_on_a_line_give_finite_motions(degree):
    """Nothing is known across the line: translations are exact, the rest stays bounded."""
    samples = torch.stack([torch.linspace(0, 1, 20), torch.zeros(20)], dim=1).double()
    query = cloud(30)
    decode = field(degree=degree).bind(samples, query)
    torch.testing.assert_close(decode(samples + 0.5), query + 0.5, rtol=0, atol=1e-10)
    bent = samples + torch.tensor([0.0, 0.1], dtype=torch.float64) * samples[:, :1].square()
    assert float((decode(bent) - query).abs().max()) < 0.2


def grid(x: float) -> Tensor:
    """A square body of 11 x 11 points whose left edge is at ``x``."""
    axis = torch.linspace(0.0, 0.5, 11, dtype=torch.float64)
    return torch.cartesian_prod(axis + x, axis)


def test_bodies_side_by_side_do_not_drag_each_other():
    """Two squares more than three spacings apart; one moves, the other stays to the last bit."""
    both = torch.cat([grid(0.0), grid(0.68)])
    samples = torch.arange(0, len(both), 5)
    moved = both.clone()
    moved[121:, 1] += 1.0
    found = field().bind(both[samples], both)(moved[samples])
    assert torch.equal(found[:121], both[:121])
    torch.testing.assert_close(found[121:], moved[121:], rtol=0, atol=1e-12)


def test_a_body_without_samples_joins_the_nearest_one():
    """Its points have no motion of their own to go by; three samples make a body in the plane."""
    both = torch.cat([grid(0.0), grid(0.68), grid(1.36)])
    samples = torch.cat([both[:121:5], both[121:123], both[242::5]])
    of_samples, of_points = body_labels(samples, both, least=3)
    assert len(set(of_points.tolist())) == 2
    assert len(set(of_points[:121].tolist())) == 1
    assert len(set(of_points[242:].tolist())) == 1
    assert set(of_points[121:].tolist()) == set(of_points.tolist())
    assert of_samples[25] == of_points[121]


def test_the_search_on_an_accelerator_finds_what_the_tree_finds():
    """All distances against the k-d tree, bodies apart."""
    from giorom.fields.neighbors import _by_distances, _by_tree

    samples, query = cloud(70, 3), cloud(40, 3, seed=1)
    assert torch.equal(_by_tree(samples, query, 9), _by_distances(samples, query, 9))


def test_neighbors_come_from_the_same_body_first():
    """A nearer sample of another body is taken only when the own ones are used up, and marked."""
    samples = torch.tensor([[0.0, 0.0], [0.1, 0.0], [5.0, 0.0]], dtype=torch.float64)
    labels = (torch.tensor([0, 1, 0]), torch.tensor([0]))
    index, same = nearest_samples(samples, samples[1:2] - 0.01, count=3, labels=labels)
    assert index.tolist() == [[0, 2, 1]]
    assert same.tolist() == [[True, True, False]]


def test_more_neighbors_than_samples_are_those_there_are():
    """Never an error; the error for too few samples is the contract's."""
    samples, query = cloud(5), cloud(10, seed=1)
    found = field(neighbors=50).bind(samples, query)(samples + 0.5)
    torch.testing.assert_close(found, query + 0.5, rtol=0, atol=1e-12)


def test_an_empty_neighborhood_is_refused():
    """The message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=r"neighbors must be >= 1, got 0"):
        LocalConfig(neighbors=0)
