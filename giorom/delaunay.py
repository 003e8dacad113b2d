"""Who is joined to whom in the Delaunay triangulation of one scene.

Stage 3 of the pipeline; ``graph.py`` makes edges of these pairs. Pure geometry: any unit.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, QhullError


def delaunay_pairs(points: Float[np.ndarray, "q d"], *, official: bool) -> Int[np.ndarray, "e 2"]:
    """Pairs of points that share a simplex, the lower number first.

    A point that lies on another one is no corner of a simplex; it is joined to the corner beside
    it. Fewer points than two simplices have are all joined.

    Args:
        points: Positions of one scene.
        official: Keep the pairs among the first three corners of each simplex alone.

    Raises:
        ValueError: If all points lie in a plane (in 2-D on a line).
    """
    simplices, twins = _triangulation(points)
    corners = simplices[:, :3] if official else simplices
    pairs = [np.zeros((0, 2), np.int64) if official else twins]
    pairs += [corners[:, list(two)] for two in combinations(range(corners.shape[1]), 2)]
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def _triangulation(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simplices (s k), and pairs of a point that is no corner with one that is."""
    count, dimension = points.shape
    if count <= dimension + 1:
        return np.arange(count)[None], np.zeros((0, 2), np.int64)
    try:
        found = Delaunay(points)
    except QhullError:
        raise ValueError(
            f"{count} particles of a scene lie in a {'plane' if dimension == 3 else 'line'}, or "
            f"nearly so, and have no Delaunay triangulation. Set graph.kind to radius."
        ) from None
    return found.simplices.astype(np.int64), found.coplanar[:, [0, 2]].astype(np.int64)
