"""What the network sees: widths, order, invariance, and finite gradients."""

from dataclasses import replace
from itertools import product

import pytest
import torch

from giorom.features import (
    DISPLACEMENT_GAIN,
    REST_POSITION_GAIN,
    FeatureConfig,
    Features,
    compute_features,
)
from giorom.graph import Edges, radius_edges
from giorom.normalization import Normalization
from giorom.state import KINEMATIC, SparseState

RADIUS = 0.5
ALL = [
    FeatureConfig(
        velocities=velocities,
        velocity_form=form,
        walls=walls,
        displacement=displacement,
        rest_edges=rest,
        rest_shape=shape,
    )
    for velocities, form, walls, displacement, rest, shape in product(
        (1, 3), ("standardized", "differences"), *[(False, True)] * 4
    )
]
UNIT = {2: [[0.0, 1.0]] * 2, 3: [[0.0, 1.0]] * 3}


def scales(dimension: int, factor: float = 1.0) -> Normalization:
    """No offset and one scale."""
    zero, std = (0.0,) * dimension, (factor,) * dimension
    return Normalization(
        velocity_mean=zero, velocity_std=std, acceleration_mean=zero, acceleration_std=std
    )


def scene(history: int, *, dimension: int = 2, count: int = 12) -> SparseState:
    """A random body in the unit box with random motion."""
    generator = torch.Generator().manual_seed(0)
    frames = torch.rand(count, history, dimension, generator=generator, dtype=torch.float64)
    return SparseState(
        history=frames,
        reference=torch.rand(count, dimension, generator=generator, dtype=torch.float64),
        particle_type=torch.full((count,), 6),
        batch=torch.arange(2).repeat_interleave(count // 2),
        batch_size=2,
        bounds=torch.tensor(UNIT[dimension], dtype=torch.float64),
        frame_dt=0.25,
    )


def connect(state: SparseState) -> Edges:
    """Its radius graph."""
    return radius_edges(state.position, state.batch, RADIUS)


def compute(state: SparseState, config: FeatureConfig, edges: Edges | None = None) -> Features:
    """Features with unit scales."""
    return compute_features(
        state,
        connect(state) if edges is None else edges,
        config,
        normalization=scales(state.history.shape[2]),
        radius=RADIUS,
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("config", ALL, ids=str)
def test_widths_are_those_the_configuration_promises(config, dimension):
    """The network is built from the promise and fed with the features."""
    features = compute(scene(config.history, dimension=dimension), config)
    assert features.node.shape == (12, config.node_width(dimension))
    assert features.edge.shape == (len(features.edges.sender), config.edge_width(dimension))
    assert features.node.dtype == features.edge.dtype == torch.float64
    assert features.node.isfinite().all()
    assert features.batch_size == 2


@pytest.mark.parametrize("config", ALL, ids=str)
def test_only_the_wall_distances_feel_a_translation(config):
    """Adding c to body and undeformed body alike; the edges are kept."""
    state, edges = scene(config.history), connect(scene(config.history))
    moved = replace(state, history=state.history + 0.25, reference=state.reference + 0.25)
    before, after = compute(state, config, edges), compute(moved, config, edges)
    torch.testing.assert_close(after.edge, before.edge, rtol=0, atol=1e-13)
    velocities = 2 * config.velocities
    free = torch.ones(before.node.shape[1], dtype=torch.bool)
    free[velocities : velocities + 4 * config.walls] = False
    torch.testing.assert_close(after.node[:, free], before.node[:, free], rtol=0, atol=1e-12)
    assert config.walls != torch.equal(after.node[:, ~free], before.node[:, ~free])


def test_moving_body_and_walls_together_changes_nothing():
    """Wall distances are distances."""
    config = FeatureConfig(velocities=2, displacement=True, rest_edges=True)
    state = scene(3)
    moved = replace(
        state,
        history=state.history + 0.25,
        reference=state.reference + 0.25,
        bounds=state.bounds + 0.25,
    )
    torch.testing.assert_close(compute(moved, config).node, compute(state, config).node)


def test_wall_distances_are_clipped_at_one_radius():
    """clip((x - lo) / r, (hi - x) / r), all lower walls first (method notes, 2)."""
    position = torch.tensor([[0.25, 0.875], [-5.0, 7.0], [0.5, 0.0]], dtype=torch.float64)
    state = replace(
        scene(2, count=2),
        history=position[:, None].expand(-1, 2, -1),
        reference=position,
        particle_type=torch.full((3,), 6),
        batch=torch.zeros(3, dtype=torch.long),
        batch_size=1,
    )
    node = compute(state, FeatureConfig(velocities=1)).node[:, 2:]
    expected = [[0.5, 1.0, 1.0, 0.25], [-1.0, 1.0, 1.0, -1.0], [1.0, 0.0, 1.0, 1.0]]
    assert node.tolist() == expected


def test_velocities_run_from_oldest_to_newest_with_axes_fastest():
    """Channel 2 k + axis is velocity k along axis: positions 0, 1, 3, 7 (dt = 1/4)."""
    state = scene(4)
    track = torch.tensor([[0.0, 0.0], [1.0, 10.0], [3.0, 30.0], [7.0, 70.0]], dtype=torch.float64)
    state = replace(state, history=track.expand(12, 4, 2))
    node = compute(state, FeatureConfig(velocities=3, walls=False)).node[0]
    assert node.tolist() == [4.0, 40.0, 8.0, 80.0, 16.0, 160.0]
    config = FeatureConfig(velocities=3, walls=False, velocity_form="differences")
    assert compute(state, config).node[0].tolist() == [16.0, 160.0, 32.0, 320.0, 16.0, 160.0]


def test_both_forms_hold_the_same_velocities():
    """Newest velocity minus dt times the newest changes gives the older ones back."""
    state = scene(5)
    standard = compute(state, FeatureConfig(velocities=4, walls=False)).node.view(12, 4, 2)
    config = FeatureConfig(velocities=4, walls=False, velocity_form="differences")
    other = compute(state, config).node.view(12, 4, 2)
    change = other[:, :3].flip(1).cumsum(1).flip(1) * state.frame_dt
    torch.testing.assert_close(other[:, 3:] - change, standard[:, :3])


def test_velocity_scales_divide_the_velocities_alone():
    """Features are dimensionless: ten times the scale, a tenth of the velocity channels."""
    state, config = scene(3), FeatureConfig(velocities=2)
    small, large = (
        compute_features(
            state, connect(state), config, normalization=scales(2, factor), radius=RADIUS
        )
        for factor in (1.0, 10.0)
    )
    torch.testing.assert_close(large.node[:, :4] * 10.0, small.node[:, :4])
    assert torch.equal(large.node[:, 4:], small.node[:, 4:])


def test_edges_hold_sender_minus_receiver_over_the_radius_and_its_length():
    """The vectors of an edge and its reverse are opposite, their lengths equal and <= 1."""
    state = scene(2)
    features = compute(state, FeatureConfig(velocities=1))
    edges, edge = features.edges, features.edge
    expected = (state.position[edges.sender] - state.position[edges.receiver]) / RADIUS
    torch.testing.assert_close(edge[:, :2], expected)
    torch.testing.assert_close(edge[:, 2], expected.norm(dim=1))
    assert edge[:, 2].max() <= 1.0 + 1e-15
    assert not edge[edges.sender == edges.receiver].any()


def test_a_body_at_rest_has_no_displacement():
    """Current equal to undeformed: the rest edge repeats the edge, and nothing has moved."""
    config = FeatureConfig(velocities=1, walls=False, displacement=True, rest_edges=True)
    state = scene(2)
    state = replace(state, reference=state.position)
    features = compute(state, config)
    assert not features.node[:, 2:].any()
    assert torch.equal(features.edge[:, 3:6], features.edge[:, :3])
    assert not features.edge[:, 6:].any()


def test_a_stretched_body_shows_its_stretch():
    """Stretch 1.1: displacement 0.1 X of particles, a tenth of the rest edge of edges."""
    config = FeatureConfig(velocities=1, walls=False, displacement=True, rest_edges=True)
    state = scene(2)
    state = replace(state, history=1.1 * state.reference[:, None].expand(-1, 2, -1))
    features = compute(state, config)
    expected = 0.1 * state.reference / RADIUS * DISPLACEMENT_GAIN
    torch.testing.assert_close(features.node[:, 2:], expected)
    torch.testing.assert_close(
        features.edge[:, 6:], 0.1 * features.edge[:, 3:6] * DISPLACEMENT_GAIN
    )


@pytest.mark.parametrize("frames", [2, 4])
def test_a_history_of_another_length_is_refused(frames):
    """The message says how many frames are needed."""
    with pytest.raises(ValueError, match=f"holds {frames} frames, the features need 3"):
        compute(scene(frames), FeatureConfig(velocities=2))


def test_a_model_without_velocities_is_refused():
    """It could not tell a body at rest from one in flight."""
    with pytest.raises(ValueError, match="velocities must be >= 1, got 0"):
        FeatureConfig(velocities=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_self_loops_and_coincident_particles(dtype):
    """d|x|/dx does not exist at zero; the features take it as zero."""
    config = FeatureConfig(velocities=1, displacement=True, rest_edges=True)
    state = scene(2)
    history = state.history.clone()
    history[1], history[2] = history[0], history[0] + 1e-20
    history = history.to(dtype).requires_grad_()
    state = replace(state, history=history, reference=state.reference.to(dtype))
    compute(state, config).edge.sum().backward()
    assert history.grad.isfinite().all()


def test_the_gradient_of_an_edge_length_is_the_unit_vector():
    """d|x_s - x_r| / dx_s, by finite differences, away from zero."""
    state = scene(2, count=4)
    loop = torch.tensor([0, 1])
    edges = Edges(sender=loop, receiver=loop.flip(0), offset=torch.tensor([0, 1, 2, 2, 2]))

    def edge(history: torch.Tensor) -> torch.Tensor:
        config = FeatureConfig(velocities=1, rest_edges=True)
        return compute(replace(state, history=history), config, edges).edge

    assert torch.autograd.gradcheck(edge, state.history.clone().requires_grad_())


def test_the_state_is_left_alone():
    """Public functions never change what they are given."""
    used, kept = scene(3), scene(3)
    compute(used, FeatureConfig(velocities=2, displacement=True, rest_edges=True))
    assert torch.equal(used.history, kept.history)
    assert torch.equal(used.reference, kept.reference)


def test_moments_of_a_rod_are_those_of_the_textbook():
    """A rod of length L seen from its clamped end has the second moment L^2 / 3 along itself."""
    count, length = 2001, 0.5
    reference = torch.zeros(count, 2, dtype=torch.float64)
    reference[:, 1] = torch.linspace(0.0, length, count, dtype=torch.float64)
    kind = torch.full((count,), 6)
    kind[0] = KINEMATIC
    state = SparseState(
        history=reference[:, None].repeat(1, 2, 1),
        reference=reference,
        particle_type=kind,
        batch=torch.zeros(count, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor(UNIT[2], dtype=torch.float64),
        frame_dt=0.25,
    )
    config = FeatureConfig(velocities=1, walls=False, rest_shape=True)
    edges = radius_edges(reference, state.batch, 1e-3)
    node = compute(state, config, edges).node
    place, moments = node[:, 2:4], node[:, 4:]
    gain = REST_POSITION_GAIN / RADIUS
    torch.testing.assert_close(place[-1], torch.tensor([0.0, gain * length]).double())
    expected = torch.tensor([0.0, 0.0, gain**2 * length**2 / 3.0]).double()
    # A sum over points instead of an integral is off by the order of one over their number.
    torch.testing.assert_close(moments[0], expected, rtol=1e-3, atol=1e-12)
    torch.testing.assert_close(moments, moments[:1].expand_as(moments), rtol=0.0, atol=0.0)
