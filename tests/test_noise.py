"""The random walk of the training noise has the spread it promises."""

import pytest
import torch

from giorom.state import KINEMATIC, SAND, SparseState
from giorom.training.noise import add_random_walk

NOISE, VELOCITIES, COUNT = 0.01, 5, 20_000


def state() -> SparseState:
    """Many particles, the first ten kinematic."""
    kind = torch.full((COUNT,), SAND)
    kind[:10] = KINEMATIC
    generator = torch.Generator().manual_seed(0)
    history = torch.rand(COUNT, VELOCITIES + 1, 2, generator=generator, dtype=torch.float64)
    return SparseState(
        history=history,
        reference=history[:, 0],
        particle_type=kind,
        batch=torch.zeros(COUNT, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[0.0, 1.0]] * 2, dtype=torch.float64),
        frame_dt=0.1,
    )


def noise() -> torch.Tensor:
    """What was added to the history."""
    generator = torch.Generator().manual_seed(1)
    return add_random_walk(state(), NOISE, generator=generator).history - state().history


def test_the_spread_of_velocity_noise_grows_like_a_random_walk():
    """Velocity k of n carries k increments: std = sigma sqrt(k / n), sigma for the newest.

    The spread of 40 000 draws is known to 1 / sqrt(80 000); 5 sigma of that.
    """
    found = noise()[10:].diff(dim=1).transpose(1, 2).flatten(0, 1).std(dim=0)
    steps = torch.arange(1, VELOCITIES + 1, dtype=torch.float64)
    expected = NOISE * (steps / VELOCITIES).sqrt()
    assert ((found / expected - 1).abs() < 5 / 80_000**0.5).all()


def test_increments_of_velocity_noise_are_independent():
    """Their correlations vanish within 5 / sqrt(n)."""
    velocity = noise()[10:].diff(dim=1)
    step = torch.cat([velocity[:, :1], velocity.diff(dim=1)], dim=1)
    correlation = torch.corrcoef(step.flatten(1).T) - torch.eye(2 * VELOCITIES)
    assert correlation.abs().max() < 5 / COUNT**0.5


def test_the_oldest_position_and_kinematic_particles_are_exact():
    """The walk starts at zero; prescribed particles are known."""
    added = noise()
    assert not added[:, 0].any()
    assert not added[:10].any()
    assert added[10:, 1:].all()


def test_without_noise_the_state_is_returned_as_it_is():
    """Sigma = 0."""
    given = state()
    assert add_random_walk(given, 0.0, generator=torch.Generator()).history is given.history


def test_the_clean_state_is_left_alone_and_the_noise_follows_the_seed():
    """Public functions never change what they are given."""
    given = state()
    add_random_walk(given, NOISE, generator=torch.Generator().manual_seed(1))
    assert torch.equal(given.history, state().history)
    assert torch.equal(noise(), noise())
    other = add_random_walk(given, NOISE, generator=torch.Generator().manual_seed(2))
    assert not torch.equal(other.history - given.history, noise())


def test_the_spread_of_the_newest_position_noise_is_that_of_summed_velocities():
    """Var = sigma^2 / n * sum_k k^2: each increment counts as often as it is carried along."""
    found = float(noise()[10:, -1].std())
    total = sum(k * k for k in range(1, VELOCITIES + 1))
    assert found == pytest.approx(NOISE * (total / VELOCITIES) ** 0.5, rel=5 / 80_000**0.5)
