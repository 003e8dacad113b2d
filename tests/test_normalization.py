"""Scales go in and out; no result in SI units depends on them."""

import math

import pytest
import torch
from torch import Tensor

from giorom.features import FeatureConfig, Features
from giorom.graph import radius_edges
from giorom.normalization import Normalization
from giorom.pipeline import Dynamics, connect_within, rollout, start_from_velocity

STATISTICS = {
    "velocity_mean": (0.5, -2.0),
    "velocity_std": (3.0, 4.0),
    "acceleration_mean": (0.0, -9.81),
    "acceleration_std": (30.0, 40.0),
}


def random(*shape: int) -> Tensor:
    """Random numbers of order one."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_physical_acceleration_is_the_inverse_of_acceleration():
    """Round trip to rounding, on any leading axes."""
    scales = Normalization(**STATISTICS)
    for value in (random(50, 2) * 40.0, random(4, 5, 2)):
        back = scales.physical_acceleration(scales.acceleration(value))
        torch.testing.assert_close(back, value, rtol=1e-14, atol=1e-14)


def test_mean_and_spread_become_zero_and_one():
    """(mean - mean) / std = 0 and (mean + std - mean) / std = 1 on each axis."""
    scales = Normalization(**STATISTICS)
    for name, apply in (("velocity", scales.velocity), ("acceleration", scales.acceleration)):
        mean = torch.tensor(STATISTICS[f"{name}_mean"], dtype=torch.float64)
        std = torch.tensor(STATISTICS[f"{name}_std"], dtype=torch.float64)
        assert torch.equal(apply(mean), torch.zeros(2, dtype=torch.float64))
        torch.testing.assert_close(apply(mean + std), torch.ones(2, dtype=torch.float64))


def test_noise_adds_in_squares():
    """sqrt(std^2 + (sigma/dt)^2) for velocities, sigma/dt^2 for accelerations (method notes, 2)."""
    found = Normalization.fit(**STATISTICS, noise_std=0.4, frame_dt=0.1, isotropic=False)
    assert found.velocity_std == pytest.approx((5.0, math.sqrt(32.0)))
    assert found.acceleration_std == pytest.approx((50.0, math.sqrt(3200.0)))
    assert found.velocity_mean == STATISTICS["velocity_mean"]
    assert found.acceleration_mean == STATISTICS["acceleration_mean"]


def test_without_noise_the_statistics_are_the_scales():
    """Nothing is added to nothing."""
    found = Normalization.fit(**STATISTICS, noise_std=0.0, frame_dt=0.1, isotropic=False)
    assert found == Normalization(**STATISTICS)


def test_isotropic_scales_commute_with_rotations():
    """One scale, no offset: N(R v) = R N(v); its square is the mean of the squares."""
    found = Normalization.fit(**STATISTICS, noise_std=0.1, frame_dt=0.1, isotropic=True)
    assert found.velocity_std == pytest.approx((math.sqrt(12.5 + 1.0),) * 2)
    angle = 0.7
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    value = random(20, 2)
    for apply in (found.velocity, found.acceleration):
        torch.testing.assert_close(apply(value @ turn.T), apply(value) @ turn.T)


@pytest.mark.parametrize("name", ["velocity_std", "acceleration_std"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_scales_nothing_can_be_divided_by_are_refused(name, value):
    """The message names the scale."""
    with pytest.raises(ValueError, match=f"{name} must be finite and > 0"):
        Normalization(**(STATISTICS | {name: (1.0, value)}))


def air_drag(scales: Normalization):
    """A network that knows a = -3 v, written in dimensionless numbers."""

    def network(features: Features) -> Tensor:
        std = features.node.new_tensor(scales.velocity_std)
        mean = features.node.new_tensor(scales.velocity_mean)
        velocity = features.node[:, 2:4] * std + mean
        return scales.acceleration(-3.0 * velocity)

    return network


def test_a_rollout_in_si_does_not_depend_on_the_scales():
    """The law v_k = (1 - 3 dt)^k v_0 comes out whatever units the network thinks in."""
    start, velocity, frame_dt = random(8, 2), random(8, 2).flip(0), 0.01
    results = []
    for factor, shift in ((1.0, 0.0), (1e3, 0.0), (1e-3, 5.0)):
        scales = Normalization(
            velocity_mean=(shift, -shift),
            velocity_std=(3.0 * factor, 4.0),
            acceleration_mean=(-shift, 2.0 * shift),
            acceleration_std=(0.1, 7.0 * factor),
        )
        dynamics = Dynamics(
            air_drag(scales),
            features=FeatureConfig(velocities=2, walls=False),
            normalization=scales,
            radius=1.0,
        )
        state = start_from_velocity(
            start,
            velocity,
            particle_type=torch.full((8,), 5),
            bounds=torch.tensor([[-10.0, 10.0]] * 2, dtype=torch.float64),
            frame_dt=frame_dt,
            history=3,
        )
        connect = connect_within(1.0, configuration="current")
        *_, last = rollout(state, 50, connect=connect, step=dynamics.step)
        results.append(last.position)
    decay = 1.0 - 3.0 * frame_dt
    expected = start + velocity * frame_dt * sum(decay**k for k in range(1, 51))
    for result in results:
        torch.testing.assert_close(result, expected, rtol=0, atol=1e-10)


def test_dimensionless_velocities_reach_the_network():
    """Dynamics hands over what Normalization makes of the velocity."""
    scales = Normalization(**STATISTICS)
    seen = []

    def network(features: Features) -> Tensor:
        seen.append(features.node)
        return torch.zeros_like(features.position)

    dynamics = Dynamics(
        network,
        features=FeatureConfig(velocities=1, walls=False),
        normalization=scales,
        radius=1.0,
    )
    velocity = random(4, 2)
    state = start_from_velocity(
        torch.zeros(4, 2, dtype=torch.float64),
        velocity,
        particle_type=torch.full((4,), 5),
        bounds=torch.tensor([[-1.0, 1.0]] * 2, dtype=torch.float64),
        frame_dt=0.5,
        history=2,
    )
    acceleration = dynamics(state, radius_edges(state.position, state.batch, 1.0))
    torch.testing.assert_close(seen[0], scales.velocity(velocity), rtol=0, atol=1e-13)
    assert torch.equal(acceleration, acceleration.new_tensor([0.0, -9.81]).expand(4, 2))


@pytest.mark.parametrize("isotropic", [False, True])
def test_with_explicit_gravity_zero_is_free_fall_and_the_scale_is_the_spread_about_it(isotropic):
    """Reference: the root mean square of a - g over data with those statistics."""
    gravity = torch.tensor([0.0, -9.8], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    data = torch.randn(1000, 2, generator=generator, dtype=torch.float64) * 3.0 + gravity / 2
    scales = Normalization.fit(
        velocity_mean=(0.0, 0.0),
        velocity_std=(1.0, 1.0),
        acceleration_mean=tuple(data.mean(dim=0).tolist()),
        acceleration_std=tuple(data.std(dim=0, correction=0).tolist()),
        noise_std=0.0,
        frame_dt=0.1,
        isotropic=isotropic,
        gravity=tuple(gravity.tolist()),
    )
    zero = torch.zeros(2, dtype=torch.float64)
    assert torch.equal(scales.physical_acceleration(zero), gravity)
    square = (data - gravity).square().mean(dim=0)
    expected = square.mean().expand(2).sqrt() if isotropic else square.sqrt()
    assert scales.acceleration_std == pytest.approx(expected.tolist(), rel=1e-9)
