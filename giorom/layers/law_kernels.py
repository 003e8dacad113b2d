# Warp needs float(0.0) to declare a variable that is assigned again.
# ruff: noqa: UP018
"""The learned law as NVIDIA Warp functions, for the kernels of ``grid_kernels.py``.

The same arithmetic as ``learned_law.py``, which is the reference. Units as there.
"""

from types import SimpleNamespace
from typing import no_type_check

import warp as wp  # noqa: TID253

from giorom.layers.learned_law import CONSTANTS, NEWTON_STEPS, SOLID
from giorom.state import GOOP, SAND, WATER


@no_type_check
def law_functions(dimension: int) -> SimpleNamespace:  # noqa: C901  (counts the functions inside)
    """Stress and return to the yield surface, and the types of their arguments.

    Constants come as a vector in the order of ``CONSTANTS``.

    Args:
        dimension: Space dimension, 2 or 3.
    """
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    constants = wp.types.vector(len(CONSTANTS), dtype=float)

    @wp.func
    def pull(ratio: float, kind: int, c: constants):
        result = c[0] * (wp.pow(ratio, c[2]) - 1.0) / c[2]
        if kind == wp.static(SAND):
            result = wp.min(result, 0.0)
        return result

    @wp.func
    def deviator(b: matrix):
        return b - wp.trace(b) / float(dimension) * wp.identity(n=dimension, dtype=float)

    @wp.func
    def stress(b: matrix, ratio: float, kind: int, c: constants):
        identity = wp.identity(n=dimension, dtype=float)
        return c[1] * deviator(b) + pull(ratio, kind, c) * identity

    @wp.func
    def with_unit_determinant(deviation: matrix):
        half = 0.5 * wp.ddot(deviation, deviation)
        mean = float(0.0)
        if wp.static(dimension == 2):
            mean = wp.sqrt(1.0 + half)
        else:
            rest = wp.determinant(deviation) - 1.0
            mean = 1.0 + wp.sqrt(half)
            for _ in range(wp.static(NEWTON_STEPS)):
                slope = wp.max(3.0 * mean * mean - half, 0.1)
                mean = mean - (mean * mean * mean - half * mean + rest) / slope
        return deviation + mean * wp.identity(n=dimension, dtype=float)

    @wp.func
    def returned(trial: matrix, ratio: float, kind: int, c: constants, dt: float):
        deviation = deviator(trial)
        bears = c[3]
        if kind == wp.static(SAND):
            bears = c[4] * wp.max(-pull(ratio, kind, c), 0.0)
        if kind == wp.static(WATER):
            bears = 0.0
        length = wp.sqrt(wp.max(wp.ddot(deviation, deviation), 1.0e-12))
        excess = wp.max(1.0 - bears / (c[1] * length), 0.0)
        if kind == wp.static(GOOP):
            excess = excess * (1.0 - wp.exp(-dt / c[5]))
        if kind == wp.static(SOLID[0]) or kind == wp.static(SOLID[1]):
            excess = 0.0
        return with_unit_determinant((1.0 - excess) * deviation)

    return SimpleNamespace(matrix=matrix, constants=constants, stress=stress, returned=returned)
