"""Predictions without a model against closed forms and against the integrator."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom.evaluation.comparison import surroundings_of, trivial_predictions
from giorom.evaluation.trivial import (
    constant_velocity,
    free_fall,
    frozen_shape,
    hold_still,
)
from giorom.graph import Edges
from giorom.pipeline import connect_within, integrated, rollout
from giorom.state import KINEMATIC, SAND, SparseState, Trajectory

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


def moved_by(given: SparseState, acceleration: Tensor, frames: int) -> Tensor:
    """The same motion by the pipeline, step by step."""

    def constant(later: SparseState, edges: Edges) -> Tensor:
        return acceleration.expand_as(later.position)

    connect = connect_within(1e-6, configuration="current")
    steps = rollout(given, frames, connect=connect, step=integrated(constant))
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
        found, moved_by(given, torch.zeros(2).double(), 30), rtol=0, atol=1e-11
    )


def test_free_fall_is_what_the_integrator_does_under_gravity():
    """x_k = x_0 + v t + g t (t + dt) / 2."""
    given = state()
    found = free_fall(given, 30, gravity=GRAVITY)
    torch.testing.assert_close(found, moved_by(given, GRAVITY, 30), rtol=0, atol=1e-11)


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


def moved(given: SparseState, way: Tensor) -> Tensor:
    """The last frame, carried along ``way`` frame by frame."""
    return given.position + way[:, None]


def test_the_frozen_shape_is_exact_for_a_body_that_keeps_its_shape():
    """Pure translation: the centroid is all there is to know; kinematic particles follow too."""
    given = state()
    way = torch.rand(5, 2, dtype=torch.float64)
    truth = moved(given, way)
    torch.testing.assert_close(frozen_shape(given, truth), truth, rtol=0, atol=1e-14)


def test_the_frozen_shape_keeps_the_centroid_and_misses_what_is_about_it():
    """Error = mean square of the deformation, whose mean over free particles is zero."""
    given = state()
    noise = torch.rand(5, 8, 2, dtype=torch.float64)
    noise[:, 0] = 0.0
    noise[:, 1:] -= noise[:, 1:].mean(dim=1, keepdim=True)
    truth = moved(given, torch.rand(5, 2, dtype=torch.float64)) + noise
    found = frozen_shape(given, truth)
    torch.testing.assert_close(truth - found, noise, rtol=0, atol=1e-14)


def test_bodies_that_part_each_follow_their_own_centroid():
    """Two bodies going apart: exact body by body, and not as one."""
    given = state()
    body = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1])
    way = torch.where(body[:, None] == 0, 1.0, -1.0) * torch.tensor([1.0, 0.0]).double()
    truth = given.position + way * torch.arange(1.0, 4.0).double()[:, None, None]
    exact = frozen_shape(given, truth, body=body)
    torch.testing.assert_close(exact, truth, rtol=0, atol=1e-14)
    assert float((frozen_shape(given, truth) - truth).abs().max()) > 0.5


def test_bodies_are_told_by_the_numbers_of_their_points():
    """Stored body after body; counts that do not add up make one body of all."""
    shared = {"particle_type": torch.full((5,), SAND), "frame_dt": 0.1}
    bounds = torch.tensor([[0.0, 1.0]] * 2)
    for counts, expected in (([2, 3], [0, 0, 1, 1, 1]), ([2, 2], [0] * 5), ([], [0] * 5)):
        attributes = {"gravity": 2.5, "bodies": [{"points": count} for count in counts]}
        trajectory = Trajectory(
            position=torch.zeros(3, 5, 2), bounds=bounds, attributes=attributes, **shared
        )
        found = surroundings_of(trajectory)
        assert found.body.tolist() == expected
        assert found.gravity.tolist() == [0.0, -2.5]


def test_names_that_say_clamped_hold_what_stops_at_the_walls():
    """The older names always did: same positions, inside the walls."""
    given = state(bounds=1.0)
    truth = given.position.expand(40, -1, -1)
    found = trivial_predictions(given, truth, gravity=GRAVITY)
    assert torch.equal(found["constant_velocity"], found["clamped_constant_velocity"])
    assert torch.equal(found["free_fall"], found["ballistic_clamped"])
    assert float(found["ballistic_clamped"].abs().max()) <= 1.0
