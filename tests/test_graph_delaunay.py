"""Delaunay graphs against their definition: no point inside the sphere around a simplex."""

from itertools import combinations

import numpy as np
import pytest
import torch
from torch import Tensor

from giorom.data.windows import sample_trajectories
from giorom.features import FeatureConfig, compute_features
from giorom.graph import Edges, connect_points, delaunay_edges, radius_edges
from giorom.normalization import Normalization
from giorom.pipeline import connect_within, start_from_velocity
from giorom.sampling import SamplingConfig
from giorom.state import Trajectory
from giorom.time_stepper import TimeStepper, TimeStepperConfig


def cloud(count: int, dimension: int, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def scenes(*counts: int) -> Tensor:
    """Batch index of scenes with these numbers of particles."""
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))


def pairs(edges: Edges) -> set[tuple[int, int]]:
    """Edges as (sender, receiver)."""
    return set(zip(edges.sender.tolist(), edges.receiver.tolist(), strict=True))


def simplices_by_definition(points: np.ndarray) -> list[tuple[int, ...]]:
    """All sets of d + 1 points whose circumscribed sphere has no other point inside."""
    count, dimension = points.shape
    found = []
    for corners in combinations(range(count), dimension + 1):
        corner = points[list(corners)]
        matrix = 2.0 * (corner[1:] - corner[0])
        center = np.linalg.solve(matrix, (corner[1:] ** 2 - corner[0] ** 2).sum(axis=1))
        square = ((points - center) ** 2).sum(axis=1)
        inside = square < square[corners[0]] * (1.0 - 1e-9)
        if not inside[[n for n in range(count) if n not in corners]].any():
            found.append(corners)
    return found


@pytest.mark.parametrize(("count", "dimension"), [(14, 2), (11, 3)])
@pytest.mark.parametrize("seed", [0, 1])
def test_edges_are_those_of_all_empty_spheres(count, dimension, seed):
    """Brute force over all sets of corners; both directions and self-loops."""
    points = cloud(count, dimension, seed)
    expected = {(n, n) for n in range(count)}
    for corners in simplices_by_definition(points.numpy()):
        expected |= {(i, j) for i in corners for j in corners}
    assert pairs(delaunay_edges(points, scenes(count))) == expected


def test_the_official_graph_keeps_one_direction_and_half_of_a_tetrahedrons_edges():
    """A single tetrahedron of five points' hull, counted by hand; in 2-D all three edges stay."""
    corner = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert len(pairs(delaunay_edges(corner, scenes(4)))) == 4 + 2 * 6
    assert pairs(delaunay_edges(corner, scenes(4), official=True)) == {(0, 1), (0, 2), (1, 2)}

    for dimension, complete in ((2, True), (3, False)):
        points = cloud(14, dimension)
        official = pairs(delaunay_edges(points, scenes(14), official=True))
        correct = pairs(delaunay_edges(points, scenes(14)))
        upward = {(i, j) for i, j in correct if i < j}
        assert official == upward if complete else official < upward


def test_a_batch_of_triangulations_is_its_scenes_side_by_side():
    """Also with scenes too small for a simplex: then everyone is a neighbour."""
    parts = [cloud(count, 2, seed=count) for count in (9, 1, 2, 4)]
    for official in (False, True):
        batch = delaunay_edges(torch.cat(parts), scenes(9, 1, 2, 4), official=official)
        expected, first = set(), 0
        for part in parts:
            alone = pairs(delaunay_edges(part, scenes(len(part)), official=official))
            expected |= {(i + first, j + first) for i, j in alone}
            first += len(part)
        assert pairs(batch) == expected
    few = delaunay_edges(cloud(3, 3), scenes(3))
    assert pairs(few) == {(i, j) for i in range(3) for j in range(3)}


def test_edges_are_sorted_by_receiver_and_counted():
    """As in a radius graph; particles without a sender have no edge in the official one."""
    edges = delaunay_edges(cloud(20, 2), scenes(20), official=True)
    assert torch.equal(edges.offset.diff(), torch.bincount(edges.receiver, minlength=20))
    order = edges.receiver * 20 + edges.sender
    assert bool((order.diff() > 0).all())
    assert int(edges.offset[1]) == 0


