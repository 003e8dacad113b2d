"""Long rollouts: scenes with a known fate, alone and side by side."""

import math

import pytest
import torch

from giorom.evaluation.endurance import beyond_walls, endure
from giorom.evaluation.rollout import select_scenes, single_scene
from giorom.pipeline import connect_within, integrated
from giorom.state import KINEMATIC, SAND, SparseState, concatenate_states

DT = 0.125


def moving(speed: float) -> SparseState:
    """Three samples at the middle of the unit box, of which two move to the right."""
    position = torch.tensor([[0.5, 0.25], [0.5, 0.5], [0.5, 0.75]])
    step = torch.tensor([[speed * DT, 0.0]])
    return SparseState(
        history=torch.stack([position - step, position], dim=1),
        reference=position.clone(),
        particle_type=torch.tensor([SAND, SAND, KINEMATIC]),
        batch=torch.zeros(3, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[0.0, 1.0]] * 2),
        frame_dt=DT,
        weight=torch.full((3,), speed),
        memory=torch.full((3, 2), speed),
    )


def coasting(*, fails_at: float = math.inf):
    """No force; not finite in scenes that have come beyond ``fails_at``."""

    def acceleration(state, edges):
        broken = state.position[:, :1] > fails_at
        return torch.where(broken, math.nan, torch.zeros_like(state.position))

    return {
        "connect": connect_within(1e-6, configuration="current"),
        "step": integrated(acceleration),
    }


def test_scenes_are_lost_when_they_pass_the_tolerance():
    """The place 1/2 + v t passes 1 + 1/8 after 5 / (8 v): frame 5 / (8 v dt), rounded up."""
    state = concatenate_states([moving(0.0), moving(1.0), moving(0.5), moving(-1.0)])
    fates = endure(state, 8, **coasting(), tolerance=0.125)
    assert [fate.lost_at for fate in fates] == [None, 6, None, 6]
    assert [fate.scene for fate in fates] == [0, 1, 2, 3]
    assert [fate.reason for fate in fates] == [None, "beyond a wall", None, "beyond a wall"]
    assert [fate.excursion for fate in fates] == [0.0, 0.25, 0.0, 0.25]


def test_a_scene_that_is_not_finite_leaves_the_others_going():
    """NaN from x > 3/4 on; the slower one is still inside at the end, the third comes there."""
    state = concatenate_states([moving(1.0), moving(0.25), moving(0.5)])
    fates = endure(state, 8, **coasting(fails_at=0.75), tolerance=0.125)
    assert [fate.lost_at for fate in fates] == [4, None, 6]
    assert [fate.reason for fate in fates] == ["not finite", None, "not finite"]


def test_fates_do_not_depend_on_the_neighbours_in_the_batch():
    """Together equals one by one."""
    speeds = [1.0, 0.0, -2.0, 0.6]
    together = endure(
        concatenate_states([moving(v) for v in speeds]), 12, **coasting(), tolerance=0.0
    )
    for speed, fate in zip(speeds, together, strict=True):
        (alone,) = endure(moving(speed), 12, **coasting(), tolerance=0.0)
        assert (alone.lost_at, alone.reason) == (fate.lost_at, fate.reason)
        assert alone.excursion == pytest.approx(fate.excursion)


def test_the_distance_beyond_the_walls_is_that_of_the_farthest_sample():
    """0.25 below one wall and 0.5 above another: 0.5; inside: nothing."""
    state = concatenate_states([moving(0.0), moving(0.0)])
    state.history[0, -1] = torch.tensor([-0.25, 0.5])
    state.history[1, -1] = torch.tensor([0.5, 1.5])
    assert beyond_walls(state).tolist() == [0.5, 0.0]


def test_chosen_scenes_are_those_that_were_put_together():
    """Selection undoes concatenation, memory and weights included."""
    scenes = [moving(v) for v in (1.0, 2.0, 3.0)]
    batch = concatenate_states(scenes)
    for found, expected in (
        (single_scene(batch, 1), scenes[1]),
        (select_scenes(batch, [0, 2]), concatenate_states([scenes[0], scenes[2]])),
    ):
        assert found.batch_size == expected.batch_size
        for name in ("history", "reference", "particle_type", "batch", "weight", "memory"):
            assert torch.equal(getattr(found, name), getattr(expected, name))
