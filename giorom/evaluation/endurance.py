"""Roll many scenes out for a long time and find those that are lost.

A scene is lost at the first frame at which a position is not finite or a sample lies beyond a wall
by more than the tolerance. It is then taken out of the batch; the others go on, so that one that
fails costs the others nothing.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.evaluation.rollout import select_scenes
from giorom.pipeline import Connect, Step, rollout
from giorom.state import SparseState


@dataclass(kw_only=True)
class Fate:
    """What became of one scene."""

    scene: int
    """Its number in the batch."""

    lost_at: int | None = None
    """Frame at which it was lost; none if it lasted."""

    reason: str | None = None
    """``not finite`` or ``beyond a wall``."""

    excursion: float = 0.0
    """Farthest that a sample has been beyond a wall, the frame of its loss included [m]."""


def endure(
    state: SparseState, frames: int, *, connect: Connect, step: Step, tolerance: float
) -> list[Fate]:
    """Roll a batch of scenes out and say what became of each.

    Args:
        state: The scenes side by side; kinematic samples stay where they are.
        frames: Number of frames.
        connect: Stage 3.
        step: Stages 4 and 5.
        tolerance: How far beyond a wall a sample may be [m].
    """
    fates = [Fate(scene=scene) for scene in range(state.batch_size)]
    alive, done = list(fates), 0
    while alive and done < frames:
        lost: list[int] = []
        reason, frame = "beyond a wall", 0
        try:
            for later in rollout(state, frames - done, connect=connect, step=step):
                state, done = later, done + 1
                frame = done
                beyond = beyond_walls(state).tolist()
                for fate, excursion in zip(alive, beyond, strict=True):
                    fate.excursion = max(fate.excursion, excursion)
                lost = [index for index, value in enumerate(beyond) if value > tolerance]
                if lost:
                    break
        except FloatingPointError:
            lost = _not_finite_next(state, connect=connect, step=step)
            reason, frame = "not finite", done + 1  # the others have that frame before them
        for index in lost:
            alive[index].lost_at, alive[index].reason = frame, reason
        kept = [index for index in range(len(alive)) if index not in lost]
        alive = [alive[index] for index in kept]
        state = select_scenes(state, kept) if kept else state
    return fates


def beyond_walls(state: SparseState) -> Float[Tensor, " b"]:
    """Farthest that a sample of each scene lies beyond a wall [m]; zero if all are inside."""
    low, high = state.bounds.unbind(dim=1)
    outside = torch.maximum(low - state.position, state.position - high).amax(dim=1).clamp_min(0.0)
    worst = outside.new_zeros(state.batch_size)
    return worst.scatter_reduce(0, state.batch, outside, reduce="amax")


def _not_finite_next(state: SparseState, *, connect: Connect, step: Step) -> list[int]:
    """Which scenes are not finite one frame on; all, if none is when stepped alone."""
    found = []
    for scene in range(state.batch_size):
        try:
            list(rollout(select_scenes(state, [scene]), 1, connect=connect, step=step))
        except FloatingPointError:
            found.append(scene)
    return found or list(range(state.batch_size))
