"""Roll a trained model out and keep what it did, even where it diverged."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.pipeline import Connect, Step, rollout
from giorom.state import SparseState


@dataclass(frozen=True, kw_only=True)
class SparseRollout:
    """Positions of the samples after each frame."""

    position: Float[Tensor, "t q d"]
    """Positions [m]; after a divergence the last finite ones are repeated."""

    diverged_at: int | None
    """First frame that was not finite or lay far outside the walls, if any."""


def roll_out(
    state: SparseState,
    frames: int,
    *,
    connect: Connect,
    step: Step,
    prescribed: Float[Tensor, "t q d"] | None = None,
) -> SparseRollout:
    """Positions of the samples for ``frames`` frames; never raises on divergence.

    Kinematic samples follow ``prescribed``, as in ``giorom.pipeline.rollout``. A sample further
    outside the walls than the domain is wide counts as diverged: left alone it would overflow a
    few frames later.
    """
    extent = state.bounds[:, 1] - state.bounds[:, 0]
    low, high = state.bounds[:, 0] - extent, state.bounds[:, 1] + extent
    positions = []
    try:
        for later in rollout(state, frames, connect=connect, step=step, prescribed=prescribed):
            if bool(((later.position < low) | (later.position > high)).any()):
                break
            positions.append(later.position)
    except FloatingPointError:
        pass
    diverged_at = None if len(positions) == frames else len(positions) + 1
    last = positions[-1] if positions else state.position
    positions += [last] * (frames - len(positions))
    return SparseRollout(position=torch.stack(positions), diverged_at=diverged_at)


def single_scene(state: SparseState, scene: int) -> SparseState:
    """One scene of a batch."""
    member = state.batch == scene
    return replace(
        state,
        history=state.history[member],
        reference=state.reference[member],
        particle_type=state.particle_type[member],
        batch=torch.zeros(int(member.sum()), dtype=torch.long, device=state.batch.device),
        batch_size=1,
        weight=None if state.weight is None else state.weight[member],
        memory=None if state.memory is None else state.memory[member],
    )
