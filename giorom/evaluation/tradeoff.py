"""Error against time: who is on the front, what the solver takes for an error, when a model pays.

A *curve* is a list of pairs of an error [m^2] and a time [s]. Pure functions.
"""

import math
from itertools import pairwise

Curve = list[tuple[float, float]]
"""Pairs of error and time."""


def on_front(points: Curve) -> list[bool]:
    """Which points no other point beats: none has less of one without more of the other."""
    return [
        not any(
            other[0] <= point[0] and other[1] <= point[1] and other != point for other in points
        )
        for point in points
    ]


def front(points: Curve) -> Curve:
    """The points that no other point beats, with rising error and falling time."""
    kept = {point for point, best in zip(points, on_front(points), strict=True) if best}
    return sorted(kept)


def time_at_error(curve: Curve, error: float) -> float:
    """Least time of a curve for at most an error, interpolated between logarithms [s].

    A larger error than that of the cheapest point is no cheaper; a smaller one than that of the
    most exact point takes the time of that point, the most that can be asked for.

    Args:
        curve: Points of one method at several resolutions; those that others beat do not count.
        error: What is asked for [m^2].

    Raises:
        ValueError: If there is no point.
    """
    best = front(curve)
    if not best:
        raise ValueError("there is no point of error and time to compare with.")
    if error <= best[0][0]:
        return best[0][1]
    for (low, slow), (high, fast) in pairwise(best):
        if error <= high:
            if low <= 0.0:
                return slow
            share = math.log(error / low) / math.log(high / low)
            return slow ** (1.0 - share) * fast**share
    return best[-1][1]


def pays_back_after(*, upfront: float, reference: float, seconds: float) -> float:
    r"""Rollouts after which a model has cost less than the solver at the same error.

    .. math::
        N^* = \frac{C_\text{data} + C_\text{train} + C_\text{tune}}{c_\text{solver} - c}

    Args:
        upfront: Data, training and tuning [s].
        reference: A rollout of the solver at equal error [s].
        seconds: A rollout of the model [s].

    Returns:
        Infinity where the solver is as fast.
    """
    saved = reference - seconds
    return upfront / saved if saved > 0.0 else math.inf
