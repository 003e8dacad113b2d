"""The loss against equation 10 written out, and against networks whose error is known."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from giorom.data.windows import WindowBatch
from giorom.features import FeatureConfig, Features
from giorom.normalization import Normalization
from giorom.pipeline import Dynamics, connect_within
from giorom.state import KINEMATIC, SparseState
from giorom.training.loss import push_forward, unrolled_loss
from giorom.training.noise import add_random_walk

FRAME_DT, RADIUS, BETA = 0.02, 0.6, 1e3
SCALES = Normalization(
    velocity_mean=(0.0, 0.1),
    velocity_std=(1.0, 2.0),
    acceleration_mean=(0.5, -9.0),
    acceleration_std=(3.0, 7.0),
)
GRAVITY = torch.tensor([0.0, -9.8], dtype=torch.float64)


def window(positions: Tensor, *, history: int, held: tuple[int, ...] = ()) -> WindowBatch:
    """A batch of one scene from positions of shape (t, q, d)."""
    kind = torch.full((positions.shape[1],), 8)
    kind[list(held)] = KINEMATIC
    state = SparseState(
        history=positions[:history].transpose(0, 1),
        reference=positions[0],
        particle_type=kind,
        batch=torch.zeros(positions.shape[1], dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[0.0, 1.0]] * 2, dtype=torch.float64),
        frame_dt=FRAME_DT,
    )
    return WindowBatch(state=state, target=positions[history:].transpose(0, 1), edges=None)


def dynamics(acceleration: Callable[[Features], Tensor], *, velocities: int = 2) -> Dynamics:
    """A model whose network is a known acceleration [m/s^2]."""
    return Dynamics(
        lambda features: SCALES.acceleration(acceleration(features)),
        features=FeatureConfig(velocities=velocities),
        normalization=SCALES,
        radius=RADIUS,
    )


def loss_of(model: Dynamics, state: SparseState, batch: WindowBatch) -> Tensor:
    connect = connect_within(RADIUS, configuration="current")
    return unrolled_loss(model, state, batch, connect=connect, position_weight=BETA)


def random_positions(frames: int, count: int = 6) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    start = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    moves = 0.01 * torch.randn(frames - 1, count, 2, generator=generator, dtype=torch.float64)
    return torch.cat([start[None], start + moves.cumsum(dim=0)])


def free_fall(frames: int) -> Tensor:
    """Positions of the semi-implicit Euler scheme under gravity."""
    positions = [random_positions(2)[0], random_positions(2)[1]]
    while len(positions) < frames:
        fall = FRAME_DT**2 * GRAVITY
        positions.append(2.0 * positions[-1] - positions[-2] + fall)
    return torch.stack(positions)


def test_one_frame_gives_equation_10_from_the_noisy_state():
    """Equation 10 (arXiv:2407.03925v2) by hand: both terms start from the noisy history.

    The target is the clean next position plus the noise of the newest position.
    """
    batch = window(random_positions(4), history=3)
    noisy = add_random_walk(batch.state, 1e-3, generator=torch.Generator().manual_seed(1))
    guess = torch.randn(6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found = loss_of(dynamics(lambda features: guess), noisy, batch)

    before, now = noisy.history[:, -2], noisy.history[:, -1]
    target = batch.target[:, 0] + now - batch.state.history[:, -1]
    wanted = (target - 2.0 * now + before) / FRAME_DT**2
    std = torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    reached = now + (now - before) + FRAME_DT**2 * guess
    first = (((guess - wanted) / std) ** 2).mean()
    second = ((reached - target) ** 2).mean()
    # The loss rounds the network's output to float32.
    torch.testing.assert_close(found, first + BETA * second, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("frames", [1, 4])
def test_oracle_has_no_loss_without_noise(frames):
    """The scheme's own acceleration, a spring to the centre of the box, lands on every target."""

    def spring(features: Features) -> Tensor:
        return -40.0 * (features.position - 0.5)

    positions = list(random_positions(2))
    while len(positions) < 3 + frames:
        spring_force = -40.0 * (positions[-1] - 0.5)
        positions.append(2.0 * positions[-1] - positions[-2] + FRAME_DT**2 * spring_force)
    batch = window(torch.stack(positions), history=3)
    # Squares of float32 rounding, 6e-8 relative.
    assert float(loss_of(dynamics(spring), batch.state, batch)) < 1e-10


def test_growth_weights_make_a_constant_error_cost_the_same_at_every_length():
    """A constant error d leads to d dt^2 (k+1)(k+2)/2 after k+1 steps of the scheme."""
    error = torch.tensor([0.3, -0.2], dtype=torch.float64)
    model = dynamics(lambda features: (GRAVITY + error).expand_as(features.position))
    losses = []
    for frames in (1, 2, 5):
        batch = window(free_fall(3 + frames), history=3)
        losses.append(float(loss_of(model, batch.state, batch)))
    std = torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    expected = (error / std).square().mean() + BETA * (FRAME_DT**2 * error).square().mean()
    assert losses == pytest.approx([float(expected)] * 3, rel=1e-4)


def test_noise_of_the_position_need_not_be_undone_but_that_of_the_velocity_must():
    """arXiv:2002.09405: with noise e, the wanted acceleration is a - (e_k - e_(k-1)) / dt^2."""
    batch = window(free_fall(4), history=3)
    noisy = add_random_walk(batch.state, 1e-3, generator=torch.Generator().manual_seed(1))
    offset = (noisy.history - batch.state.history).diff(dim=1)[:, -1]
    undo = dynamics(lambda features: GRAVITY - offset / FRAME_DT**2)
    keep = dynamics(lambda features: GRAVITY.expand_as(features.position))
    assert float(loss_of(undo, noisy, batch)) < 1e-10
    assert float(loss_of(keep, noisy, batch)) > 1e-4


