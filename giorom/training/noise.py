"""Training noise: a random walk in the velocities, and the target that undoes it.

A model that is only ever shown the truth does not learn to correct its own errors. The noise
imitates them: velocity increments accumulate over the history, positions follow.

Source:
    Sanchez-Gonzalez et al., ICML 2020 (arXiv:2002.09405), section 4.2; used by
    arXiv:2407.03925v2, appendix F.
"""

import math
from dataclasses import replace

import torch

from giorom.state import SparseState


def add_random_walk(
    state: SparseState, noise_std: float, *, generator: torch.Generator
) -> SparseState:
    """Disturb the history of the free particles.

    Args:
        state: Clean state.
        noise_std: Standard deviation of the noise of the newest velocity, as displacement per
            frame [m].
        generator: Source of the noise.

    Returns:
        A new state. The oldest position is exact; the newest carries the sum of the noise of all
        velocities.
    """
    if noise_std == 0.0:
        return state
    velocities = state.history.shape[1] - 1
    shape = (state.history.shape[0], velocities, state.history.shape[2])
    step = torch.randn(shape, generator=generator).to(state.history) * (
        noise_std / math.sqrt(velocities)
    )
    offset = step.cumsum(dim=1).cumsum(dim=1)
    offset = offset.masked_fill(state.kinematic[:, None, None], 0.0)
    history = torch.cat([state.history[:, :1], state.history[:, 1:] + offset], dim=1)
    return replace(state, history=history)
