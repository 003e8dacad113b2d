"""Advance particle positions from predicted accelerations.

Stage 5 of the pipeline: the network says how particles accelerate, this module moves them; the
grid and the body stepper move their samples themselves. ``semi_implicit_euler`` and
``finite_differences`` are inverses of each other, so that a training target computed here means the
same as a rollout step taken here.

Positions are metres, time is seconds. Nothing in this module is normalised.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import SparseState


def semi_implicit_euler(
    position: Float[Tensor, "q d"],
    previous_position: Float[Tensor, "q d"],
    acceleration: Float[Tensor, "q d"],
    *,
    frame_dt: float,
) -> Float[Tensor, "q d"]:
    r"""Move each particle one frame ahead.

    The velocity is advanced first and the new velocity moves the position:

    .. math::
        v_{k+1} = \frac{x_k - x_{k-1}}{\Delta t} + \Delta t\, a_k,
        \qquad x_{k+1} = x_k + \Delta t\, v_{k+1}.

    Args:
        position: Positions at frame k [m].
        previous_position: Positions at frame k - 1 [m].
        acceleration: Accelerations at frame k [m/s^2].
        frame_dt: Time between frames [s].

    Returns:
        Positions at frame k + 1 [m].

    Raises:
        ValueError: If ``frame_dt`` is not positive.

    Source:
        arXiv:2407.03925v2, equations 25-26, with the frame time kept.
    """
    _check_frame_dt(frame_dt)
    velocity = (position - previous_position) / frame_dt + frame_dt * acceleration
    return position + frame_dt * velocity


def finite_differences(
    next_position: Float[Tensor, "q d"],
    position: Float[Tensor, "q d"],
    previous_position: Float[Tensor, "q d"],
    *,
    frame_dt: float,
) -> Float[Tensor, "q d"]:
    """Acceleration that ``semi_implicit_euler`` turns into ``next_position`` [m/s^2].

    Raises:
        ValueError: If ``frame_dt`` is not positive.
    """
    _check_frame_dt(frame_dt)
    return (next_position - 2.0 * position + previous_position) / frame_dt**2


def advance(
    state: SparseState,
    acceleration: Float[Tensor, "q d"],
    *,
    prescribed: Float[Tensor, "q d"] | None = None,
) -> SparseState:
    """The state one frame later.

    Args:
        state: Current sparse state.
        acceleration: Accelerations of all samples [m/s^2]; ignored for kinematic ones.
        prescribed: Next positions of which the kinematic rows are used [m]; by default kinematic
            particles stay where they are.

    Returns:
        A new state; the oldest frame of the history is dropped.
    """
    moved = semi_implicit_euler(
        state.position, state.history[:, -2], acceleration, frame_dt=state.frame_dt
    )
    held = state.position if prescribed is None else prescribed
    moved = torch.where(state.kinematic[:, None], held, moved)
    return replace(state, history=torch.cat([state.history[:, 1:], moved[:, None]], dim=1))


def _check_frame_dt(frame_dt: float) -> None:
    if not frame_dt > 0.0:
        raise ValueError(f"frame_dt is a time step in seconds and must be > 0, got {frame_dt!r}.")
