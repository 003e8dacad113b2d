"""Predictions that need no model: what any surrogate has to beat.

All start from the same given frames as the model. Kinematic particles follow the scene.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import SparseState


def hold_still(state: SparseState, frames: int) -> Float[Tensor, "t q d"]:
    """The last given frame, for ever [m]."""
    return state.position.expand(frames, -1, -1)


def constant_velocity(state: SparseState, frames: int) -> Float[Tensor, "t q d"]:
    """Straight on with the last velocity, stopped at the walls [m]."""
    return _ballistic(state, frames, torch.zeros_like(state.bounds[:, 0]))


def free_fall(
    state: SparseState, frames: int, *, gravity: Float[Tensor, " d"]
) -> Float[Tensor, "t q d"]:
    """Semi-implicit Euler under gravity alone, stopped at the walls [m]."""
    return _ballistic(state, frames, gravity)


def _ballistic(state: SparseState, frames: int, gravity: Tensor) -> Float[Tensor, "t q d"]:
    step = torch.arange(1, frames + 1, dtype=state.position.dtype, device=state.position.device)
    time = step[:, None, None] * state.frame_dt
    fall = 0.5 * gravity * time * (time + state.frame_dt)
    position = state.position + state.velocity * time + fall
    position = torch.clamp(position, state.bounds[:, 0], state.bounds[:, 1])
    return torch.where(state.kinematic[:, None], state.position, position)
