"""Farthest point sampling against its definition; every method draws distinct particles."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from giorom.sampling import (
    SamplingConfig,
    sample,
    sample_farthest,
    sample_random,
    sample_stride,
)

METHODS = ["farthest", "random", "stride"]


def cloud(count: int = 60, dimension: int = 3, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def greedy(points: Tensor, count: int, start: int) -> list[int]:
    """The definition: next comes the point whose distance to those picked is largest."""
    picked = [start]
    while len(picked) < count:
        rest = [i for i in range(len(points)) if i not in picked]
        distance = [min(float((points[i] - points[j]).norm()) for j in picked) for i in rest]
        picked.append(rest[distance.index(max(distance))])
    return picked


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("start", [0, 17])
def test_farthest_points_follow_the_greedy_definition(dimension, start):
    """Eldar et al. 1997, as a loop over all distances."""
    points = cloud(40, dimension)
    found = sample_farthest(points, 15, start=start)
    assert found.tolist() == greedy(points, 15, start)


@pytest.mark.parametrize("dimension", [2, 3])
def test_farthest_points_start_nearest_to_the_centroid(dimension):
    """By brute force."""
    points = cloud(dimension=dimension)
    distance = (points - points.mean(dim=0)).norm(dim=1)
    assert int(sample_farthest(points, 1)[0]) == int(distance.argmin())


@settings(deadline=None, derandomize=True, max_examples=30)
@given(seed=st.integers(0, 1000), start=st.none() | st.integers(0, 29))
def test_permuting_the_particles_permutes_the_farthest_points(seed, start):
    """The choice depends on places, not on the order of storage; random points have no ties."""
    points = cloud(30, seed=seed)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(seed + 1))
    moved = None if start is None else int((order == start).nonzero())
    found = sample_farthest(points[order], 12, start=moved)
    assert torch.equal(order[found], sample_farthest(points, 12, start=start))


def test_a_prefix_is_the_sample_of_that_size():
    """Greedy picking never reconsiders."""
    points = cloud()
    whole = sample_farthest(points, len(points))
    for count in (1, 2, 30, 59):
        assert torch.equal(sample_farthest(points, count), whole[:count])


def test_moving_and_scaling_the_body_keeps_the_choice():
    """Only ratios of distances matter; a power of two scales without rounding."""
    points = cloud()
    expected = sample_farthest(points, 20)
    assert torch.equal(sample_farthest(points * 1024.0, 20), expected)
    assert torch.equal(sample_farthest(points + 3.0, 20), expected)


def test_samples_cover_better_than_the_distance_between_them():
    """Greedy property: no particle is farther from the sample than two samples are apart."""
    points = cloud(200)
    chosen = points[sample_farthest(points, 25)]
    apart = torch.pdist(chosen).min()
    cover = (points[:, None] - chosen).norm(dim=2).min(dim=1).values.max()
    assert cover <= apart


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "points",
    [
        torch.zeros(20, 2),
        cloud(10).repeat(2, 1),
        torch.linspace(0, 1, 20)[:, None] * torch.tensor([1.0, 2.0, 3.0]),
        cloud(20, 2).float(),
    ],
    ids=["one place", "pairs", "line", "float32"],
)
@pytest.mark.parametrize("count", [1, 13, 20])
def test_indices_are_distinct_and_in_range(method, points, count):
    """Also where particles coincide or lie on a line."""
    for seed in (None, 0, 5):
        found = sample(points, SamplingConfig(method=method, count=count), seed=seed)
        assert len(set(found.tolist())) == len(found) == count
        assert 0 <= int(found.min()) <= int(found.max()) < 20


@pytest.mark.parametrize("method", METHODS)
def test_a_single_particle_is_its_own_sample(method):
    """Whatever the reduction."""
    found = sample(torch.zeros(1, 3), SamplingConfig(method=method, reduction=100.0))
    assert found.tolist() == [0]


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_points(method):
    """Randomness is a function of the seed, and the input is left alone."""
    points, kept = cloud(), cloud()
    config = SamplingConfig(method=method, count=20)
    for seed in (None, 3):
        assert torch.equal(sample(points, config, seed=seed), sample(points, config, seed=seed))
    assert torch.equal(points, kept)


@pytest.mark.parametrize("method", ["farthest", "random"])
def test_different_seeds_give_different_points(method):
    """That is what the subsets of training are made of."""
    config = SamplingConfig(method=method, count=20)
    drawn = {tuple(sorted(sample(cloud(), config, seed=seed).tolist())) for seed in range(5)}
    assert len(drawn) > 1


def test_random_samples_are_uniform():
    """Each of 10 points is in a sample of 3 with probability 0.3; 4 sigma of 2000 draws."""
    generator = torch.Generator().manual_seed(0)
    draws = [sample_random(cloud(10), 3, generator=generator) for _ in range(2000)]
    frequency = torch.bincount(torch.cat(draws), minlength=10) / 2000
    assert (frequency - 0.3).abs().max() < 4 * (0.3 * 0.7 / 2000) ** 0.5


@pytest.mark.parametrize("count", [1, 2, 7, 10])
def test_stride_steps_differ_by_at_most_one(count):
    """Equal steps of the index, rounded down."""
    found = sample_stride(cloud(10), count)
    assert found.tolist() == [k * 10 // count for k in range(count)]
    steps = found.diff()
    assert count < 3 or int(steps.max() - steps.min()) <= 1


@pytest.mark.parametrize(
    ("values", "particles", "expected"),
    [
        ({"count": 5}, 100, 5),
        ({"count": 500}, 100, 100),
        ({"reduction": 1.0}, 100, 100),
        ({"reduction": 32.0}, 100, 3),
        ({"reduction": 1000.0}, 100, 1),
    ],
)
def test_the_number_of_samples_is_the_count_or_the_reduced_number(values, particles, expected):
    """count, or particles / reduction; never more than there are, never none."""
    assert SamplingConfig(**values).sample_count(particles) == expected


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "exactly one of reduction and count"),
        ({"reduction": 2.0, "count": 3}, "exactly one of reduction and count"),
        ({"reduction": 0.5}, "reduction must be >= 1, got 0.5"),
        ({"reduction": float("nan")}, "reduction must be >= 1"),
        ({"count": 0}, "count must be >= 1, got 0"),
    ],
)
def test_contradictory_sizes_are_refused(values, message):
    """Each message names the field and the rule."""
    with pytest.raises(ValueError, match=message):
        SamplingConfig(**values)


@pytest.mark.parametrize("count", [0, 11])
def test_more_samples_than_particles_or_none_are_refused(count):
    """All three methods share the rule."""
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(ValueError, match="must be between 1 and 10"):
        sample_farthest(cloud(10), count)
    with pytest.raises(ValueError, match="must be between 1 and 10"):
        sample_random(cloud(10), count, generator=generator)
    with pytest.raises(ValueError, match="must be between 1 and 10"):
        sample_stride(cloud(10), count)


@pytest.mark.parametrize("method", METHODS)
def test_no_particles_or_no_numbers_are_refused(method):
    """A NaN distance would be picked silently by argmax."""
    config = SamplingConfig(method=method, reduction=2.0)
    with pytest.raises(ValueError, match="no particle to sample"):
        sample(torch.zeros(0, 3), config)
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="must be finite"):
            sample(torch.tensor([[0.0, value], [0.0, 0.0]]), config)
