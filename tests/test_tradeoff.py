"""Fronts, interpolation and payback against hand-made points and brute force."""

import math
import random

import pytest

from giorom.evaluation.tradeoff import front, on_front, pays_back_after, time_at_error


def test_the_front_is_what_a_sweep_by_error_leaves():
    """Sorted by error, a point is kept if it is faster than everything before it."""
    drawn = random.Random(0)  # noqa: S311
    points = [(drawn.random(), drawn.random()) for _ in range(200)]
    expected, fastest = [], math.inf
    for error, seconds in sorted(points):
        if seconds < fastest:
            expected.append((error, seconds))
            fastest = seconds
    assert front(points) == expected
    assert sum(on_front(points)) == len(expected)


def test_equal_points_are_both_on_the_front():
    assert on_front([(1.0, 1.0), (1.0, 1.0), (1.0, 2.0)]) == [True, True, False]


def test_the_time_of_a_power_law_is_interpolated_exactly():
    """Seconds = error^-2/3 is a line between logarithms."""
    curve = [(error, error ** (-2 / 3)) for error in (1e-6, 1e-4, 1e-3)]
    for error in (1e-6, 3e-5, 1e-4, 5e-4, 1e-3):
        assert time_at_error(curve, error) == pytest.approx(error ** (-2 / 3))
    assert time_at_error([*curve, (1e-4, 1e9)], 1e-4) == pytest.approx(1e-4 ** (-2 / 3))


def test_beyond_its_ends_a_curve_is_as_fast_as_there():
    """No cheaper run than the cheapest, no more exact one than the most exact; zero has no log."""
    curve = [(0.0, 8.0), (1e-4, 2.0), (1e-2, 1.0)]
    assert time_at_error(curve, 1.0) == 1.0
    assert time_at_error(curve, 0.0) == 8.0
    assert time_at_error(curve, 1e-5) == 8.0
    assert time_at_error([(1e-4, 2.0)], 1e-9) == 2.0
    with pytest.raises(ValueError, match="no point"):
        time_at_error([], 1.0)


def test_a_model_pays_back_when_the_saved_time_is_the_upfront_one():
    """N (c_solver - c) = C; never, where nothing is saved."""
    count = pays_back_after(upfront=600.0, reference=5.0, seconds=2.0)
    assert 600.0 + count * 2.0 == pytest.approx(count * 5.0)
    assert pays_back_after(upfront=600.0, reference=2.0, seconds=2.0) == math.inf
    assert pays_back_after(upfront=600.0, reference=1.0, seconds=2.0) == math.inf
