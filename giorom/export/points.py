"""What the point-file writers share: points in space and the numbers carried by each point."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import Trajectory

__all__ = ["point_fields", "speed"]

RESERVED = ("x", "y", "z", "speed", "particle_type")


def speed(trajectory: Trajectory) -> Float[Tensor, "t p"]:
    """Speed of each particle over the step that ends at each frame.

    Args:
        trajectory: The motion.

    Returns:
        Speeds [m/s]; the first frame, which no step ends at, has those of the second.
    """
    if trajectory.frame_count < 2:
        return torch.zeros_like(trajectory.position[..., 0])
    steps = trajectory.position.diff(dim=0).norm(dim=2) / trajectory.frame_dt
    return torch.cat([steps[:1], steps])


def point_fields(
    trajectory: Trajectory, extra: Mapping[str, Float[Tensor, "t p"]] | None
) -> dict[str, np.ndarray]:
    """Numbers of each point at each frame: the speed, and what the caller adds.

    Args:
        trajectory: The motion.
        extra: More fields by name, such as the error of a prediction.

    Returns:
        Float32 arrays of shape (t, p) by name.

    Raises:
        ValueError: If a name is taken or a field has another shape.
    """
    shape = tuple(trajectory.position.shape[:2])
    fields = {"speed": speed(trajectory), **(extra or {})}
    for name, values in (extra or {}).items():
        if name in RESERVED:
            raise ValueError(f"the field name {name!r} is taken; choose another.")
        if tuple(values.shape) != shape:
            raise ValueError(
                f"field {name!r} has shape {tuple(values.shape)}; it must have one number per "
                f"frame and particle, {shape}."
            )
    return {
        name: values.detach().cpu().numpy().astype(np.float32) for name, values in fields.items()
    }
