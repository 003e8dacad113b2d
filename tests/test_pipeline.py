"""The whole loop with oracles in place of the networks, whose answer is known."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom import pipeline
from giorom.fields.neural_basis import NeuralField, NeuralFieldConfig
from giorom.graph import Edges
from giorom.pipeline import (
    connect_within,
    full_order_rollout,
    integrated,
    rollout,
    start_from_trajectory,
    start_from_velocity,
)
from giorom.sampling import sample_farthest
from giorom.state import KINEMATIC, SAND, SparseState, Trajectory

FRAME_DT = 1.0 / 128.0
GRAVITY = (0.0, -9.81, 0.0)


def cloud(count: int, dimension: int, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def start(reference: Tensor, velocity: Tensor, *, history: int = 3) -> SparseState:
    """A free body in a wide domain."""
    return start_from_velocity(
        reference,
        velocity,
        particle_type=torch.full((len(reference),), SAND),
        bounds=torch.tensor([[-100.0, 100.0]] * reference.shape[1], dtype=torch.float64),
        frame_dt=FRAME_DT,
        history=history,
    )


def falling(state: SparseState, edges: Edges) -> Tensor:
    """The oracle time-stepper: gravity."""
    return state.position.new_tensor(GRAVITY[: state.position.shape[1]]).expand_as(state.position)


def still(state: SparseState, edges: Edges) -> Tensor:
    """No acceleration."""
    return torch.zeros_like(state.position)


def translating_field(dimension: int) -> NeuralField:
    """The oracle field: its modes are the axes."""
    config = NeuralFieldConfig(modes=dimension, width=4, depth=1, ridge=0.0)
    field = NeuralField(config, dimension=dimension).double()
    field.output.weight.data.zero_()
    field.output.bias.data.copy_(torch.eye(dimension).flatten())
    return field


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("configuration", ["current", "reference"])
def test_oracles_reproduce_free_fall_of_every_point(dimension, configuration):
    """X = X + v t + g t (t + dt) / 2 at each of 100 frames, to rounding."""
    body = cloud(200, dimension)
    velocity = torch.tensor([0.5, 1.0, -0.25], dtype=torch.float64)[:dimension]
    samples = sample_farthest(body, 20)
    motion = full_order_rollout(
        start(body[samples], velocity.expand(20, -1)),
        100,
        connect=connect_within(0.4, configuration=configuration),
        step=integrated(falling),
        decode=translating_field(dimension).bind(body[samples], body),
    )
    gravity = body.new_tensor(GRAVITY[:dimension])
    frames = 0
    for frame, position in enumerate(motion, start=1):
        time = frame * FRAME_DT
        expected = body + velocity * time + gravity * time * (time + FRAME_DT) / 2
        torch.testing.assert_close(position, expected, rtol=0, atol=1e-12)
        frames = frame
    assert frames == 100


def count_builds(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Positions of every graph that is built from now on."""
    built, build = [], pipeline.connect_points

    def counting(position, batch, **options):
        built.append(position)
        return build(position, batch, **options)

    monkeypatch.setattr(pipeline, "connect_points", counting)
    return built


def test_the_graph_of_the_reference_is_built_once_per_body(monkeypatch):
    """It never changes during a rollout; a new body has a new one, and so has the first again."""
    built = count_builds(monkeypatch)
    connect = connect_within(0.4, configuration="reference")
    bodies = [start(cloud(count, 2), torch.zeros(count, 2).double()) for count in (20, 30)]
    for body in (bodies[0], bodies[1], bodies[0]):
        list(rollout(body, 5, connect=connect, step=integrated(falling)))
    assert [len(position) for position in built] == [20, 30, 20]
    assert torch.equal(built[1], bodies[1].reference)


def test_the_current_graph_follows_the_motion(monkeypatch):
    """One graph per frame, of the positions before that frame."""
    built = count_builds(monkeypatch)
    body = start(cloud(20, 2), torch.zeros(20, 2).double())
    connect = connect_within(0.4, configuration="current")
    states = list(rollout(body, 5, connect=connect, step=integrated(falling)))
    before = [body, *states[:-1]]
    assert all(torch.equal(a, b.position) for a, b in zip(built, before, strict=True))


