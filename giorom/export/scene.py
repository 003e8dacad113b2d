"""How a motion is shown: camera, colour range, sphere size, shared by all panels of a picture.

A picture compares motions, so that nothing in it may depend on the panel: one camera (parallel
projection, axis 1 up, fitted to all frames of all motions), one colour range. The spheres of a
panel have the spacing of its own particles. Lengths are metres; a 2-D motion lies in z = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from giorom.state import Trajectory

__all__ = [
    "Scene",
    "diameter_from_spacing",
    "displacement",
    "frame_scene",
    "in_space",
    "particle_diameter",
]

VIEW_DIRECTION = {2: (0.0, 0.0, 1.0), 3: (0.55, 0.42, 1.0)}
"""From the body towards the camera, by dimension."""

DIAMETER_PER_SPACING = 1.2
"""Spheres overlap a little, so that a filled body looks filled."""

MARGIN = 1.08
"""Free room around the motion."""

HEADING = 0.08
"""Share of a panel's height kept free for its heading."""

NICE = (1.0, 1.2, 1.6, 2.0, 2.4, 3.2, 4.0, 6.0, 8.0, 10.0)
"""Ends of a colour scale whose quarters are short numbers."""

FLOOR_REACH = 0.6
"""The floor is shown if it lies nearer below the motion than this share of the motion's height."""

FLOOR_BORDER = 0.07
"""Floor shown around the motion, as a share of the motion's width."""

SPACING_SAMPLES = 2000
"""Particles whose spacing is measured; the median needs no more."""


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

    floor: tuple[tuple[float, float, float], ...] | None
    """Corners of the visible floor (3-D) or of the domain (2-D) [m], in order; None if far off."""

    color_limit: float
    """Displacement at the upper end of the colour scale [m]."""

    def camera(self, *, aspect: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Camera of a panel, leaving the heading's share of its height free.

        Args:
            aspect: Width over height of the panel.

        Returns:
            Where the camera looks [m], where it stands [m], and half of the height it sees [m].
        """
        room = 1.0 - HEADING
        scale = MARGIN * max(self.half_height, self.half_width * room / aspect) / room
        direction = np.array(self.direction)
        _, up = _screen_axes(direction)
        focus = np.array(self.center) + HEADING * scale * up
        return focus, focus + self.depth * direction, scale


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
    right, up = _screen_axes(direction)
    low, high = _extremes(trajectories)
    floor = _domain(low, high, trajectories[0])
    points = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    if floor is not None:
        points = np.concatenate([points, floor])
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
        floor=None if floor is None else tuple(_triple(corner) for corner in floor),
        color_limit=_round_up(max(_largest_displacement(t) for t in trajectories)),
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
    """Diameter of the spheres that stand for the particles of a motion.

    Args:
        trajectory: The motion.

    Returns:
        The diameter [m], from the spacing of its first frame.
    """
    return diameter_from_spacing(
        trajectory.position[0], kinematic=trajectory.kinematic, bounds=trajectory.bounds
    )


def diameter_from_spacing(
    position: Float[Tensor, "p d"], *, kinematic: Bool[Tensor, " p"], bounds: Float[Tensor, "d 2"]
) -> float:
    """Diameter of the spheres that stand for particles.

    Args:
        position: Positions [m].
        kinematic: Which particles are prescribed; the others are measured if there are two.
        bounds: Walls [m]; they give a size where all particles are in one place.

    Returns:
        The diameter [m], from the spacing of the free particles: the median distance to the
        2 d-th neighbour, which on a regular grid is the spacing and for random points nearly so
        (1.1 in units of volume^(1/d)), where the nearest one is half as far.
    """
    from scipy.spatial import cKDTree

    free = position[~kinematic]
    points = in_space(free if len(free) > 1 else position)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if extent == 0.0:
        return 0.02 * float((bounds[:, 1] - bounds[:, 0]).max())
    rank = min(2 * position.shape[1] + 1, len(points))
    stride = max(1, len(points) // SPACING_SAMPLES)
    distance, _ = cKDTree(points).query(points[::stride], k=[rank])
    spacing = float(np.median(distance))
    return DIAMETER_PER_SPACING * (spacing if spacing > 0.0 else 0.01 * extent)


def _extremes(trajectories: Sequence[Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    """Opposite corners of the box around every frame of every motion."""
    frames = [frame for trajectory in trajectories for frame in trajectory.position]
    low = torch.stack([frame.amin(dim=0) for frame in frames]).amin(dim=0)
    high = torch.stack([frame.amax(dim=0) for frame in frames]).amax(dim=0)
    ends = in_space(torch.stack([low, high]))
    return ends[0], ends[1]


def _domain(low: np.ndarray, high: np.ndarray, trajectory: Trajectory) -> np.ndarray | None:
    """Corners of the floor under a 3-D motion, or of the whole 2-D domain, shape (4, 3)."""
    wall = in_space(trajectory.bounds.T)
    if trajectory.position.shape[2] == 2:
        (left, bottom, _), (right, top, _) = wall
        return np.array([[left, bottom, 0], [right, bottom, 0], [right, top, 0], [left, top, 0]])
    if low[1] - wall[0, 1] > FLOOR_REACH * (high[1] - low[1]):
        return None
    border = FLOOR_BORDER * float((high - low)[[0, 2]].max())
    left, _, back = np.maximum(low - border, wall[0])
    right, _, front = np.minimum(high + border, wall[1])
    height = wall[0, 1]
    rectangle = ((left, back), (right, back), (right, front), (left, front))
    return np.array([[x, height, z] for x, z in rectangle])


def _largest_displacement(trajectory: Trajectory) -> float:
    """Largest displacement of a free particle over all frames [m], never zero."""
    free = ~trajectory.kinematic
    if not bool(free.any()):
        return 1.0
    frames = range(trajectory.frame_count)
    largest = max(float(displacement(trajectory, frame)[free].max()) for frame in frames)
    return largest if largest > 0.0 else 1.0


def _round_up(value: float) -> float:
    """The next number that reads well on a scale of four steps."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(nice for nice in NICE if nice * power >= value * (1.0 - 1e-9)) * power)


def _screen_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up on a screen seen from ``direction``."""
    right = _unit(np.cross([0.0, 1.0, 0.0], direction))
    return right, np.cross(direction, right)


def _unit(vector: np.ndarray) -> np.ndarray:
    """The vector at length one."""
    return vector / np.linalg.norm(vector)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    """Three plain numbers."""
    return (float(vector[0]), float(vector[1]), float(vector[2]))
