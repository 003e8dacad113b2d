"""Records refuse what no stage can use, and several scenes side by side stay themselves."""

import pytest
import torch

from giorom.evaluation.rollout import single_scene
from giorom.state import KINEMATIC, SAND, SparseState, Trajectory, concatenate_states

WALLS = torch.tensor([[0.0, 1.0], [0.0, 2.0]], dtype=torch.float64)


def trajectory(**changes: object) -> Trajectory:
    """Four frames of five particles, the first of which is kinematic."""
    generator = torch.Generator().manual_seed(0)
    values = {
        "position": torch.rand(4, 5, 2, generator=generator, dtype=torch.float64),
        "particle_type": torch.tensor([KINEMATIC, SAND, SAND, SAND, SAND]),
        "frame_dt": 0.5,
        "bounds": WALLS,
    }
    return Trajectory(**(values | changes))


def scene(count: int, *, frame_dt: float = 0.5, bounds: torch.Tensor = WALLS) -> SparseState:
    """A scene of ``count`` particles with a history of three frames."""
    generator = torch.Generator().manual_seed(count)
    history = torch.rand(count, 3, 2, generator=generator, dtype=torch.float64)
    return SparseState(
        history=history,
        reference=history[:, 0] + 1.0,
        particle_type=torch.full((count,), SAND),
        batch=torch.zeros(count, dtype=torch.long),
        batch_size=1,
        bounds=bounds,
        frame_dt=frame_dt,
    )


@pytest.mark.parametrize("frame_dt", [0.0, -1.0, float("nan")])
def test_a_trajectory_without_a_frame_time_is_refused(frame_dt):
    """Velocities are divided by it."""
    with pytest.raises(ValueError, match="frame_dt must be > 0 s"):
        trajectory(frame_dt=frame_dt)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_position_that_is_not_finite_is_refused_with_its_frame(value):
    """The message names the first bad frame."""
    position = trajectory().position.clone()
    position[2, 3, 1] = position[3, 0, 0] = value
    with pytest.raises(ValueError, match="frame 2 of the trajectory"):
        trajectory(position=position)


def test_a_subset_keeps_particles_together_with_their_types():
    """Particle k of the subset is particle index[k] at every frame."""
    whole, index = trajectory(), torch.tensor([4, 0])
    part = whole.subset(index)
    assert torch.equal(part.position, torch.stack([whole.position[:, 4], whole.position[:, 0]], 1))
    assert part.kinematic.tolist() == [False, True]
    assert part.frame_count == whole.frame_count == 4


def test_velocity_is_the_backward_difference():
    """(x_k - x_{k-1}) / dt, with dt = 1/2 exact."""
    state = scene(6)
    assert torch.equal(state.position, state.history[:, 2])
    assert torch.equal(state.velocity, 2.0 * (state.history[:, 2] - state.history[:, 1]))


def test_taking_a_scene_out_is_the_inverse_of_putting_scenes_together():
    """Also of batches of batches: scenes are numbered through."""
    scenes = [scene(count) for count in (3, 1, 4)]
    batch = concatenate_states([concatenate_states(scenes[:2]), scenes[2]])
    assert batch.batch_size == 3
    assert batch.batch.tolist() == [0] * 3 + [1] + [2] * 4
    for number, expected in enumerate(scenes):
        found = single_scene(batch, number)
        assert torch.equal(found.history, expected.history)
        assert torch.equal(found.reference, expected.reference)
        assert torch.equal(found.batch, expected.batch)
        assert found.batch_size == 1


@pytest.mark.parametrize("change", [{"frame_dt": 0.25}, {"bounds": WALLS + 1.0}])
def test_scenes_with_another_frame_time_or_walls_are_refused(change):
    """One batch has one frame_dt and one domain."""
    with pytest.raises(ValueError, match="must share frame_dt and bounds"):
        concatenate_states([scene(3), scene(3, **change)])


def test_moving_to_a_device_keeps_every_value():
    """The device is all that changes."""
    state, motion = scene(3), trajectory()
    assert torch.equal(state.to("cpu").history, state.history)
    assert torch.equal(motion.to("cpu").position, motion.position)
