"""Statistics of motion against closed forms."""

import pytest
import torch

from giorom.data.statistics import Statistics, measure_statistics
from giorom.state import KINEMATIC, SAND, Trajectory


def make_trajectory(position: torch.Tensor, kinematic: int = 0) -> Trajectory:
    particle_type = torch.full((position.shape[1],), SAND)
    particle_type[:kinematic] = KINEMATIC
    return Trajectory(
        position=position,
        particle_type=particle_type,
        frame_dt=0.01,
        bounds=torch.tensor([[0.0, 1.0]] * position.shape[2], dtype=position.dtype),
    )


def falling(frames: int, acceleration: torch.Tensor) -> torch.Tensor:
    """x_k = a k^2 / 2 for one particle, in frames."""
    time = torch.arange(frames, dtype=torch.float64)[:, None, None]
    return 0.5 * acceleration * time**2


def test_constant_acceleration_gives_its_closed_form():
    """v_k = a (k + 1/2), k = 0..n-1: mean a n / 2, variance a^2 (n^2 - 1) / 12; a is constant."""
    acceleration, frames = torch.tensor([0.0, -9.81e-4, 2e-4], dtype=torch.float64), 101
    found = measure_statistics([make_trajectory(falling(frames, acceleration))])
    steps = frames - 1
    close = {"rtol": 1e-12, "atol": 1e-15}
    torch.testing.assert_close(found.velocity_mean, acceleration * steps / 2, **close)
    std = acceleration.abs() * ((steps**2 - 1) / 12) ** 0.5
    torch.testing.assert_close(found.velocity_std, std, **close)
    torch.testing.assert_close(found.acceleration_mean, acceleration, **close)
    torch.testing.assert_close(found.acceleration_std, torch.zeros(3).double(), **close)


def test_the_deviation_is_of_the_data_and_not_of_the_trajectories():
    """Two bodies at +-1 m/frame: each has deviation 0, the data have deviation 1."""
    time = torch.arange(5, dtype=torch.float64)[:, None, None]
    ends = [make_trajectory(sign * time.expand(5, 1, 2)) for sign in (1.0, -1.0)]
    found = measure_statistics(ends)
    assert found.velocity_std.tolist() == [1.0, 1.0]
    assert found.velocity_mean.tolist() == [0.0, 0.0]


def test_trajectories_weigh_by_their_length():
    """Cutting the data elsewhere does not change the numbers: one pass equals one array."""
    generator = torch.Generator().manual_seed(0)
    bodies = [
        torch.rand(frames, particles, 2, generator=generator, dtype=torch.float64)
        for frames, particles in ((4, 7), (30, 2), (9, 11))
    ]
    steps = torch.cat([body.diff(dim=0).reshape(-1, 2) for body in bodies])
    found = measure_statistics(make_trajectory(body) for body in bodies)
    torch.testing.assert_close(found.velocity_mean, steps.mean(0), rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(found.velocity_std, steps.std(0, correction=0), rtol=1e-13, atol=0.0)


def test_a_small_deviation_on_a_large_mean_survives():
    """1 m/frame +- 1e-9: the difference of two squares would lose it in float64."""
    time = torch.arange(4, dtype=torch.float64)[:, None, None]
    speed = torch.tensor([[1.0 + 1e-9], [1.0 - 1e-9]], dtype=torch.float64).expand(2, 2)
    found = measure_statistics([make_trajectory(time * speed)])
    torch.testing.assert_close(
        found.velocity_std, torch.full((2,), 1e-9).double(), rtol=1e-6, atol=0.0
    )


def test_kinematic_particles_do_not_count():
    free = torch.rand(6, 3, 2, generator=torch.Generator().manual_seed(1))
    wall = 100.0 * torch.rand(6, 2, 2, generator=torch.Generator().manual_seed(2))
    both = measure_statistics([make_trajectory(torch.cat([wall, free], dim=1), kinematic=2)])
    alone = measure_statistics([make_trajectory(free)])
    assert both.to_metadata() == alone.to_metadata()


def test_si_and_per_frame_are_inverses():
    """Velocities scale with 1/dt, accelerations with 1/dt^2."""
    frames = measure_statistics([make_trajectory(falling(9, torch.tensor([0.5, -1.0]).double()))])
    seconds = frames.in_si(frame_dt=0.01)
    torch.testing.assert_close(seconds.velocity_mean, frames.velocity_mean * 100.0)
    torch.testing.assert_close(seconds.acceleration_mean, frames.acceleration_mean * 1e4)
    back = seconds.per_frame(frame_dt=0.01)
    torch.testing.assert_close(back.velocity_std, frames.velocity_std)
    with pytest.raises(ValueError, match="must be > 0"):
        frames.in_si(frame_dt=0.0)


def test_metadata_give_the_statistics_back():
    found = measure_statistics([make_trajectory(falling(9, torch.tensor([0.5, -1.0]).double()))])
    again = Statistics.from_metadata(found.to_metadata())
    assert again.to_metadata() == found.to_metadata()
    with pytest.raises(ValueError, match="lacks vel_std"):
        Statistics.from_metadata({"vel_mean": [], "acc_mean": [], "acc_std": []})


@pytest.mark.parametrize(("frames", "kinematic"), [(2, 0), (9, 1)])
def test_data_without_an_acceleration_are_refused(frames, kinematic):
    position = falling(frames, torch.ones(2).double())
    with pytest.raises(ValueError, match="no acceleration can be measured"):
        measure_statistics([make_trajectory(position, kinematic=kinematic)])


def test_long_trajectory_is_measured_block_by_block_with_the_same_result(monkeypatch):
    """Reference: all frames at once; every step and second difference is counted once."""
    for frames in (3, 7, 8, 9, 23):
        generator = torch.Generator().manual_seed(frames)
        motion = Trajectory(
            position=torch.rand(frames, 5, 2, generator=generator),
            particle_type=torch.tensor([5, 5, 3, 5, 5]),
            frame_dt=1e-2,
            bounds=torch.tensor([[0.0, 1.0], [0.0, 1.0]]),
        )
        whole = measure_statistics([motion])
        with monkeypatch.context() as patch:
            patch.setattr("giorom.data.statistics.BLOCK_NUMBERS", 20)
            blocks = measure_statistics([motion])
        for name, value in vars(whole).items():
            torch.testing.assert_close(getattr(blocks, name), value, rtol=1e-12, atol=1e-12)
