"""Radius graphs against a table of all distances; the radius against its definition."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from giorom import graph
from giorom.graph import (
    Edges,
    GraphConfig,
    choose_radius,
    component_count,
    concatenate_edges,
    nearest_distances,
    radius_edges,
    smallest_radius,
)


def cloud(count: int, dimension: int = 3, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def scenes(*counts: int) -> Tensor:
    """Batch index of scenes with these numbers of particles."""
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))


def by_cells(position: Tensor, batch: Tensor, radius: float) -> Edges:
    """The graph as it is built on a GPU, here on the CPU."""
    sender, receiver = graph._pairs_by_cells(position, batch, radius)
    return graph._sorted_edges(sender, receiver, len(position))


def brute_force(position: Tensor, batch: Tensor, radius: float) -> Tensor:
    """Pairs (receiver, sender) from the table of all distances, sorted."""
    square = (position[:, None] - position).square().sum(dim=2)
    return ((square <= radius * radius) & (batch[:, None] == batch)).nonzero()


def pairs(edges: Edges) -> Tensor:
    """Edges as a table (receiver, sender)."""
    return torch.stack([edges.receiver, edges.sender], dim=1)


@st.composite
def lattice_scenes(draw) -> tuple[Tensor, Tensor, float]:
    """Points on multiples of 1/8: coincident points and exact ties, all without rounding."""
    dimension = draw(st.sampled_from([2, 3]))
    counts = draw(st.lists(st.integers(1, 12), min_size=1, max_size=3))
    place = st.tuples(*[st.integers(-12, 12)] * dimension)
    points = [draw(place) for _ in range(sum(counts))]
    position = torch.tensor(points, dtype=torch.float64) / 8.0
    return position, scenes(*counts), draw(st.integers(1, 12)) / 8.0


@settings(deadline=None, derandomize=True, max_examples=150)
@given(case=lattice_scenes())
def test_tree_and_cells_find_what_the_table_of_all_distances_holds(case):
    """Three implementations, equal to the last edge, also at a distance of exactly r."""
    expected = brute_force(*case)
    assert torch.equal(pairs(radius_edges(*case)), expected)
    assert torch.equal(pairs(by_cells(*case)), expected)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("radius", [0.02, 0.15, 5.0])
def test_tree_and_cells_agree_on_random_bodies(dimension, radius):
    """From hardly any neighbour to all of them."""
    position, batch = cloud(300, dimension), scenes(120, 1, 179)
    expected = brute_force(position, batch, radius)
    assert torch.equal(pairs(radius_edges(position, batch, radius)), expected)
    assert torch.equal(pairs(by_cells(position, batch, radius)), expected)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(case=lattice_scenes())
def test_edges_are_symmetric_sorted_and_complete(case):
    """Self-loops, reverses, ascending receivers, and offsets that count them."""
    position, batch, _ = case
    edges = radius_edges(*case)
    count = len(position)
    known = set(zip(edges.sender.tolist(), edges.receiver.tolist(), strict=True))
    assert len(known) == len(edges.sender)
    assert all((receiver, sender) in known for sender, receiver in known)
    assert all((particle, particle) in known for particle in range(count))
    assert (edges.receiver.diff() >= 0).all()
    degree = torch.bincount(edges.receiver, minlength=count)
    assert torch.equal(
        edges.offset, torch.cat([torch.zeros(1, dtype=torch.long), degree.cumsum(0)])
    )
    assert torch.equal(batch[edges.sender], batch[edges.receiver])


def test_a_batch_is_its_scenes_side_by_side():
    """Overlapping scenes never mix; concatenate_edges gives the same graph."""
    parts = [cloud(count, seed=count) for count in (20, 1, 33)]
    alone = [radius_edges(part, scenes(len(part)), 0.3) for part in parts]
    joined = concatenate_edges(alone)
    batch = radius_edges(torch.cat(parts), scenes(20, 1, 33), 0.3)
    for name in ("sender", "receiver", "offset"):
        assert torch.equal(getattr(joined, name), getattr(batch, name))


def test_joining_one_graph_changes_nothing():
    """Also twice: joining is associative."""
    first, second, third = (radius_edges(cloud(9, seed=s), scenes(9), 0.4) for s in range(3))
    assert torch.equal(concatenate_edges([first]).offset, first.offset)
    left = concatenate_edges([concatenate_edges([first, second]), third])
    right = concatenate_edges([first, concatenate_edges([second, third])])
    assert torch.equal(pairs(left), pairs(right))
    assert torch.equal(left.offset, right.offset)


@pytest.mark.parametrize("build", [radius_edges, by_cells])
def test_an_isolated_particle_has_its_self_loop_alone(build):
    """An empty sum would be 0/0 in a mean."""
    position = torch.cat([cloud(10), torch.full((1, 3), 50.0, dtype=torch.float64)])
    edges = build(position, scenes(11), 0.5)
    assert edges.sender[edges.receiver == 10].tolist() == [10]


@pytest.mark.parametrize("build", [radius_edges, by_cells])
@pytest.mark.parametrize("position", [torch.zeros(1000, 2), cloud(1000) * 0.1])
def test_no_neighbour_is_lost_to_a_cap(build, position):
    """1000 particles in one ball have 10^6 edges; coincident ones are neighbours too."""
    edges = build(position, scenes(1000), 1.0)
    assert len(edges.sender) == 1_000_000
    assert torch.equal(edges.offset, torch.arange(1001) * 1000)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_a_radius_that_is_not_positive_is_refused(radius):
    """The message names the unit and the value."""
    with pytest.raises(ValueError, match="radius must be > 0 m"):
        radius_edges(cloud(3), scenes(3), radius)
    with pytest.raises(ValueError, match=r"GraphConfig\.radius must be > 0 m"):
        GraphConfig(radius=radius)


@pytest.mark.parametrize("margin", [0.99, float("nan")])
def test_a_margin_below_one_is_refused(margin):
    """Below the smallest radius the components multiply, by definition."""
    with pytest.raises(ValueError, match="margin must be >= 1"):
        GraphConfig(margin=margin)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_position_that_is_not_finite_is_refused(value):
    """NaN compares false with every distance: the particle would just vanish."""
    position = cloud(5)
    position[2, 1] = value
    with pytest.raises(ValueError, match="must be finite"):
        radius_edges(position, scenes(5), 0.1)


def test_edges_move_to_a_device_unchanged():
    """The device is all that changes."""
    edges = radius_edges(cloud(9), scenes(9), 0.4)
    assert torch.equal(pairs(edges.to("cpu")), pairs(edges))


def flood_fill(position: Tensor, radius: float) -> int:
    """Components of the radius graph by painting neighbours."""
    near = (position[:, None] - position).norm(dim=2) <= radius
    unpainted, components = set(range(len(position))), 0
    while unpainted:
        components += 1
        front = [unpainted.pop()]
        while front:
            found = set(near[front.pop()].nonzero()[:, 0].tolist()) & unpainted
            unpainted -= found
            front += found
    return components


@pytest.mark.parametrize("radius", [0.01, 0.1, 0.15, 0.3])
def test_components_are_those_of_a_flood_fill(radius):
    """Another implementation."""
    position = cloud(60, 2)
    assert component_count(position, radius) == flood_fill(position, radius)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(2, 60),
    dimension=st.sampled_from([2, 3]),
    share=st.floats(0.0, 1.0),
)
def test_at_the_smallest_radius_the_components_are_as_wanted(seed, count, dimension, share):
    """The definition: right at that radius, one more just below it (random points: no ties)."""
    position = cloud(count, dimension, seed)
    wanted = 1 + int(share * (count - 2))
    radius = smallest_radius(position, wanted)
    assert component_count(position, radius) == wanted
    assert component_count(position, radius * (1.0 - 1e-9)) == wanted + 1


def test_the_smallest_radius_joins_two_clusters_by_the_gap_between_them():
    """Two squares of side 1, 5 apart: 1 keeps them two, 5 makes them one, 0 leaves eight."""
    square = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    position = torch.cat([square, square + torch.tensor([6.0, 0.0])])
    assert smallest_radius(position, 2) == pytest.approx(1.0, rel=1e-11)
    assert smallest_radius(position, 1) == pytest.approx(5.0, rel=1e-11)
    assert smallest_radius(position, 8) == smallest_radius(position, 100) == 0.0


def test_coincident_points_are_joined_by_any_radius():
    """Distance zero is an edge, not a missing one; distinct places set the radius."""
    position = torch.zeros(20, 3, dtype=torch.float64)
    assert 0.0 <= smallest_radius(position, 1) < 1e-300
    position[10:, 0] = 2.0
    assert smallest_radius(position, 1) == pytest.approx(2.0, rel=1e-11)
    assert component_count(position, 1.0) == 2


def test_a_crowd_at_one_place_costs_no_more_than_its_place():
    """Listing the pairs of 100,000 coincident particles would take 80 GB."""
    crowd = torch.zeros(100_000, 3, dtype=torch.float64)
    apart = 1.0 + torch.arange(3, dtype=torch.float64)[:, None].expand(3, 3)
    points = torch.cat([crowd, apart])
    assert component_count(points, 0.5) == 4
    assert component_count(points, 2.0) == 1
    distance = nearest_distances(points.numpy())
    assert (distance[:100_000] == 0.0).all()
    np.testing.assert_allclose(distance[100_000:], 3.0**0.5)


def test_nearest_distances_are_those_of_the_table_of_all_distances():
    """Random points, a few of them twice; by brute force."""
    points = np.random.default_rng(0).integers(0, 6, (60, 3)).astype(np.float64)
    table = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(table, np.inf)
    np.testing.assert_allclose(nearest_distances(points), table.min(axis=1))
    assert nearest_distances(points[:1]) == np.inf


def test_fewer_than_one_component_is_refused():
    """No radius joins particles to less than one body."""
    with pytest.raises(ValueError, match="components must be >= 1"):
        smallest_radius(cloud(5), 0)


def lattice(side: int, spacing: float) -> Tensor:
    """A square body of side^2 points."""
    axis = torch.arange(side, dtype=torch.float64) * spacing
    return torch.cartesian_prod(axis, axis)


def test_the_chosen_radius_keeps_two_bodies_two():
    """Full and sparse graph have as many components (section 5.2 of the paper)."""
    body = lattice(20, 0.05)
    full = torch.cat([body, body + torch.tensor([3.0, 0.0])])
    sparse = full[::7]
    choice = choose_radius(sparse, full, margin=1.5)
    assert choice.components == 2
    assert choice.full_radius == pytest.approx(0.1, rel=1e-11)
    assert component_count(sparse, choice.radius) == 2
    degree = np.diff(radius_edges(sparse, scenes(len(sparse)), choice.radius).offset) - 1
    assert choice.mean_degree == pytest.approx(degree.mean())


def test_the_chosen_radius_joins_one_body():
    """Whatever the sample, its graph at the chosen radius is in one piece, margin or not."""
    full = lattice(20, 0.05)
    for seed in range(20):
        order = torch.randperm(400, generator=torch.Generator().manual_seed(seed))
        choice = choose_radius(full[order[:30]], full, margin=1.0)
        assert choice.components == component_count(full[order[:30]], choice.radius) == 1


@pytest.mark.parametrize("step", [1, 9])
def test_the_log_line_of_a_radius_is_true(step):
    """Radius = margin times the larger of the two radii it names."""
    full = lattice(20, 0.05)
    choice = choose_radius(full[::step], full, margin=1.5)
    larger = max(choice.smallest, choice.full_radius)
    assert choice.radius == pytest.approx(1.5 * larger)
    assert f"graph radius {choice.radius:.4f} m = 1.5 x {larger:.4f} m" in str(choice)


def test_a_body_of_one_particle_asks_for_a_radius():
    """It has no neighbour whose distance could set one."""
    one = torch.zeros(1, 2, dtype=torch.float64)
    with pytest.raises(ValueError, match="Set the radius"):
        choose_radius(one, one, margin=1.5)
