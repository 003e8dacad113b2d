"""Errors are zero on the identity and known on a known shift."""

import math

import pytest
import torch
from torch import Tensor

from giorom.evaluation.metrics import (
    amplitude_ratio,
    displacement_correlation,
    relative_displacement_error,
    squared_error_per_frame,
)


def motion(dtype: torch.dtype = torch.float64) -> Tensor:
    """Random positions at six frames."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand(6, 20, 3, generator=generator, dtype=torch.float64).to(dtype)


def scaled(truth: Tensor, factor: float) -> Tensor:
    """The same motion with ``factor`` times the displacement from the first frame."""
    return truth[:1] + factor * (truth - truth[:1])


def test_the_truth_has_no_error():
    """Identity: zero error, full amplitude, in phase."""
    truth = motion()
    assert not squared_error_per_frame(truth, truth).any()
    assert relative_displacement_error(truth, truth) == 0.0
    assert amplitude_ratio(truth, truth) == 1.0
    assert displacement_correlation(truth, truth) == pytest.approx(1.0, rel=1e-14)


def test_the_squared_error_of_a_shift_is_its_squared_length():
    """|(3, 4, 12)|^2 = 169 at the shifted frames: summed over axes, averaged over particles."""
    truth = motion()
    predicted = truth.clone()
    predicted[2:] += torch.tensor([3.0, 4.0, 12.0])
    expected = torch.tensor([0.0, 0.0, 169.0, 169.0, 169.0, 169.0], dtype=torch.float64)
    torch.testing.assert_close(squared_error_per_frame(predicted, truth), expected)


def test_one_wrong_particle_counts_one_in_all():
    """A shift of 2 of one particle in twenty: 4 / 20."""
    truth = motion()
    predicted = truth.clone()
    predicted[3, 7, 1] += 2.0
    assert float(squared_error_per_frame(predicted, truth)[3]) == pytest.approx(0.2)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.5, -1.0])
def test_a_motion_of_another_amplitude_has_known_errors(factor):
    """S times the displacement: relative error |s - 1|, amplitude |s|, correlation sign(s)."""
    truth = motion()
    predicted = scaled(truth, factor)
    assert relative_displacement_error(predicted, truth) == pytest.approx(abs(factor - 1.0))
    assert amplitude_ratio(predicted, truth) == pytest.approx(abs(factor), abs=1e-14)
    if factor:
        sign = math.copysign(1.0, factor)
        assert displacement_correlation(predicted, truth) == pytest.approx(sign)


def test_a_body_held_still_scores_one():
    """Whatever it should have done; its amplitude and correlation are zero."""
    truth = motion()
    held = truth[:1].expand_as(truth)
    assert relative_displacement_error(held, truth) == pytest.approx(1.0)
    assert amplitude_ratio(held, truth) == displacement_correlation(held, truth) == 0.0


def test_motion_at_right_angles_is_not_correlated():
    """Displacements along x against displacements along y: zero, with full amplitude."""
    truth, predicted = torch.zeros(2, 4, 6, 2, dtype=torch.float64)
    truth[1:, :, 0] = predicted[1:, :, 1] = 3.0
    assert displacement_correlation(predicted, truth) == 0.0
    assert amplitude_ratio(predicted, truth) == 1.0
    assert relative_displacement_error(predicted, truth) == pytest.approx(math.sqrt(2.0))


def test_errors_do_not_depend_on_where_the_domain_is():
    """Moved by 100 m, in float64."""
    truth = motion()
    predicted = scaled(truth, 0.7)
    for metric in (relative_displacement_error, amplitude_ratio, displacement_correlation):
        moved = metric(predicted + 100.0, truth + 100.0)
        assert moved == pytest.approx(metric(predicted, truth), rel=1e-11)


def test_sums_of_single_precision_positions_run_in_double():
    """A shift of 2^-20 of float32 positions on a grid of 2^-20 is measured exactly."""
    truth = (motion() * 2**19).round().float() / 2**19
    shift = 2.0**-20
    error = squared_error_per_frame(truth + shift, truth)
    assert error.dtype == torch.float64
    torch.testing.assert_close(error, torch.full_like(error, 3 * shift**2), rtol=1e-14, atol=0)


def test_a_body_that_never_moves_has_no_relative_error_when_met():
    """0 / 0 counts as zero, not as NaN."""
    truth = motion()[:1].expand(4, -1, -1)
    assert relative_displacement_error(truth, truth) == 0.0
    assert amplitude_ratio(truth, truth) == displacement_correlation(truth, truth) == 0.0
