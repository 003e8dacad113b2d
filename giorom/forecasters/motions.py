"""Training motions as tables: places, states and times, in the units of the networks.

A state is the displacement from the undeformed body and the step since the frame before, both in
units of their own root mean square, so that one frame says where the material goes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class Motions:
    """Some points of some frames of every training motion."""

    point: Float[Tensor, "m p d"]
    """Undeformed positions [m]."""

    state: Float[Tensor, "m t p s"]
    """Displacements [m], then steps since the frame before [m]."""

    frame: Float[Tensor, " t"]
    """Numbers of the frames."""

    @property
    def stride(self) -> float:
        """Frames between two stored ones, on average."""
        return float((self.frame[-1] - self.frame[0]) / max(1, len(self.frame) - 1))


def gather_motions(
    trajectories: list[Trajectory], *, first: int, points: int, frames: int, seed: int
) -> Motions:
    """Random points and evenly spaced frames of every motion.

    Args:
        trajectories: Motions; the first frame is the undeformed body.
        first: First frame that is stored, at least one; where forecasts will begin.
        points: Most points; fewer if some body has fewer.
        frames: Most frames; fewer if some motion is shorter.
        seed: Seed of the draw.

    Raises:
        ValueError: If some motion has no two frames from ``first`` on.
    """
    last = min(t.frame_count for t in trajectories) - 1
    if not 1 <= first < last:
        raise ValueError(
            f"a motion of {last + 1} frames has no two frames from frame {first} on. Use longer "
            f"motions."
        )
    generator = torch.Generator().manual_seed(seed)
    count = min(points, *(t.position.shape[1] for t in trajectories))
    frame = torch.linspace(first, last, frames).round().long().unique()
    places, states = [], []
    for trajectory in trajectories:
        chosen = torch.randperm(trajectory.position.shape[1], generator=generator)[:count]
        places.append(trajectory.position[0, chosen])
        states.append(states_at(trajectory.position, frame, chosen))
    return Motions(point=torch.stack(places), state=torch.stack(states), frame=frame.float())


def states_at(position: Tensor, frame: Tensor, chosen: Tensor) -> Float[Tensor, "t p s"]:
    """Displacement and step of some particles at some frames [m]."""
    now, before = position[frame][:, chosen], position[frame - 1][:, chosen]
    return torch.cat([now - position[0, chosen], now - before], dim=-1)
