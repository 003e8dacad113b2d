"""The training losses: equation 10 for the network, the whole motion for the grid steppers.

Equation 10 adds the error of the acceleration and of the position it leads to. Both terms start
from the same noisy state, and both targets keep the position offset of that state: velocity noise
must be undone, position noise must not. (The official code starts the position term from the clean
state, so that its two terms contradict each other.) Kinematic particles do not count.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.data.windows import WindowBatch, free_particles
from giorom.integrate import advance, finite_differences
from giorom.pipeline import Connect, Dynamics, Step
from giorom.state import SparseState

SOFTENING = 1e-8
"""Squared error at which the loss of a motion turns from a root into a parabola [m^2]."""


def motion_loss(step: Step, batch: WindowBatch, *, connect: Connect) -> Float[Tensor, ""]:
    r"""Root of the mean squared error of each scene's motion, averaged over scenes [m].

    .. math::
        \frac{1}{B} \sum_b \sqrt{\epsilon + \frac{1}{T Q_b} \sum_{k, i} |x_i^k - \hat x_i^k|^2}

    over the B scenes, their T frames and the :math:`Q_b` free samples of scene b, with
    :math:`\epsilon` the ``SOFTENING``. The root keeps the few scenes that go very wrong
    from ruling the gradient.

    Args:
        step: Stages 4 and 5 under training; gradients flow through every frame.
        batch: The windows, from their first frame on.
        connect: Graph of a state.
    """
    state, errors = batch.state, []
    for frame in range(batch.target.shape[1]):
        state = step(state, connect(state), batch.target[:, frame])
        errors.append((state.position - batch.target[:, frame]).square().sum(dim=1))
    error = torch.stack(errors).mean(dim=0)
    free = free_particles(state)
    total = error.new_zeros(state.batch_size).index_add(0, state.batch[free], error[free])
    count = torch.bincount(state.batch[free], minlength=state.batch_size).clamp_min(1)
    return (total / count + SOFTENING).sqrt().mean()


def unrolled_loss(
    dynamics: Dynamics,
    state: SparseState,
    batch: WindowBatch,
    *,
    connect: Connect,
    position_weight: float,
    huber: float | None = None,
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
        huber: Error of the dimensionless acceleration, growth taken out, from which on it counts
            linearly.

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
        cost = _cost(error[free] / growth, huber)
        total = total + cost + position_weight * (miss[free] / growth).square().mean()
    return total / frames


def push_forward(
    dynamics: Dynamics, state: SparseState, batch: WindowBatch, *, connect: Connect
) -> tuple[SparseState, WindowBatch]:
    """Let the model step to the last but one frame of a window, without gradient.

    Where it strays from the truth on the way takes the place of noise: as with noise, the last
    step has to undo the error of the velocity, not that of the position.

    Args:
        dynamics: Model under training.
        state: State at the current frame, noisy or not.
        batch: The clean windows the state was made from.
        connect: Graph of a state, where the batch brings none.

    Returns:
        The state before the last frame, and the clean windows of that frame alone.

    Source:
        Brandstetter et al., "Message Passing Neural PDE Solvers", ICLR 2022 (arXiv:2202.03376),
        pushforward trick.
    """
    history, steps = batch.state.history.shape[1], batch.target.shape[1] - 1
    for frame in range(steps):
        with torch.no_grad():
            edges = batch.edges if batch.edges is not None else connect(state)
            acceleration = dynamics(state, edges).to(state.position.dtype)
            state = advance(state, acceleration, prescribed=batch.target[:, frame])
    clean = torch.cat([batch.state.history, batch.target], dim=1)[:, steps : steps + history]
    last = replace(batch, state=replace(batch.state, history=clean), target=batch.target[:, steps:])
    return state, last


def _cost(error: Tensor, huber: float | None) -> Tensor:
    """Mean square, of errors beyond ``huber`` the tangent of the square."""
    if huber is None:
        return error.square().mean()
    size = error.abs()
    return torch.where(size <= huber, size.square(), huber * (2.0 * size - huber)).mean()
