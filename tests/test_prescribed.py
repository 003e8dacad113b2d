"""Moving kinematic particles: they follow the data in every prediction and teach nothing.

The reference is the motion they were given: a shaking wall is where the data say, exactly.
"""

from dataclasses import replace

import pytest
import torch

from giorom.data.statistics import measure_statistics
from giorom.data.trajectory_file import read_trajectory
from giorom.data.windows import WindowBatch
from giorom.evaluation.evaluate import evaluate_trajectory
from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import constant_velocity, free_fall, hold_still
from giorom.experiment import _validation
from giorom.features import FeatureConfig
from giorom.normalization import Normalization
from giorom.pipeline import Dynamics, connect_within, integrated, rollout, start_from_trajectory
from giorom.state import KINEMATIC, SAND, SparseState, Trajectory
from giorom.training.loss import unrolled_loss
from giorom.training.noise import add_random_walk
from giorom.training_data import load_training_data

FRAME_DT, WALL = 0.25, [0, 2]
CONNECT = connect_within(10.0, configuration="current")


def shaken(frames: int = 9) -> Trajectory:
    """Two wall particles that shake, two free ones that a spring pulls towards the first wall.

    The free ones obey the scheme: x_(k+1) = 2 x_k - x_(k-1) + dt^2 (w_k - x_k).
    """
    time = FRAME_DT * torch.arange(frames, dtype=torch.float64)
    wall = torch.stack([torch.sin(7.0 * time), torch.cos(3.0 * time)], dim=1)
    positions = [torch.tensor([[1.0, 2.0], [3.0, 1.0]], dtype=torch.float64)] * 2
    while len(positions) < frames:
        pull = wall[len(positions) - 1] - positions[-1]
        positions.append(2.0 * positions[-1] - positions[-2] + FRAME_DT**2 * pull)
    free = torch.stack(positions)
    position = torch.stack([wall, free[:, 0], wall + 1.0, free[:, 1]], dim=1)
    return Trajectory(
        position=position,
        particle_type=torch.tensor([KINEMATIC, SAND, KINEMATIC, SAND]),
        frame_dt=FRAME_DT,
        bounds=torch.tensor([[-50.0, 50.0]] * 2, dtype=torch.float64),
    )


def spring(state: SparseState, _: object) -> torch.Tensor:
    """The acceleration of the free particles; nonsense for the walls, which must not matter."""
    pull = state.position[0] - state.position
    return torch.where(state.kinematic[:, None], torch.full_like(pull, 1e3), pull)


def start(motion: Trajectory) -> SparseState:
    """The first two frames of all particles."""
    return start_from_trajectory(motion, torch.arange(4), history=2)


def test_a_rollout_follows_shaking_walls_and_the_body_follows_them():
    """The oracle reproduces the data only if the walls move as prescribed."""
    motion = shaken()
    truth = motion.position[2:]
    options = {"connect": CONNECT, "step": integrated(spring)}
    found = [s.position for s in rollout(start(motion), 7, **options, prescribed=truth)]
    torch.testing.assert_close(torch.stack(found), truth, rtol=0, atol=1e-12)
    kept = roll_out(start(motion), 7, **options, prescribed=truth)
    torch.testing.assert_close(kept.position, truth, rtol=0, atol=1e-12)
    held = roll_out(start(motion), 7, **options)
    assert torch.equal(held.position[:, WALL], motion.position[1, WALL].expand(7, -1, -1))
    assert float((held.position - truth)[:, 1].abs().max()) > 0.1


def test_a_rollout_longer_than_the_prescribed_motion_is_refused():
    motion = shaken()
    with pytest.raises(ValueError, match="known for 7 frames, but 8 are to be simulated"):
        next(
            rollout(
                start(motion),
                8,
                connect=CONNECT,
                step=integrated(spring),
                prescribed=motion.position[2:],
            )
        )


