"""Damped Gauss-Newton for the few coefficients of a nonlinear field.

A step that does not lower the squared residual is refused and repeated with more damping
(Levenberg, Marquardt), so that the result is never worse than the start. Solves in float64.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

HARDER, SOFTER = 10.0, 0.25
"""Factors of the damping after a refused and after an accepted step."""


def gauss_newton(
    linearize: Callable[[Tensor], tuple[Tensor, Tensor]],
    target: Float[Tensor, " n"],
    start: Float[Tensor, " r"],
    *,
    iterations: int,
    damping: float,
) -> Float[Tensor, " r"]:
    """Coefficients q with the least |target - f(q)|^2 near ``start``.

    Args:
        linearize: f(q) of n entries and its Jacobian (n r).
        target: Wanted values.
        start: First guess.
        iterations: Number of steps, refused ones included.
        damping: Least damping, relative to the mean of the diagonal of the normal matrix.
    """
    code, strength = start, damping
    value, jacobian = linearize(code)
    residual = target.double() - value.double()
    for _ in range(iterations):
        step = _step(jacobian.double(), residual, strength)
        if step is None:
            strength = max(strength, 1e-12) * HARDER
            continue
        trial = code + step.to(code.dtype)
        value, slope = linearize(trial)
        left = target.double() - value.double()
        if bool(left.square().sum() <= residual.square().sum()):
            code, jacobian, residual = trial, slope, left
            strength = max(strength * SOFTER, damping)
        else:
            strength = max(strength, 1e-12) * HARDER
    return code


def _step(jacobian: Tensor, residual: Tensor, strength: float) -> Tensor | None:
    """The damped step; none where the normal matrix is singular."""
    normal = jacobian.T @ jacobian
    diagonal = normal.diagonal()
    damped = normal + strength * diagonal.mean() * torch.eye(len(normal)).to(normal)
    factor, failed = torch.linalg.cholesky_ex(damped)
    if int(failed) != 0:
        return None
    return torch.cholesky_solve((jacobian.T @ residual)[:, None], factor)[:, 0]
