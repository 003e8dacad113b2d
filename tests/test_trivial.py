"""Predictions without a model against closed forms and against the integrator."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom.evaluation.trivial import constant_velocity, free_fall, hold_still
from giorom.graph import Edges
from giorom.pipeline import connect_within, rollout
from giorom.state import KINEMATIC, SAND, SparseState

GRAVITY = torch.tensor([0.0, -9.81], dtype=torch.float64)


def state(bounds: float = 100.0) -> SparseState:
    """Eight samples in motion, the first kinematic and moving."""
    generator = torch.Generator().manual_seed(0)
    history = torch.rand(8, 3, 2, generator=generator, dtype=torch.float64)
    return SparseState(
        history=history,
        reference=history[:, 0],
        particle_type=torch.tensor([KINEMATIC] + [SAND] * 7),
        batch=torch.zeros(8, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[-bounds, bounds]] * 2, dtype=torch.float64),
        frame_dt=0.02,
    )


def integrated(given: SparseState, acceleration: Tensor, frames: int) -> Tensor:
    """The same motion by the pipeline, step by step."""

    def constant(later: SparseState, edges: Edges) -> Tensor:
        return acceleration.expand_as(later.position)

    connect = connect_within(1e-6, configuration="current")
    steps = rollout(given, frames, connect=connect, acceleration=constant)
    return torch.stack([later.position for later in steps])


def test_holding_still_repeats_the_last_frame():
    """x_k = x_0."""
    given = state()
    assert torch.equal(hold_still(given, 5), given.position.repeat(5, 1, 1))


def test_constant_velocity_is_straight_and_even():
    """x_k = x_0 + k (x_0 - x_-1); kinematic particles stay."""
    given = state()
    found = constant_velocity(given, 30)
    step = given.history[:, 2] - given.history[:, 1]
    step[0] = 0.0
    expected = given.position + torch.arange(1.0, 31.0)[:, None, None] * step
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(
        found, integrated(given, torch.zeros(2).double(), 30), rtol=0, atol=1e-11
    )


def test_free_fall_is_what_the_integrator_does_under_gravity():
    """x_k = x_0 + v t + g t (t + dt) / 2."""
    given = state()
    found = free_fall(given, 30, gravity=GRAVITY)
    torch.testing.assert_close(found, integrated(given, GRAVITY, 30), rtol=0, atol=1e-11)


def test_motion_stops_at_the_walls():
    """A fast free particle ends on the wall it flies to; kinematic ones may lie outside."""
    given = state(bounds=2.0)
    outside = given.history.clone()
    outside[0] = 5.0
    given = replace(given, history=outside)
    found = constant_velocity(given, 200)
    assert torch.equal(found[:, 0], given.position[:1].expand(200, -1))
    direction = (given.history[1:, 2] - given.history[1:, 1]).sign()
    assert torch.equal(found[-1, 1:], 2.0 * direction)
    assert float(free_fall(given, 1000, gravity=GRAVITY)[-1, 1:, 1].max()) == -2.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_predictions_have_the_precision_of_the_state(dtype):
    """And one frame per step asked for."""
    given = state()
    given = replace(given, history=given.history.to(dtype), bounds=given.bounds.to(dtype))
    for found in (
        hold_still(given, 4),
        constant_velocity(given, 4),
        free_fall(given, 4, gravity=GRAVITY.to(dtype)),
    ):
        assert found.shape == (4, 8, 2)
        assert found.dtype == dtype


def test_predictions_stay_on_the_device_of_the_state():
    """Nothing is made elsewhere; the meta device refuses to mix with the CPU."""
    given = state().to("meta")
    assert constant_velocity(given, 4).device.type == "meta"
