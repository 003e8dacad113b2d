"""The integrator against its inverse and against free fall."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom.integrate import advance, finite_differences, semi_implicit_euler
from giorom.state import KINEMATIC, SAND, SparseState


def dyadic(*shape: int, seed: int = 0) -> Tensor:
    """Random multiples of 2^-10: sums and powers of two of them are exact."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(-1024, 1025, shape, generator=generator).double() / 1024


def state() -> SparseState:
    """Four samples, two of them kinematic, with a history of three frames."""
    return SparseState(
        history=dyadic(4, 3, 2),
        reference=dyadic(4, 2, seed=1),
        particle_type=torch.tensor([KINEMATIC, SAND, KINEMATIC, SAND]),
        batch=torch.zeros(4, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[0.0, 1.0]] * 2, dtype=torch.float64),
        frame_dt=0.25,
    )


@pytest.mark.parametrize("frame_dt", [0.25, 1.0, 2.0])
def test_finite_differences_undo_a_step_exactly(frame_dt):
    """Inverse in both directions; with dyadic numbers not even rounding is left."""
    now, before, after = (dyadic(50, 3, seed=seed) for seed in range(3))
    acceleration = finite_differences(after, now, before, frame_dt=frame_dt)
    assert torch.equal(semi_implicit_euler(now, before, acceleration, frame_dt=frame_dt), after)
    moved = semi_implicit_euler(now, before, after, frame_dt=frame_dt)
    assert torch.equal(finite_differences(moved, now, before, frame_dt=frame_dt), after)


def test_free_fall_is_off_by_exactly_half_a_step():
    """x(t) = g t^2 / 2; starting from rest the scheme gives g t (t + dt) / 2."""
    gravity, frame_dt, frames = -9.81, 1e-2, 100
    before = now = torch.zeros(1, 1, dtype=torch.float64)
    for _ in range(frames):
        acceleration = torch.full_like(now, gravity)
        after = semi_implicit_euler(now, before, acceleration, frame_dt=frame_dt)
        before, now = now, after
    t = frames * frame_dt
    expected = torch.full_like(now, gravity * t * (t + frame_dt) / 2)
    torch.testing.assert_close(now, expected, rtol=1e-12, atol=0.0)


def test_without_force_motion_is_straight_and_even():
    """Newton's first law: x_k = x_0 + k (x_0 - x_-1)."""
    before, now = dyadic(5, 2), dyadic(5, 2, seed=1)
    expected = now + 7 * (now - before)
    for _ in range(7):
        after = semi_implicit_euler(now, before, torch.zeros_like(now), frame_dt=0.5)
        before, now = now, after
    assert torch.equal(now, expected)


def test_an_oscillator_keeps_its_energy_bounded():
    """Symplectic Euler of x'' = -x conserves v^2 + x^2 - dt x v exactly."""
    frame_dt = 0.1
    before = torch.ones(1, 1, dtype=torch.float64)
    now, invariant = before.clone(), []
    for _ in range(1000):
        after = semi_implicit_euler(now, before, -now, frame_dt=frame_dt)
        before, now = now, after
        velocity = (now - before) / frame_dt
        invariant.append(float(velocity**2 + now**2 - frame_dt * now * velocity))
    assert max(invariant) - min(invariant) < 1e-11


def test_kinematic_rows_stay_and_free_rows_follow_the_scheme():
    """Whatever acceleration is predicted for them."""
    old, acceleration = state(), dyadic(4, 2, seed=2)
    new = advance(old, acceleration)
    expected = semi_implicit_euler(
        old.position, old.history[:, 1], acceleration, frame_dt=old.frame_dt
    )
    assert torch.equal(new.position[[0, 2]], old.position[[0, 2]])
    assert torch.equal(new.position[[1, 3]], expected[[1, 3]])
    assert torch.equal(new.history[:, :-1], old.history[:, 1:])


def test_prescribed_positions_move_kinematic_rows_alone():
    """The scene moves them; free rows do not see the prescription."""
    old, prescribed = state(), dyadic(4, 2, seed=3)
    acceleration = torch.zeros(4, 2, dtype=torch.float64)
    new = advance(old, acceleration, prescribed=prescribed)
    assert torch.equal(new.position[[0, 2]], prescribed[[0, 2]])
    assert torch.equal(new.position[[1, 3]], advance(old, acceleration).position[[1, 3]])


def test_advancing_leaves_the_state_and_its_history_alone():
    """Public functions never change what they are given."""
    old, kept = state(), state()
    advance(old, torch.ones(4, 2, dtype=torch.float64))
    assert torch.equal(old.history, kept.history)


@pytest.mark.parametrize("frame_dt", [0.0, -0.1, float("nan")])
def test_a_frame_time_that_is_not_positive_is_refused(frame_dt):
    """Both directions divide by it."""
    x = torch.zeros(1, 2)
    with pytest.raises(ValueError, match="must be > 0"):
        semi_implicit_euler(x, x, x, frame_dt=frame_dt)
    with pytest.raises(ValueError, match="must be > 0"):
        finite_differences(x, x, x, frame_dt=frame_dt)
    with pytest.raises(ValueError, match="must be > 0"):
        advance(replace(state(), frame_dt=frame_dt), torch.zeros(4, 2, dtype=torch.float64))