def test_a_particle_on_another_one_is_joined_to_it():
    """Qhull leaves it out of the triangulation; without the edge it would be alone."""
    points = cloud(10, 2)
    doubled = torch.cat([points, points[4:5]])
    edges = pairs(delaunay_edges(doubled, scenes(11)))
    assert {(4, 10), (10, 4)} <= edges
    # Which of the two is the corner is Qhull's choice.
    merged = {(i % 10 if i < 10 else 4, j % 10 if j < 10 else 4) for i, j in edges}
    assert merged == pairs(delaunay_edges(points, scenes(10)))


@pytest.mark.parametrize(("dimension", "shape"), [(2, "line"), (3, "plane")])
def test_flat_bodies_have_no_triangulation_and_are_refused(dimension, shape):
    """One line with the way out."""
    points = cloud(8, dimension)
    points[:, -1] = 0.5
    with pytest.raises(ValueError, match=rf"lie in a {shape}.*Set graph\.kind to radius"):
        delaunay_edges(points, scenes(8))
    points[0] = float("nan")
    with pytest.raises(ValueError, match="must be finite"):
        delaunay_edges(points, scenes(8))


@pytest.mark.parametrize("kind", ["radius", "delaunay", "delaunay_official"])
@pytest.mark.parametrize("configuration", ["current", "reference"])
def test_stage_three_builds_the_configured_kind(kind, configuration):
    """Of the configured positions, by the function of that name."""
    points = cloud(12, 2)
    state = start_from_velocity(
        points,
        torch.randn(12, 2, generator=torch.Generator().manual_seed(1)).double(),
        particle_type=torch.full((12,), 5),
        bounds=torch.tensor([[0.0, 1.0]] * 2).double(),
        frame_dt=0.1,
        history=2,
    )
    moved = type(state)(**(vars(state) | {"history": state.history + cloud(12, 2, 3)[:, None]}))
    found = connect_within(0.3, configuration=configuration, kind=kind)(moved)
    place = moved.position if configuration == "current" else moved.reference
    expected = {
        "radius": lambda: radius_edges(place, moved.batch, 0.3),
        "delaunay": lambda: delaunay_edges(place, moved.batch),
        "delaunay_official": lambda: delaunay_edges(place, moved.batch, official=True),
    }[kind]()
    assert pairs(found) == pairs(expected)
    assert pairs(connect_points(place, moved.batch, radius=0.3, kind=kind)) == pairs(expected)


@pytest.mark.parametrize("kind", ["delaunay", "delaunay_official"])
def test_a_time_stepper_runs_on_every_graph(kind):
    """One-directional edges without self-loops give empty means, which are zero and not NaN."""
    points = cloud(20, 2)
    state = start_from_velocity(
        points,
        torch.zeros_like(points),
        particle_type=torch.full((20,), 5),
        bounds=torch.tensor([[0.0, 1.0]] * 2).double(),
        frame_dt=0.1,
        history=2,
    )
    one = (1.0, 1.0)
    scales = Normalization(
        velocity_mean=one, velocity_std=one, acceleration_mean=one, acceleration_std=one
    )
    features = compute_features(
        state,
        connect_within(0.2, configuration="current", kind=kind)(state),
        FeatureConfig(velocities=1),
        normalization=scales,
        radius=0.2,
    )
    config = TimeStepperConfig.default(
        2, latent=False, latent_bounds=[], node_width=6, hidden=8, node_skip="linear"
    )
    output = TimeStepper(config).double()(features)
    output.sum().backward()
    assert bool(output.isfinite().all())


def test_windows_with_a_fixed_graph_bring_one_of_the_configured_kind():
    """The triangulation of the samples' first positions."""
    body = Trajectory(
        position=cloud(15, 2).expand(4, -1, -1),
        particle_type=torch.full((15,), 5),
        frame_dt=0.1,
        bounds=torch.tensor([[0.0, 1.0]] * 2).double(),
    )
    (sampled,) = sample_trajectories(
        [body], SamplingConfig(count=9), subsets=1, reference_radius=0.1, kind="delaunay"
    )
    assert pairs(sampled.edges) == pairs(delaunay_edges(sampled.reference, scenes(9)))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_positions_on_a_device_have_their_graph_there():
    """Triangulated on the processor, brought back."""
    points, batch = cloud(20, 3), scenes(12, 8)
    found = delaunay_edges(points.cuda(), batch.cuda())
    assert found.sender.is_cuda
    assert pairs(found) == pairs(delaunay_edges(points, batch))
