"""The grid time-stepper against free fall, conservation laws, walls and its own inverse problem."""

import math
from dataclasses import replace

import pytest
import torch

from giorom.data.windows import WindowBatch
from giorom.grid_stepper import GridStepper, GridStepperConfig
from giorom.layers.learned_law import START
from giorom.pipeline import rollout, start_from_velocity, unconnected
from giorom.state import ELASTIC, GOOP, KINEMATIC, PLASTICINE, SAND, WATER, concatenate_states
from giorom.training.loss import motion_loss

FRAME_DT = 2.5e-3
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def stepper(dimension, *, gravity=-9.8, **options):
    options = {"spacing": 0.05, "substeps": 4} | options
    result = GridStepper(GridStepperConfig(**options), dimension=dimension)
    result.gravity[1] = gravity
    return result.requires_grad_(False)


def block(dimension, *, corner=0.4, side=6, kind=WATER, velocity=0.0):
    """A cube of samples 0.025 m apart, with a turn and a push."""
    axes = [corner + 0.025 * torch.arange(side)] * dimension
    position = torch.cartesian_prod(*axes)
    middle = position - position.mean(dim=0)
    motion = torch.zeros_like(position)
    motion[:, 0], motion[:, 1] = -velocity * middle[:, 1] / 0.1, velocity * middle[:, 0] / 0.1
    motion[:, 0] += velocity
    return start_from_velocity(
        position,
        motion,
        particle_type=torch.full((len(position),), kind),
        bounds=torch.tensor([[0.1, 0.9]] * dimension),
        frame_dt=FRAME_DT,
        history=2,
        weight=torch.ones(len(position)),
    ), motion


def moved(model, state, frames, **options):
    return list(rollout(state, frames, connect=unconnected, step=model.step, **options))


@DIMENSIONS
@pytest.mark.parametrize("substeps", [1, 7])
def test_free_fall_is_a_parabola(dimension, substeps):
    """X = x0 + v t + g t^2 / 2 to rounding, whatever the substep."""
    model = stepper(dimension, substeps=substeps)
    state, _ = block(dimension)
    velocity = torch.zeros_like(state.position)
    velocity[:, 0], velocity[:, 1] = 0.3, 0.5
    last = moved(model, model.start(state, velocity), 40)[-1]
    time = 40 * FRAME_DT
    wanted = state.position + velocity * time
    wanted[:, 1] -= 0.5 * 9.8 * time**2
    torch.testing.assert_close(last.position, wanted, atol=2e-5, rtol=0.0)


@DIMENSIONS
@pytest.mark.parametrize("kind", [PLASTICINE, WATER, SAND, ELASTIC])
def test_momentum_is_kept(dimension, kind):
    """A turning block in free space: the centroid moves straight on, whatever it is made of."""
    model = stepper(dimension, gravity=0.0)
    state, motion = block(dimension, kind=kind, velocity=1.0)
    last = moved(model, model.start(state, motion), 40)[-1]
    wanted = state.position.mean(dim=0) + motion.mean(dim=0) * 40 * FRAME_DT
    torch.testing.assert_close(last.position.mean(dim=0), wanted, atol=2e-5, rtol=0.0)


@DIMENSIONS
def test_a_turning_solid_keeps_its_shape_and_its_turn(dimension):
    """Elastic block at 2 rad/s: distances from the middle stay, the angle is that of the turn.

    With affine transfers alone, which conserve angular momentum.
    """
    model = stepper(dimension, gravity=0.0)
    model.blend_logit.fill_(-30.0)
    state, motion = block(dimension, kind=ELASTIC, velocity=0.2)
    last = moved(model, model.start(state, motion), 100)[-1]
    before = state.position - state.position.mean(dim=0)
    after = last.position - last.position.mean(dim=0)
    torch.testing.assert_close(after.norm(dim=1), before.norm(dim=1), atol=2e-3, rtol=0.0)
    cross = (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).sum()
    angle = math.atan2(float(cross), float((before[:, :2] * after[:, :2]).sum()))
    assert angle == pytest.approx(2.0 * 100 * FRAME_DT, rel=0.02)


