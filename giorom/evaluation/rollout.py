"""Roll a trained model out and keep what it did, even where it diverged."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
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
    positions = []
    try:
        for later in rollout(state, frames, connect=connect, step=step, prescribed=prescribed):
            if bool(far_outside(later.position, later.bounds).any()):
                break
            positions.append(later.position)
    except FloatingPointError:
        pass
    diverged_at = None if len(positions) == frames else len(positions) + 1
    last = positions[-1] if positions else state.position
    positions += [last] * (frames - len(positions))
    return SparseRollout(position=torch.stack(positions), diverged_at=diverged_at)


def far_outside(
    position: Float[Tensor, "*n d"], bounds: Float[Tensor, "d 2"]
) -> Bool[Tensor, "*n"]:
    """Which points are further outside the walls than the domain is wide."""
    low, high = bounds.unbind(dim=1)
    extent = high - low
    return ((position < low - extent) | (position > high + extent)).any(dim=-1)


def single_scene(state: SparseState, scene: int) -> SparseState:
    """One scene of a batch."""
    return select_scenes(state, [scene])


def select_scenes(state: SparseState, scenes: list[int]) -> SparseState:
    """Some scenes of a batch, numbered anew.

    Args:
        state: The batch.
        scenes: Which, ascending.
    """
    kept = torch.tensor(scenes, dtype=torch.long, device=state.batch.device)
    member = torch.isin(state.batch, kept)

    def selected(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(value[scene] for scene in scenes)
        return None if value is None else value[member]

    parts = ("history", "reference", "particle_type", "weight", "bodies", "memory")
    return replace(
        state,
        batch=torch.searchsorted(kept, state.batch[member]),
        batch_size=len(scenes),
        **{name: selected(getattr(state, name)) for name in parts},
    )