def test_kinematic_particles_do_not_count():
    """A network that is wrong on held particles alone has no loss."""
    held = (1, 4)
    positions = free_fall(6)
    positions[:, list(held)] = positions[0, list(held)]

    def wrong_on_held(features: Features) -> Tensor:
        value = GRAVITY.repeat(len(features.position), 1)
        value[list(held)] = 1e3
        return value

    batch = window(positions, history=3, held=held)
    assert float(loss_of(dynamics(wrong_on_held), batch.state, batch)) < 1e-10


def test_gradients_are_finite_and_flow_through_every_frame():
    """Four frames: d/da of mean((a - g)^2 (1/std^2 + beta dt^4)) over two axes, at a = 0."""
    value = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    model = dynamics(lambda features: value.expand_as(features.position))
    batch = window(free_fall(7), history=3)
    loss_of(model, batch.state, batch).backward()
    std = torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    expected = -GRAVITY * (1.0 / std.square() + BETA * FRAME_DT**4)
    torch.testing.assert_close(value.grad, expected, rtol=1e-4, atol=1e-8)


def test_huber_counts_small_errors_squared_and_large_ones_linearly():
    """torch.nn.functional.huber_loss, doubled so that it is the mean square where errors are small.

    Two axes, one error below the bound and one above it; the position does not count.
    """
    error = torch.tensor([0.3, -21.0], dtype=torch.float64)  # 0.1 and 3 standard deviations
    model = dynamics(lambda features: (GRAVITY + error).expand_as(features.position))
    batch = window(free_fall(4), history=3)
    connect = connect_within(RADIUS, configuration="current")

    def loss(huber: float | None) -> float:
        options = {"connect": connect, "position_weight": 0.0, "huber": huber}
        return float(unrolled_loss(model, batch.state, batch, **options))

    scaled = error / torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    expected = 2.0 * torch.nn.functional.huber_loss(scaled, torch.zeros(2).double(), delta=0.5)
    assert loss(0.5) == pytest.approx(float(expected), rel=1e-5)
    assert loss(None) == pytest.approx(float(scaled.square().mean()), rel=1e-5)
    assert loss(1e3) == pytest.approx(loss(None), rel=1e-12)


def test_pushing_forward_is_the_scheme_and_its_last_step_has_the_loss_of_one_frame():
    """Free fall with an error c: after n steps velocity and position are off by sums of c dt.

    The last step has to undo the error of the velocity, n c dt, within one frame, and makes c
    anew: its error is c + n c, its miss that times dt^2. No growth is divided out.
    """
    error, steps = torch.tensor([0.3, -0.2], dtype=torch.float64), 3
    model = dynamics(lambda features: (GRAVITY + error).expand_as(features.position))
    batch = window(free_fall(3 + steps + 1), history=3)
    connect = connect_within(RADIUS, configuration="current")
    state, last = push_forward(model, batch.state, batch, connect=connect)

    drift = state.history - last.state.history
    expected = error * FRAME_DT**2
    for back, count in enumerate((6, 3, 1)):  # sums 1 + 2 + 3, 1 + 2, 1
        torch.testing.assert_close(
            drift[:, -1 - back], (count * expected).expand(6, 2), rtol=1e-4, atol=1e-10
        )
    assert last.target.shape[1] == 1
    torch.testing.assert_close(last.target[:, 0], batch.target[:, -1])
    found = loss_of(model, state, last)
    total = (steps + 1.0) * error
    std = torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    cost = (total / std).square().mean() + BETA * (FRAME_DT**2 * total).square().mean()
    torch.testing.assert_close(found, cost, rtol=1e-4, atol=0.0)


def test_no_gradient_flows_through_the_steps_pushed_forward():
    """Only the last frame sees the parameter, though the state before it depends on it."""
    value = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    model = dynamics(lambda features: value.expand_as(features.position))
    batch = window(free_fall(7), history=3)
    connect = connect_within(RADIUS, configuration="current")
    state, last = push_forward(model, batch.state, batch, connect=connect)
    assert not state.history.requires_grad
    loss_of(model, state, last).backward()
    std = torch.tensor(SCALES.acceleration_std, dtype=torch.float64)
    expected = -4.0 * GRAVITY * (1.0 / std.square() + BETA * FRAME_DT**4)
    torch.testing.assert_close(value.grad, expected, rtol=1e-4, atol=1e-8)
    same, one = push_forward(model, batch.state, window(free_fall(4), history=3), connect=connect)
    assert same is batch.state
    assert one.target.shape[1] == 1


def test_pushing_forward_keeps_the_noise_of_the_position():
    """With the exact law the noisy start drifts by the noise of its velocity, and no more."""
    batch = window(free_fall(6), history=3)
    noisy = add_random_walk(batch.state, 1e-3, generator=torch.Generator().manual_seed(1))
    model = dynamics(lambda features: GRAVITY.expand_as(features.position))
    connect = connect_within(RADIUS, configuration="current")
    state, last = push_forward(model, noisy, batch, connect=connect)
    noise = noisy.history - batch.state.history
    step = noise[:, -1] - noise[:, -2]
    found = state.position - last.state.position
    torch.testing.assert_close(found, noise[:, -1] + 2.0 * step, rtol=1e-4, atol=1e-9)