@DIMENSIONS
@pytest.mark.parametrize("contact", ["slip", "stick"])
def test_no_sample_leaves_the_walls(dimension, contact):
    """Thrown into a corner at 5 m/s: never further out than a quarter of a cell."""
    model = stepper(dimension, wall_contact=contact)
    state, motion = block(dimension, corner=0.15, velocity=1.0)
    for later in moved(model, model.start(state, motion - 5.0), 60):
        assert float(later.position.min()) >= 0.1 - 0.25 * 0.05 - 1e-6
        assert float(later.position.max()) <= 0.9 + 0.25 * 0.05 + 1e-6


def test_what_sticks_does_not_slide():
    """On a slip wall a sand block keeps sliding, on a stick wall it stops within a few frames."""
    slid = {}
    for contact in ("slip", "stick"):
        model = stepper(2, wall_contact=contact)
        state, motion = block(2, corner=0.1, kind=SAND)
        start = model.start(state, motion + torch.tensor([1.0, 0.0]))
        slid[contact] = float(moved(model, start, 80)[-1].position[:, 0].mean()) - 0.1625
    assert slid["stick"] < 0.5 * slid["slip"]
    assert slid["slip"] == pytest.approx(80 * FRAME_DT, rel=0.05)


def test_water_at_rest_in_a_basin_stays_level():
    """A basin filled from wall to wall only sinks by its compression, h^2 rho g / (2 K) at most."""
    model = stepper(2, spacing=0.05)
    axes = torch.arange(32) * 0.025 + 0.1125
    position = torch.cartesian_prod(axes, axes[:12])
    state = start_from_velocity(
        position,
        torch.zeros_like(position),
        particle_type=torch.full((len(position),), WATER),
        bounds=torch.tensor([[0.1, 0.9]] * 2),
        frame_dt=FRAME_DT,
        history=2,
    )
    last = moved(model, model.start(state, torch.zeros_like(position)), 80)[-1]
    sunk = (position - last.position)[:, 1]
    assert float((position - last.position)[:, 0].abs().max()) < 5e-3
    assert 0.0 <= float(sunk.mean()) < 2.0 * 0.3**2 * 9.8 / (2.0 * START["bulk"])


@DIMENSIONS
def test_scenes_of_a_batch_do_not_meet(dimension):
    """Two scenes in one batch move as each does alone, although they overlap in space."""
    model = stepper(dimension)
    first, second = (
        model.start(*block(dimension, corner=0.15, kind=kind, velocity=v))
        for kind, v in ((SAND, 1.0), (WATER, -1.0))
    )
    together = moved(model, concatenate_states([first, second]), 30)[-1].position
    alone = [moved(model, each, 30)[-1].position for each in (first, second)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-5, rtol=0.0)


def test_samples_weigh_what_they_stand_for():
    """A light body thrown at one of three times its weight comes back, the heavy one does not."""
    model = stepper(2, gravity=0.0)
    left, _ = block(2, corner=0.3, kind=ELASTIC)
    shift = torch.tensor([0.2, 0.0])
    right = replace(left, history=left.history + shift, reference=left.reference + shift)
    weight = torch.cat([left.weight, 3.0 * right.weight])
    both = replace(
        concatenate_states([left, right]),
        batch=torch.zeros(72, dtype=torch.long),
        batch_size=1,
        weight=weight,
    )
    velocity = torch.zeros_like(both.position)
    velocity[:36, 0] = 1.0
    last = moved(model, model.start(both, velocity), 100)
    speed = last[-1].velocity[:, 0]
    assert float((weight * speed).sum()) == pytest.approx(36.0, rel=1e-3)
    assert float(speed[:36].mean()) < 0.0 < float(speed[36:].mean())


def test_prescribed_samples_go_where_they_are_told_and_push():
    """A kinematic plate is driven into a block, which moves on; the plate is exactly on its way."""
    model = stepper(2, gravity=0.0)
    state, velocity = block(2, kind=ELASTIC)
    kind = state.particle_type.clone()
    kind[:6] = KINEMATIC
    state = model.start(replace(state, particle_type=kind), velocity)
    shift = 1e-3 * torch.arange(1, 31)[:, None, None] * torch.tensor([1.0, 0.0])
    told = state.position + shift
    last = moved(model, state, 30, prescribed=told)[-1]
    assert torch.equal(last.position[:6], told[-1, :6])
    assert float((last.position - state.position)[6:, 0].min()) > 0.02


