"""Predictions that need no model: what any surrogate has to beat.

All start from the same given frames as the model. Kinematic particles follow the scene: the
positions ``prescribed`` at each frame [m] where these are known, else they stay. Every particle
that reaches a wall stops there. ``frozen_shape`` alone knows the truth: it is an oracle, the best
that a prediction could do which gets the way of every body right and nothing of its deformation.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.state import SparseState


def hold_still(
    state: SparseState, frames: int, *, prescribed: Float[Tensor, "t q d"] | None = None
) -> Float[Tensor, "t q d"]:
    """The last given frame, for ever [m]."""
    return _held(state.position.expand(frames, -1, -1), state, prescribed)


def constant_velocity(
    state: SparseState, frames: int, *, prescribed: Float[Tensor, "t q d"] | None = None
) -> Float[Tensor, "t q d"]:
    """Straight on with the last velocity, stopped at the walls [m]."""
    still = torch.zeros_like(state.bounds[:, 0])
    return _held(_ballistic(state, frames, still), state, prescribed)


def free_fall(
    state: SparseState,
    frames: int,
    *,
    gravity: Float[Tensor, " d"],
    prescribed: Float[Tensor, "t q d"] | None = None,
) -> Float[Tensor, "t q d"]:
    """Semi-implicit Euler under gravity alone, stopped at the walls [m]."""
    return _held(_ballistic(state, frames, gravity), state, prescribed)


def frozen_shape(
    state: SparseState,
    truth: Float[Tensor, "t q d"],
    *,
    body: Int[Tensor, " q"] | None = None,
) -> Float[Tensor, "t q d"]:
    """Oracle: every body keeps the shape of the last given frame and follows its true centroid [m].

    Centroids are those of the particles that are not kinematic.

    Args:
        state: The given frames.
        truth: True positions at the frames to come [m].
        body: Number of the body of each particle; by default all are one.
    """
    body = torch.zeros_like(state.particle_type) if body is None else body
    free = (~state.kinematic).to(truth.dtype)
    count = free.new_zeros(int(body.max()) + 1).index_add(0, body, free).clamp_min(1.0)

    def centroids(position: Tensor) -> Tensor:
        weighted = position * free[:, None]
        total = weighted.new_zeros(len(weighted), len(count), weighted.shape[2])
        return total.index_add(1, body, weighted) / count[:, None]

    way = centroids(truth) - centroids(state.position[None])
    return _held(state.position + way[:, body], state, truth)


def _ballistic(state: SparseState, frames: int, gravity: Tensor) -> Float[Tensor, "t q d"]:
    step = torch.arange(1, frames + 1).to(state.position)[:, None, None]
    time = step * state.frame_dt
    fall = 0.5 * gravity * time * (time + state.frame_dt)
    position = state.position + state.velocity * time + fall
    return torch.clamp(position, state.bounds[:, 0], state.bounds[:, 1])


def _held(
    position: Float[Tensor, "t q d"],
    state: SparseState,
    prescribed: Float[Tensor, "t q d"] | None,
) -> Float[Tensor, "t q d"]:
    """Put the kinematic particles where the scene has them."""
    known = state.position if prescribed is None else prescribed
    return torch.where(state.kinematic[:, None], known, position)
