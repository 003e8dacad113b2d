"""The training loss: error of the acceleration and of the position it leads to (equation 10).

Both terms start from the same noisy state, and both targets keep the position offset of that
state: velocity noise must be undone, position noise must not. (The official code starts the
position term from the clean state, so that its two terms contradict each other.) Kinematic
particles do not count.
"""

from jaxtyping import Float
from torch import Tensor

from giorom.data.windows import WindowBatch, free_particles
from giorom.integrate import advance, finite_differences
from giorom.pipeline import Connect, Dynamics
from giorom.state import SparseState


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
