"""How a motion is shown: camera, colour range, sphere size, shared by all panels of a picture.

A picture compares motions, so that nothing in it may depend on the panel: one camera (parallel
projection, axis 1 up, fitted to all frames of all motions), one colour range. The spheres of a
panel have the spacing of its own particles. Lengths are metres; a 2-D motion lies in z = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import Trajectory

__all__ = ["Scene", "displacement", "frame_scene", "in_space", "particle_diameter"]

VIEW_DIRECTION = {2: (0.0, 0.0, 1.0), 3: (0.55, 0.42, 1.0)}
"""From the body towards the camera, by dimension."""

DIAMETER_PER_SPACING = 1.3
"""Spheres overlap a little, so that a filled body looks filled."""

MARGIN = 1.08
"""Free room around the motion."""

SPACING_SAMPLES = 2000
"""Particles whose nearest neighbour is measured; the median needs no more."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One camera and one colour range for all panels."""

    center: tuple[float, float, float]
    """Point in the middle of the panel [m]."""

    direction: tuple[float, float, float]
    """Unit vector from the centre to the camera."""

    half_width: float
    """Half of the width to be seen [m]."""

    half_height: float
    """Half of the height to be seen [m]."""

    depth: float
    """Distance from the centre that clears everything drawn [m]."""

    color_limit: float
    """Displacement at the upper end of the colour scale [m]."""

    def parallel_scale(self, *, aspect: float) -> float:
        """Half of the height of a panel that shows everything.

        Args:
            aspect: Width over height of the panel.

        Returns:
            The half height [m].
        """
        return MARGIN * max(self.half_height, self.half_width / aspect)


def frame_scene(trajectories: Sequence[Trajectory]) -> Scene:
    """Fit the camera and the colour range to every frame of every motion.

    Args:
        trajectories: The motions of a picture, all of one dimension.

    Returns:
        The scene.

    Raises:
        ValueError: If the motions differ in dimension or number of frames.
    """
    shapes = {(t.frame_count, t.position.shape[2]) for t in trajectories}
    if len(shapes) != 1:
        raise ValueError(
            f"motions shown side by side must agree in frames and dimension, got "
            f"{sorted(shapes)}. Cut them to the same frames."
        )
    dimension = trajectories[0].position.shape[2]
    direction = _unit(np.array(VIEW_DIRECTION[dimension]))
    right = _unit(np.cross([0.0, 1.0, 0.0], direction))
    up = np.cross(direction, right)
    points = np.concatenate([_extremes(t) for t in trajectories])
    along = np.stack([points @ axis for axis in (right, up, direction)], axis=1)
    low, high = along.min(axis=0), along.max(axis=0)
    room = 0.5 * max(particle_diameter(t) for t in trajectories)
    middle = (low + high) / 2
    return Scene(
        center=_triple(middle[0] * right + middle[1] * up + middle[2] * direction),
        direction=_triple(direction),
        half_width=float(high[0] - low[0]) / 2 + room,
        half_height=float(high[1] - low[1]) / 2 + room,
        depth=2.0 * float(np.linalg.norm(high - low)) + 1.0,
        color_limit=max(_largest_displacement(t) for t in trajectories),
    )


def in_space(position: Float[Tensor, "p d"]) -> np.ndarray:
    """Positions as points of space.

    Args:
        position: Positions in 2-D or 3-D [m].

    Returns:
        Float32 array of shape (p, 3); z = 0 for a 2-D motion.
    """
    points = np.zeros((position.shape[0], 3), dtype=np.float32)
    points[:, : position.shape[1]] = position.detach().cpu().numpy()
    return points


def displacement(trajectory: Trajectory, frame: int) -> Float[Tensor, " p"]:
    """How far each particle has moved since the first frame.

    Args:
        trajectory: The motion.
        frame: Number of the frame.

    Returns:
        Distances [m].
    """
    return (trajectory.position[frame] - trajectory.position[0]).norm(dim=1)


def particle_diameter(trajectory: Trajectory) -> float:
    """Diameter of the spheres that stand for the particles.

    Args:
        trajectory: The motion.

    Returns:
        The diameter [m], from the median distance to the nearest neighbour in the first frame.
    """
    from scipy.spatial import cKDTree

    points = in_space(trajectory.position[0])
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if len(points) < 2 or extent == 0.0:
        return 0.02 * float((trajectory.bounds[:, 1] - trajectory.bounds[:, 0]).max())
    stride = max(1, len(points) // SPACING_SAMPLES)
    distance, _ = cKDTree(points).query(points[::stride], k=2)
    spacing = float(np.median(distance[:, 1]))
    return DIAMETER_PER_SPACING * (spacing if spacing > 0.0 else 0.01 * extent)


def _extremes(trajectory: Trajectory) -> np.ndarray:
    """Corners of the box around every frame, and of the floor under it, shape (corners, 3)."""
    low = trajectory.position.amin(dim=(0, 1))
    high = trajectory.position.amax(dim=(0, 1))
    ends = in_space(torch.stack([low, high])).T
    return np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 3)


def _largest_displacement(trajectory: Trajectory) -> float:
    """Largest displacement of a free particle over all frames [m], never zero."""
    free = trajectory.position[:, ~trajectory.kinematic]
    if free.shape[1] == 0:
        return 1.0
    largest = max(float((frame - free[0]).norm(dim=1).max()) for frame in free)
    return largest if largest > 0.0 else 1.0


def _unit(vector: np.ndarray) -> np.ndarray:
    """The vector at length one."""
    return vector / np.linalg.norm(vector)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    """Three plain numbers."""
    return (float(vector[0]), float(vector[1]), float(vector[2]))
