"""What pictures and Table 11 say of a rollout, against SciPy and values known by hand."""

import pytest
import torch
from scipy.spatial.distance import pdist

from giorom.data.trajectory_file import read_trajectory
from giorom.evaluation.stage_speed import connect_at
from giorom.graph import delaunay_edges, radius_edges
from giorom.reproduce.figure5a import pairwise_difference
from giorom.reproduce.pictures import draw_cloud, draw_space
from giorom.reproduce.rollouts import edges_between, joined_components, roll
from giorom.reproduce.table11 import official_viscosity, viscosity


def no_batch(points):
    return torch.zeros(len(points), dtype=torch.long)


def test_the_spacing_of_a_motion_is_the_smallest_distance_of_scipy():
    """Mean over frames of the smallest entry of the distance matrix."""
    motion = torch.rand(5, 40, 2, generator=torch.Generator().manual_seed(0))
    expected = sum(float(pdist(frame.double().numpy()).min()) for frame in motion) / 5
    assert viscosity(motion)["spacing"] == pytest.approx(expected, rel=1e-12)
    assert official_viscosity(motion)["official_spacing"] == pytest.approx(expected, rel=1e-12)


def test_the_speed_of_a_motion_is_that_of_its_fastest_particle():
    """One particle moves by (3, 4), then by (0, 1): (5 + 1) / 2.

    The official rule takes the largest component instead.
    """
    motion = torch.tensor(
        [
            [[0.0, 0.0], [9.0, 9.0]],
            [[3.0, 4.0], [9.0, 9.0]],
            [[3.0, 5.0], [9.0, 9.0]],
        ]
    )
    assert viscosity(motion)["speed"] == pytest.approx(3.0)
    assert official_viscosity(motion)["official_speed"] == pytest.approx(4.0)


def test_the_official_rule_sees_neither_coincident_particles_nor_motion_to_the_left():
    """The sign counts, so that a body that moves to the left has no speed; the caption sees it."""
    start = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.3, 0.0]])
    motion = torch.stack([start, start - torch.tensor([0.5, 0.0])])
    found = viscosity(motion) | official_viscosity(motion)
    assert (found["spacing"], found["speed"]) == (0.0, pytest.approx(0.5))
    assert found["official_spacing"] == pytest.approx(0.3)
    assert found["official_speed"] == 0.0


def test_components_and_edges_of_a_graph_are_those_seen_by_eye():
    """Two pairs of neighbours apart from each other have two edges and two components.

    A square that is triangulated has four sides and a diagonal, of which the official code keeps
    one direction.
    """
    pairs = torch.tensor([[0.0, 0.0], [0.1, 0.0], [1.0, 0.0], [1.1, 0.0]])
    graph = radius_edges(pairs, no_batch(pairs), 0.2)
    assert joined_components(graph) == 2
    assert edges_between(graph).tolist() == [[0, 1], [2, 3]]
    square = torch.tensor([[0.0, 0.0], [1.0, 0.1], [0.0, 1.0], [1.0, 1.0]])
    for official in (False, True):
        graph = delaunay_edges(square, no_batch(square), official=official)
        assert joined_components(graph) == 1
        assert len(edges_between(graph)) == 5


def test_the_difference_of_discretisations_is_the_mean_over_their_pairs():
    """Three copies moved by 0, 1 and 2: distances 1, 2 and 1; of a single one there is none."""
    body = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    shift = torch.tensor([1.0, 0.0, 0.0])
    copies = torch.stack([body, body + shift, body + 2.0 * shift])
    assert pairwise_difference(copies) == pytest.approx(4.0 / 3.0, rel=1e-5)
    assert pairwise_difference(body.expand(4, -1, -1)) == 0.0
    assert pairwise_difference(body[None]) is None


def test_another_radius_changes_the_graph_and_only_if_asked_the_features(simulator, data_folder):
    """At the trained radius the rollout is the trained one; far below it the graph falls apart."""
    trajectory = read_trajectory(data_folder, "test", 0)
    samples = simulator.sample(trajectory.position[0])
    options = {"samples": samples, "frames": 5}
    trained = roll(simulator, trajectory, **options)
    same = roll(
        simulator, trajectory, connect=connect_at(simulator, None, rescaled=True), **options
    )
    assert torch.equal(same.rollout.position, trained.rollout.position)
    assert trained.mse > 0.0
    assert torch.equal(trained.truth, trajectory.position[len(trained.given) :][:5][:, samples])
    radius = simulator.config.graph.radius
    connect = connect_at(simulator, 0.4 * radius, rescaled=False)
    assert simulator.dynamics.radius == radius
    split = roll(simulator, trajectory, connect=connect, **options)
    assert joined_components(split.edges) > joined_components(trained.edges)
    connect_at(simulator, 0.4 * radius, rescaled=True)
    assert simulator.dynamics.radius == 0.4 * radius


def test_clouds_are_drawn_at_equal_scales_within_their_walls():
    """A square domain is a square on the page, and every wall is there: a cube has 12 edges."""
    from matplotlib.figure import Figure

    figure = Figure()
    plane = figure.add_subplot(1, 2, 1)
    draw_cloud(plane, [[0.5, 0.5], [0.5, -3.0]], bounds=[[0.1, 0.9], [0.1, 0.9]], pairs=[])
    assert plane.get_aspect() == 1.0
    assert [text.get_text() for text in plane.texts] == ["1 of 2 outside"]
    assert [patch.get_bbox().bounds for patch in plane.patches] == [
        pytest.approx((0.1, 0.1, 0.8, 0.8))
    ]
    space = figure.add_subplot(1, 2, 2, projection="3d")
    draw_space(space, [[0.5, 0.5, 0.5], [2.0, 0.5, 0.5]], bounds=[[0.0, 1.0]] * 3)
    assert "1 of 2 outside" in space.get_title()
    assert len(space.lines) == 12