def test_a_state_that_was_moved_takes_the_velocity_of_it():
    """Shown the true motion of a thrown block, it goes on as thrown: memory follows positions."""
    model = stepper(2, gravity=0.0)
    state, velocity = block(2)
    state = model.start(state, velocity)
    thrown = torch.tensor([0.5, 0.25]) * FRAME_DT
    for frame in range(5):
        state = model.step(state, unconnected(state))
        history = state.history.clone()
        history[:, -1] = state.reference + (frame + 1) * thrown
        state = replace(state, history=history)
    later = model.step(state, unconnected(state))
    torch.testing.assert_close(later.position, state.position + thrown, atol=1e-5, rtol=0.0)


def test_training_finds_the_stiffness_that_made_the_motion():
    """Gradient descent on the motion alone brings the bulk modulus from a quarter to the truth."""
    truth, model = stepper(2, substeps=3), stepper(2, substeps=3)
    truth.law.log_bulk += math.log(4.0)
    state, velocity = block(2, corner=0.1, side=4)
    velocity[:, 1] -= 1.0
    target = torch.stack([s.position for s in moved(truth, truth.start(state, velocity), 10)])
    batch = WindowBatch(
        state=model.start(state, velocity), target=target.transpose(0, 1), edges=None
    )
    stiffness = model.law.log_bulk.requires_grad_(True)
    optimizer = torch.optim.Adam([stiffness], lr=0.3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.9)
    for _ in range(25):
        loss = motion_loss(model.step, batch, connect=unconnected)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    miss = (stiffness.detach() - truth.law.log_bulk)[WATER]
    assert float(miss.exp()) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"spacing": 0.0}, "spacing must be > 0 m"),
        ({"spacing": math.inf}, "spacing must be > 0 m and finite"),
        ({"spacing": 0.1, "substeps": 0}, "substeps must lie between 1 and"),
        ({"spacing": 0.1, "substeps": 10**9}, "substeps must lie between 1 and"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        GridStepperConfig(**values)


@DIMENSIONS
@pytest.mark.parametrize("contact", ["slip", "stick"])
@pytest.mark.parametrize("kind", [PLASTICINE, WATER, SAND, GOOP, ELASTIC])
def test_the_kernels_do_what_the_tensors_do(dimension, contact, kind):
    """Ten frames of a turning block in a corner, some of it held, with and without gradients."""
    model = stepper(dimension, wall_contact=contact)
    state, velocity = block(dimension, corner=0.12, side=4, kind=kind, velocity=1.0)
    held = state.particle_type.clone()
    held[::9] = KINEMATIC
    state = model.start(replace(state, particle_type=held), velocity)
    told = state.position + 1e-3
    slow, fast = state, state
    for _ in range(10):
        with torch.enable_grad():
            slow = model.step(slow, unconnected(slow), told)
        with torch.no_grad():
            fast = model.step(fast, unconnected(fast), told)
    torch.testing.assert_close(fast.position, slow.position, atol=2e-6, rtol=0.0)
    torch.testing.assert_close(fast.memory, slow.memory, atol=2e-3, rtol=1e-3)


@DIMENSIONS
@pytest.mark.parametrize("lost", [math.nan, math.inf, -math.inf, 1e30])
def test_a_lost_sample_does_no_harm(dimension, lost):
    """The kernels survive places and strains that are no numbers; the grid is not left."""
    model = stepper(dimension)
    state, velocity = block(dimension, side=3)
    state = model.start(state, velocity)
    history, memory = state.history.clone(), state.memory.clone()
    history[0, -1], memory[1, -1], memory[2, dimension] = lost, lost, lost
    later = model.step(replace(state, history=history, memory=memory), unconnected(state))
    assert later.position.shape == state.position.shape