def test_kinematic_samples_stay_and_the_given_state_is_left_alone():
    """Prescribed particles follow the scene, not the model."""
    body = start(cloud(20, 2), torch.zeros(20, 2).double())
    kinds = body.particle_type.clone()
    kinds[:5] = KINEMATIC
    body = replace(body, particle_type=kinds)
    kept = body.history.clone()
    connect = connect_within(0.4, configuration="current")
    *_, last = rollout(body, 20, connect=connect, step=integrated(falling))
    assert torch.equal(last.position[:5], body.position[:5])
    assert (last.position[5:, 1] < body.position[5:, 1]).all()
    assert torch.equal(body.history, kept)


def test_a_divergence_is_reported_with_its_frame():
    """The third acceleration is infinite, so frame 3 is."""
    calls = []

    def explode(state: SparseState, edges: Edges) -> Tensor:
        calls.append(state)
        return torch.full_like(state.position, torch.inf if len(calls) == 3 else 0.0)

    seen = []
    body = start(cloud(4, 2), torch.zeros(4, 2).double())
    connect = connect_within(0.4, configuration="current")
    with pytest.raises(FloatingPointError, match="no longer finite at frame 3 of 10"):
        seen.extend(rollout(body, 10, connect=connect, step=integrated(explode)))
    assert len(calls) == 3


def test_a_rollout_records_no_gradients():
    """Hundreds of frames would fill the memory; the caller's setting is restored between them."""
    weight = torch.ones(1, dtype=torch.float64, requires_grad=True)
    body = start(cloud(4, 2), torch.zeros(4, 2).double())
    connect = connect_within(0.4, configuration="current")
    for state in rollout(
        body, 3, connect=connect, step=integrated(lambda s, e: weight * torch.ones_like(s.position))
    ):
        assert not state.history.requires_grad
        assert torch.is_grad_enabled()


def moving(frames: int = 8) -> Trajectory:
    """A body in uniform motion; dyadic numbers, so that no rounding is left."""
    reference = (cloud(10, 2) * 64).round() / 64
    velocity = ((cloud(10, 2, seed=1) - 0.5) * 64).round()
    time = torch.arange(frames, dtype=torch.float64)[:, None, None] * FRAME_DT
    return Trajectory(
        position=reference + velocity * time,
        particle_type=torch.arange(10) % 3 + 5,
        frame_dt=FRAME_DT,
        bounds=torch.tensor([[-9.0, 9.0]] * 2, dtype=torch.float64),
    )


def test_both_starts_agree_on_a_uniformly_moving_body():
    """The straight past of a velocity is the past of a body in uniform motion."""
    motion, samples = moving(), torch.tensor([7, 0, 3])
    given = start_from_trajectory(motion, samples, history=4, frame=5)
    made = start_from_velocity(
        given.position,
        given.velocity,
        particle_type=motion.particle_type[samples],
        bounds=motion.bounds,
        frame_dt=FRAME_DT,
        history=4,
    )
    for name in ("history", "particle_type", "batch", "bounds", "velocity"):
        assert torch.equal(getattr(made, name), getattr(given, name)), name
    assert (made.batch_size, made.frame_dt) == (given.batch_size, given.frame_dt)
    assert torch.equal(given.reference, motion.position[0, samples])
    assert torch.equal(made.reference, made.position)


def test_a_body_in_uniform_motion_goes_on_as_its_trajectory_does():
    """Start in the middle, add three frames: the end of the trajectory."""
    motion, samples = moving(8), torch.arange(10)
    state = start_from_trajectory(motion, samples, history=3, frame=4)
    connect = connect_within(0.4, configuration="current")
    found = [s.position for s in rollout(state, 3, connect=connect, step=integrated(still))]
    torch.testing.assert_close(torch.stack(found), motion.position[5:], rtol=0, atol=1e-13)


def test_by_default_a_trajectory_starts_as_early_as_it_can():
    """Frame history - 1 is the first with a full past."""
    state = start_from_trajectory(moving(), torch.arange(10), history=3)
    assert torch.equal(state.history, moving().position[:3].transpose(0, 1))


@pytest.mark.parametrize("frame", [1, 8, -1])
def test_a_start_without_enough_frames_is_refused(frame):
    """Three given frames of eight end at frame 2 to 7."""
    with pytest.raises(ValueError, match=r"must lie in \[2, 8\)"):
        start_from_trajectory(moving(), torch.arange(10), history=3, frame=frame)
