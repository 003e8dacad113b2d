"""Period and amplitude of motions whose period and amplitude are known."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from giorom.evaluation.swing import compare_swings, dominant_period, principal_motion


def swinging(
    period: float, *, frames: int = 100, amplitude: float = 0.05, phase: float = 0.0
) -> Tensor:
    """Ten points whose height times a sine is their displacement along one direction."""
    height = torch.linspace(0.0, 1.0, 10, dtype=torch.float64)
    time = torch.arange(frames, dtype=torch.float64)
    sine = torch.sin(2.0 * math.pi * time / period + phase)
    position = torch.zeros(frames, 10, 3, dtype=torch.float64)
    position[..., 1] = height
    position[..., 0] = amplitude * sine[:, None] * height
    return position


@pytest.mark.parametrize("period", [7.3, 25.0, 40.0, 64.0, 90.0])
def test_the_period_of_a_sine_is_found(period):
    """One to fourteen periods, none of them whole."""
    signal = np.sin(2.0 * np.pi * np.arange(101) / period + 0.4) + 3.0
    assert dominant_period(signal) == pytest.approx(period, rel=1e-3)


def test_the_stronger_of_two_sines_is_taken():
    """Amplitudes 1 and 1/2, periods 30 and 11; the weaker one barely pulls at it."""
    time = np.arange(150)
    signal = np.sin(2.0 * np.pi * time / 30.0) + 0.5 * np.sin(2.0 * np.pi * time / 11.0)
    assert dominant_period(signal) == pytest.approx(30.0, rel=0.02)


def test_a_damped_swing_keeps_its_period():
    """Peaks fall to 0.95 each half period, as measured on our bodies."""
    time = np.arange(100)
    signal = 0.95 ** (2.0 * time / 40.0) * np.sin(2.0 * np.pi * time / 40.0)
    assert dominant_period(signal) == pytest.approx(40.0, rel=0.01)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
@pytest.mark.parametrize("size", [0.5, 1.0, 1.5])
def test_ratios_of_period_and_amplitude_are_found(factor, size):
    """Predicted over true; whole numbers of half periods make the amplitude exact."""
    truth = swinging(40.0, frames=201)
    predicted = swinging(40.0 * factor, frames=201, amplitude=0.05 * size)
    swing = compare_swings(predicted, truth)
    assert swing.true_period == pytest.approx(40.0, rel=1e-3)
    assert swing.period_ratio == pytest.approx(factor, rel=1e-3)
    assert swing.amplitude_ratio == pytest.approx(size, rel=1e-2)


def test_the_component_is_that_of_the_truth():
    """A prediction that swings at right angles has no amplitude in it."""
    truth = swinging(40.0)
    across = truth.clone()
    across[..., 2], across[..., 0] = truth[..., 0], 0.0
    true, guess = principal_motion(across, truth)
    assert np.abs(true).max() > 0.1 * 0.05
    assert np.abs(guess).max() < 1e-12
    swing = compare_swings(across, truth)
    assert swing.amplitude_ratio == pytest.approx(0.0, abs=1e-9)


def test_a_body_that_holds_still_neither_swings_nor_fails():
    """No amplitude and no period of its own: both ratios are zero."""
    truth = swinging(40.0)
    held = truth[:1].expand_as(truth)
    swing = compare_swings(held, truth)
    assert (swing.period_ratio, swing.amplitude_ratio) == (0.0, 0.0)


def test_less_than_a_period_says_nothing():
    """Sixty frames of a period of 90, a body at rest, and four frames."""
    assert compare_swings(swinging(90.0, frames=60), swinging(90.0, frames=60)) is None
    still = swinging(40.0)[:1].expand(50, -1, -1)
    assert compare_swings(still, still) is None
    assert compare_swings(swinging(40.0, frames=4), swinging(40.0, frames=4)) is None
