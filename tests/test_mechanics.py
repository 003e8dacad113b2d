"""Energy, momentum, density and packing: zero on the identity, known on closed forms."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from giorom.evaluation.comparison import Comparison
from giorom.evaluation.mechanics import (
    density_error,
    kinetic_energy,
    kinetic_energy_error,
    kinetic_energy_mse,
    momentum,
    momentum_error,
    number_density,
    smallest_distance,
    spline_height,
    volume_ratio,
)

FRAME_DT = 0.01


def cloud(*, count: int = 200, dimension: int = 3, seed: int = 0) -> Tensor:
    """Random points of the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def lattice(*, side: int = 9, spacing: float = 0.1, dimension: int = 3) -> Tensor:
    axis = spacing * torch.arange(side, dtype=torch.float64)
    return torch.cartesian_prod(*[axis] * dimension)


def drift(velocity: Tensor, *, frames: int = 6) -> Tensor:
    """A cloud that moves without changing its shape."""
    time = FRAME_DT * torch.arange(frames, dtype=torch.float64)[:, None, None]
    return cloud() + time * velocity


def test_a_drifting_body_has_half_its_squared_speed_and_its_velocity():
    """E_k / m = |v|^2 / 2 and p / m = v, exact for differences of a uniform motion."""
    velocity = torch.tensor([1.0, -2.0, 2.0], dtype=torch.float64)
    motion = drift(velocity)
    energy = kinetic_energy(motion, frame_dt=FRAME_DT)
    torch.testing.assert_close(energy, torch.full_like(energy, 4.5))
    torch.testing.assert_close(momentum(motion, frame_dt=FRAME_DT), velocity.expand(5, 3))


def test_the_energy_of_a_spinning_ring_is_that_of_its_chords():
    """A chord of a turn by w dt is 2 r sin(w dt / 2) long; the momentum of a ring is zero."""
    count, radius, turn = 12, 0.4, 0.3
    angle = 2.0 * math.pi * torch.arange(count, dtype=torch.float64) / count
    angles = angle + turn * torch.arange(5, dtype=torch.float64)[:, None]
    ring = radius * torch.stack([angles.cos(), angles.sin()], dim=2)
    expected = 0.5 * (2.0 * radius * math.sin(turn / 2.0) / FRAME_DT) ** 2
    energy = kinetic_energy(ring, frame_dt=FRAME_DT)
    torch.testing.assert_close(energy, torch.full_like(energy, expected))
    assert float(momentum(ring, frame_dt=FRAME_DT).abs().max()) < 1e-12