def test_trivial_predictions_know_the_walls_too():
    motion = shaken()
    truth, state = motion.position[2:], start(motion)
    gravity = torch.tensor([0.0, -9.8], dtype=torch.float64)
    for found in (
        hold_still(state, 7, prescribed=truth),
        constant_velocity(state, 7, prescribed=truth),
        free_fall(state, 7, gravity=gravity, prescribed=truth),
    ):
        assert torch.equal(found[:, WALL], truth[:, WALL])
    assert torch.equal(
        hold_still(state, 7, prescribed=truth)[:, [1, 3]],
        motion.position[1, [1, 3]].expand(7, -1, -1),
    )


def test_unrolled_training_moves_the_walls_between_its_frames():
    """The oracle has no loss over five frames; with the walls held it would have."""
    motion = shaken()
    state = start(motion)
    scales = Normalization(
        velocity_mean=(0.0, 0.0),
        velocity_std=(1.0, 1.0),
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(1.0, 1.0),
    )
    kinds = motion.particle_type == KINEMATIC

    def network(features):
        pull = features.position[0] - features.position
        return torch.where(kinds[:, None], torch.full_like(pull, 1e3), pull)

    dynamics = Dynamics(
        network, features=FeatureConfig(velocities=1), normalization=scales, radius=10.0
    )

    def loss(target):
        batch = WindowBatch(state=state, target=target.transpose(0, 1), edges=None)
        return float(unrolled_loss(dynamics, state, batch, connect=CONNECT, position_weight=1.0))

    target = motion.position[2:7]
    assert loss(target) < 1e-12
    standing = target.clone()
    standing[:, WALL] = motion.position[1, WALL]
    assert loss(standing) > 1e-3


def test_noise_leaves_moving_walls_where_they_are():
    state = start(shaken())
    noisy = add_random_walk(state, 0.1, generator=torch.Generator().manual_seed(0))
    assert torch.equal(noisy.history[WALL], state.history[WALL])
    assert not torch.equal(noisy.history[1], state.history[1])


def test_moving_walls_are_not_in_the_statistics():
    motion = shaken()
    free = motion.subset(torch.tensor([1, 3]))
    assert measure_statistics([motion]).to_metadata() == measure_statistics([free]).to_metadata()


@pytest.fixture
def carried(data_folder):
    """A trajectory of the tiny data set whose particles are all carried by a shaking table."""
    trajectory = read_trajectory(data_folder, "test", 0)
    shake = 0.02 * torch.sin(torch.arange(trajectory.frame_count))[:, None, None]
    return replace(
        trajectory,
        position=trajectory.position[:1] + shake,
        particle_type=torch.full_like(trajectory.particle_type, KINEMATIC),
    )


def test_a_body_that_is_carried_is_predicted_without_error(simulator, carried):
    """Evaluation knows the prescribed motion: on the samples, on all points, in every column."""
    result = evaluate_trajectory(simulator, carried)
    for where in ("sparse", "full"):
        scores = {k: v for k, v in result[where].items() if k.endswith("_mse")}
        assert set(scores.values()) == {0.0}, scores
        assert result[where]["amplitude_ratio"] == pytest.approx(1.0)


def test_a_simulator_carries_its_kinematic_particles_along(simulator, carried):
    """Half of the body is carried and is where it was told to be; the other half is predicted."""
    half = carried.particle_type.clone()
    half[::2] = 8
    velocity = torch.zeros_like(carried.position[0])
    motion = simulator.rollout(
        carried.position[0], velocity, half, frames=5, prescribed=carried.position[1:6]
    )
    assert torch.equal(motion.position[:, 1::2], carried.position[:6, 1::2])
    assert not torch.equal(motion.position[1:, ::2], carried.position[1:6, ::2])


def test_validation_during_training_follows_the_walls(tiny, data_folder, simulator, carried):
    """A body that is carried has no validation error, whatever the model says."""
    data = load_training_data(tiny, data_folder)
    index = simulator.sample(carried.position[0])
    sampled = replace(
        data.validation[0], motion=carried.subset(index), reference=carried.position[0, index]
    )
    validate = _validation(
        tiny, replace(data, validation=[sampled]), connect=simulator.connect, device="cpu"
    )
    assert validate(simulator.dynamics) == {"rollout_mse": 0.0, "static_mse": 0.0}
