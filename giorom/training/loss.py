"""The training loss: error of the acceleration and of the position it leads to (equation 10).

Both terms start from the same noisy state, and both targets keep the position offset of that
state: velocity noise must be undone, position noise must not. (The official code starts the
position term from the clean state, so that its two terms contradict each other.) Kinematic
particles do not count.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.data.windows import WindowBatch, free_particles
from giorom.graph import concatenate_edges
from giorom.integrate import advance, finite_differences
from giorom.pipeline import Connect, Dynamics
from giorom.state import SparseState, concatenate_states


@dataclass(frozen=True, kw_only=True)
class WeakFormConfig:
    """Training on true states with the equation of motion averaged in time (``weak_loss``)."""

    half_width: int = 16
    """Half width m of the hat function [frames]; about a quarter of the slowest period."""

    stride: int = 4
    """Frames between evaluations of the model, a divisor of ``half_width``."""

    weight: float = 10.0
    """Weight of the averaged error against that at single frames."""

    until: float = 0.7
    """Share of the budget at which unrolled training takes over."""

    def __post_init__(self) -> None:
        """Reject windows that cannot be divided."""
        if self.stride < 1 or self.half_width < 1 or self.half_width % self.stride:
            raise ValueError(
                f"WeakFormConfig.stride must be >= 1 and divide half_width, got "
                f"stride={self.stride!r} and half_width={self.half_width!r}."
            )
        if not self.weight >= 0.0 or not 0.0 < self.until <= 1.0:
            raise ValueError(
                f"WeakFormConfig needs weight >= 0 and until in (0, 1], got weight="
                f"{self.weight!r} and until={self.until!r}."
            )


def unrolled_loss(
    dynamics: Dynamics,
    state: SparseState,
    batch: WindowBatch,
    *,
    connect: Connect,
    position_weight: float,
) -> Float[Tensor, ""]:
    """Mean of equation 10 over the frames of ``batch.target``, the model fed its own output.

    One target frame gives the paper's one-step loss. With more, gradients flow through all steps,
    and step k is divided by ((k+1)(k+2)/2)^2, the square of what a constant error of the
    acceleration would have grown to.

    Args:
        dynamics: Model under training.
        state: Noisy state at the current frame.
        batch: The clean windows the state was made from.
        connect: Graph of a state, where the batch brings none.
        position_weight: Weight beta of the squared position error [1/m^2].

    Returns:
        The loss, dimensionless; means over free particles and axes.
    """
    free = free_particles(state)
    offset = state.position - batch.state.position
    total = state.position.new_zeros(())
    frames = batch.target.shape[1]
    for frame in range(frames):
        target = batch.target[:, frame] + offset
        wanted = finite_differences(
            target, state.position, state.history[:, -2], frame_dt=state.frame_dt
        )
        edges = batch.edges if batch.edges is not None else connect(state)
        predicted = dynamics.normalized(state, edges).float()
        error = predicted - dynamics.normalization.acceleration(wanted)
        acceleration = dynamics.normalization.physical_acceleration(predicted)
        state = advance(state, acceleration, prescribed=batch.target[:, frame])
        miss = state.position - target
        growth = (frame + 1) * (frame + 2) / 2
        step = error[free].square().mean() + position_weight * miss[free].square().mean()
        total = total + step / growth**2
    return total / frames


def weak_loss(
    dynamics: Dynamics,
    batch: WindowBatch,
    *,
    connect: Connect,
    stride: int,
    weight: float,
) -> Float[Tensor, ""]:
    r"""Error of the acceleration, at single frames and averaged over many.

    The model sees true states every ``stride`` frames over 2 m frames. Besides the mean squared
    error at each of them, the equation of motion is asked to hold against a hat function in time,
    which needs no derivative of the data and in which slow motion weighs most:

    .. math::
        \Delta t^2 \sum_{|k| < m} (m - |k|)\, a_{n+k} = x_{n+m} - 2 x_n + x_{n-m},

    the sum over the model's accelerations taken at every ``stride``-th k. One-step errors are
    dominated by the fast modes of a body, rollout errors by its slowest.

    Args:
        dynamics: Model under training.
        batch: Clean windows with 2 m future frames, m a multiple of ``stride``.
        connect: Graph of a state, where the batch brings none.
        stride: Frames between evaluations.
        weight: Weight of the averaged error.

    Returns:
        The loss, dimensionless; means over free particles and axes.
    """
    frames = torch.cat([batch.state.history, batch.target], dim=1)
    history, future = batch.state.history.shape[1], batch.target.shape[1]
    half, frame_dt = future // 2, batch.state.frame_dt
    center = history - 1 + half
    shifts = range(stride - half, half, stride)
    states = [
        replace(batch.state, history=frames[:, center + k - history + 1 : center + k + 1])
        for k in shifts
    ]
    state = concatenate_states(states)
    if batch.edges is None:
        edges = connect(state)
    else:
        edges = concatenate_edges([batch.edges] * len(states))
    predicted = dynamics.normalized(state, edges).float().unflatten(0, (len(states), -1))
    free = free_particles(batch.state)
    error = 0.0
    for number, k in enumerate(shifts):
        now = center + k
        wanted = finite_differences(
            frames[:, now + 1], frames[:, now], frames[:, now - 1], frame_dt=frame_dt
        )
        difference = predicted[number] - dynamics.normalization.acceleration(wanted)
        error = error + difference[free].square().mean() / len(states)
    hat = torch.tensor([float(half - abs(k)) * stride for k in shifts]).to(predicted) / half**2
    average = finite_differences(
        frames[:, center + half],
        frames[:, center],
        frames[:, center - half],
        frame_dt=frame_dt * half,
    )
    missed = torch.einsum("k,kqd->qd", hat, predicted) / hat.sum()
    missed = missed - dynamics.normalization.acceleration(average)
    return error + weight * missed[free].square().mean()