def test_errors_of_energy_and_momentum_are_zero_on_the_identity_and_on_a_shift():
    """Both are blind to where the body is."""
    motion = drift(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    for other in (motion, motion + 0.2):
        for measure in (kinetic_energy_error, kinetic_energy_mse, momentum_error):
            assert measure(other, motion, frame_dt=FRAME_DT) == pytest.approx(0.0, abs=1e-10)


def test_errors_of_a_wrong_speed_have_closed_forms():
    """Speed k v: energy off by k^2 - 1 of itself, momentum by (k - 1) |v|; at rest 1 and |v|."""
    velocity = torch.tensor([0.0, 3.0, 4.0], dtype=torch.float64)
    truth, faster, rest = drift(velocity), drift(1.2 * velocity), drift(0.0 * velocity)
    options = {"frame_dt": FRAME_DT}
    assert kinetic_energy_error(faster, truth, **options) == pytest.approx(0.44)
    assert kinetic_energy_mse(faster, truth, **options) == pytest.approx((0.44 * 12.5) ** 2)
    assert momentum_error(faster, truth, **options) == pytest.approx(1.0)
    assert kinetic_energy_error(rest, truth, **options) == pytest.approx(1.0)
    assert momentum_error(rest, truth, **options) == pytest.approx(5.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_kernel_of_the_density_integrates_to_one(dimension):
    """Midpoint rule over its support, by the density that one point makes at many others."""
    fine, length = 0.06, 1.2
    side = round(2.0 * 2.0 * length / fine)
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) * fine - 2.0 * length
    ratio = torch.cartesian_prod(*[axis] * dimension).norm(dim=1) / length
    near = 1.0 - 1.5 * ratio**2 + 0.75 * ratio**3
    far = 0.25 * (2.0 - ratio).clamp_min(0.0) ** 3
    kernel = torch.where(ratio < 1.0, near, far) * spline_height(dimension) / length**dimension
    assert float(kernel.sum()) * fine**dimension == pytest.approx(1.0, rel=2e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_density_of_a_lattice_is_one_point_per_cell(dimension):
    """A lattice of constant a has n = a^-d away from its surface."""
    points = lattice(dimension=dimension)
    density = number_density(points, spacing=0.1)
    inner = ((points > 0.25) & (points < 0.55)).all(dim=1).numpy()
    np.testing.assert_allclose(density[inner], 0.1**-dimension, rtol=0.01)


def test_the_density_is_the_sum_over_all_pairs():
    """All pairs, without a tree."""
    points, spacing = cloud(), 0.1
    length = 1.2 * spacing
    ratio = (points[:, None] - points[None]).norm(dim=2) / length
    near = 1.0 - 1.5 * ratio**2 + 0.75 * ratio**3
    far = 0.25 * (2.0 - ratio).clamp_min(0.0) ** 3
    expected = torch.where(ratio < 1.0, near, far).sum(dim=1) / math.pi / length**3
    np.testing.assert_allclose(number_density(points, spacing=spacing), expected, rtol=1e-12)


def test_density_and_volume_are_right_for_the_same_cloud_elsewhere():
    """Zero on a renumbered and shifted cloud."""
    points = cloud()
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(1))
    one, two = (number_density(c, spacing=0.1) for c in (points, points[order] + 0.3))
    assert density_error(two, one) == pytest.approx(0.0, abs=1e-9)
    assert volume_ratio(two, one) == pytest.approx(1.0, rel=1e-9)


def test_a_collapsed_and_a_scattered_cloud_have_the_density_of_all_points_and_of_one():
    """All in one place: p W(0); far apart: W(0). Error p - 1 and volume 1 / p between them."""
    count = 50
    apart = lattice(side=1).repeat(count, 1) + torch.arange(count, dtype=torch.float64)[:, None]
    together = torch.zeros(count, 3, dtype=torch.float64)
    far, close = (number_density(points, spacing=0.1) for points in (apart, together))
    np.testing.assert_allclose(far, 1.0 / math.pi / 0.12**3)
    np.testing.assert_allclose(close, count * far)
    assert density_error(close, far) == pytest.approx(count - 1.0)
    assert volume_ratio(close, far) == pytest.approx(1.0 / count)


def test_the_smallest_distance_is_that_of_all_pairs():
    """A lattice, and random points against the full matrix."""
    assert smallest_distance(lattice()) == pytest.approx(0.1)
    points = cloud()
    pairs = (points[:, None] - points[None]).norm(dim=2).fill_diagonal_(math.inf)
    assert smallest_distance(points) == pytest.approx(float(pairs.min()))


def scores_of(predicted: Tensor, truth: Tensor) -> dict:
    """Scores of a motion whose first frame is given."""
    return Comparison(
        given=truth[:1],
        truth=truth[1:],
        predicted=predicted[1:],
        trivial={},
        bounds=torch.tensor([[0.0, 1.0]] * 3),
        frame_dt=FRAME_DT,
    ).scores()


NEW_SCORES = (
    "earth_mover_distance",
    "sinkhorn_divergence",
    "density_error",
    "volume_error",
    "kinetic_energy_mse",
    "kinetic_energy_error",
    "momentum_error",
)


def test_every_new_score_of_a_perfect_prediction_is_zero():
    truth = drift(torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))
    scores = scores_of(truth, truth)
    assert {name: scores[name] for name in NEW_SCORES} == pytest.approx(
        dict.fromkeys(NEW_SCORES, 0.0), abs=1e-9
    )
    assert scores["smallest_distance"] == scores["true_smallest_distance"] > 0.0


def test_scores_of_a_shifted_prediction_have_closed_forms():
    """Transport sees the whole shift; energy only in the first frame, density not at all."""
    truth = drift(torch.zeros(3, dtype=torch.float64))
    shift = torch.tensor([0.0, 0.003, 0.004], dtype=torch.float64)
    scores = scores_of(truth + shift, truth)
    assert scores["earth_mover_distance"] == pytest.approx(0.005, rel=1e-6)
    assert scores["sinkhorn_divergence"] == pytest.approx(0.005**2, rel=1e-4)
    assert scores["density_error"] == pytest.approx(0.0, abs=1e-6)
    assert scores["momentum_error"] == pytest.approx(0.5 / math.sqrt(5.0))
    assert scores["kinetic_energy_mse"] == pytest.approx(0.125**2 / 5.0)


def test_without_its_library_the_divergence_alone_is_missing(monkeypatch):
    monkeypatch.setattr("giorom.evaluation.comparison.has_sinkhorn", lambda: False)
    truth = drift(torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))
    scores = scores_of(truth, truth)
    assert scores["sinkhorn_divergence"] is None
    assert scores["earth_mover_distance"] == 0.0
