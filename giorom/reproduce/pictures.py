"""Clouds of points in the box of a scene, for the figures."""

from typing import Any

import numpy as np

TRUE, PREDICTED, LINE, WALL = "#1f3b73", "#c1440e", "#9a9a9a", "#202020"
"""Colours of the solver's points, of a model's, of edges and of walls."""

MARGIN = 0.12
"""Space around the walls [m], in which points that have left the domain are still seen."""


def draw_cloud(
    axes: Any,
    points: Any,
    *,
    bounds: Any,
    title: str = "",
    pairs: Any = None,
    color: str = PREDICTED,
    size: float = 4.0,
) -> None:
    """Draw a plane cloud and its walls, at equal scales, and the edges of its graph.

    What lies far outside the walls is counted, not drawn.

    Args:
        axes: Axes of matplotlib.
        points: Positions (q 2) [m].
        bounds: Walls (2 2) [m].
        title: What is shown.
        pairs: Joined points (e 2).
        color: Of the points.
        size: Of a point, in square points of the page.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    cloud, walls = np.asarray(points, dtype=float), np.asarray(bounds, dtype=float)
    if pairs is not None and len(pairs):
        lines = cloud[np.asarray(pairs)]
        axes.add_collection(LineCollection(lines, colors=LINE, linewidths=0.3, zorder=1))
    axes.scatter(cloud[:, 0], cloud[:, 1], s=size, color=color, linewidths=0, zorder=2)
    (left, right), (bottom, top) = walls
    corner, width, height = (left, bottom), right - left, top - bottom
    axes.add_patch(Rectangle(corner, width, height, fill=False, color=WALL, linewidth=1.0))
    axes.set_xlim(left - MARGIN, right + MARGIN)
    axes.set_ylim(bottom - MARGIN, top + MARGIN)
    beyond = outside(cloud, walls)
    if beyond:
        place = {"x": 0.5, "y": 0.5, "transform": axes.transAxes, "ha": "center", "fontsize": 7}
        axes.text(s=f"{beyond} of {len(cloud)} outside", **place)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)
    axes.set_title(title, fontsize=8)


def outside(cloud: np.ndarray, walls: np.ndarray) -> int:
    """Points farther than ``MARGIN`` beyond a wall."""
    return int(((cloud < walls[:, 0] - MARGIN) | (cloud > walls[:, 1] + MARGIN)).any(axis=1).sum())


def draw_space(axes: Any, points: Any, *, bounds: Any, title: str = "", size: float = 5.0) -> None:
    """Draw a cloud in space within its walls, at equal scales, coloured by depth.

    Args:
        axes: Axes of matplotlib with three dimensions.
        points: Positions (q 3), axis 1 up [m].
        bounds: Walls (3 2) [m].
        title: What is shown.
        size: Of a point, in square points of the page.
    """
    cloud, walls = np.asarray(points, dtype=float), np.asarray(bounds, dtype=float)
    order = [0, 2, 1]  # matplotlib's third axis points up
    cloud, walls = cloud[:, order], walls[order]
    beyond = outside(cloud, walls)
    if beyond:
        title += f"\n{beyond} of {len(cloud)} outside"
    axes.scatter(*cloud.T, c=cloud[:, 1], cmap="viridis_r", s=size, linewidths=0, depthshade=False)
    low, high = walls.T
    for axis in range(3):
        for first in (0, 1):
            for second in (0, 1):
                start, stop = low.copy(), high.copy()
                others = [other for other in range(3) if other != axis]
                for other, side in zip(others, (first, second), strict=True):
                    start[other] = stop[other] = walls[other, side]
                axes.plot(*np.stack([start, stop], axis=1), color=WALL, linewidth=0.4)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(high - low)
    axes.view_init(elev=18, azim=-62)
    axes.set_axis_off()
    axes.set_title(title, fontsize=8)
