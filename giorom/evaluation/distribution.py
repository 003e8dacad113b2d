"""Distances between two clouds of points that do not ask which particle is where.

Chaotic motions part from each other particle by particle long before the shape of the whole does.
All functions are symmetric in their two clouds, zero on any renumbering of the same cloud, and
deterministic: nothing is drawn at random.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

DENSITY_CELLS = {2: 16, 3: 8}
"""Cells per axis of the histogram of ``density_difference``, by dimension."""

PLANAR_DIRECTIONS = 16
"""Directions of the sliced distance in the plane."""


def chamfer_distance(first: Float[Tensor, "p d"], second: Float[Tensor, "k d"]) -> float:
    """Mean squared distance to the nearest point of the other cloud, both ways added [m^2].

    All points of both clouds count: no subset is drawn.
    """
    one, two = (cloud.detach().cpu().double().numpy() for cloud in (first, second))
    there, back = cKDTree(two).query(one)[0], cKDTree(one).query(two)[0]
    return float(np.square(there).mean() + np.square(back).mean())


def density_difference(
    first: Float[Tensor, "p d"], second: Float[Tensor, "k d"], *, bounds: Float[Tensor, "d 2"]
) -> float:
    """Share of the material that lies in another cell of a coarse grid: 0 the same, 1 disjoint.

    Half the sum of the absolute differences of two histograms over ``DENSITY_CELLS`` cells per axis
    of the domain; points beyond a wall count in the cell next to it.
    """
    cells = DENSITY_CELLS[first.shape[1]]
    low, high = bounds.double().cpu().unbind(dim=1)

    def histogram(cloud: Tensor) -> Tensor:
        place = (cloud.detach().cpu().double() - low) / (high - low) * cells
        index = place.floor().long().clamp(0, cells - 1)
        number = index[:, 0]
        for axis in range(1, cloud.shape[1]):
            number = number * cells + index[:, axis]
        counts = torch.bincount(number, minlength=cells ** cloud.shape[1])
        return counts.double() / len(cloud)

    return float(0.5 * (histogram(first) - histogram(second)).abs().sum())


def sliced_wasserstein(first: Float[Tensor, "p d"], second: Float[Tensor, "k d"]) -> float:
    r"""Squared 2-Wasserstein distance of the projections on a line, mean over directions [m^2].

    .. math::
        \frac{1}{L} \sum_l \frac{1}{p} \sum_i
        \left( (n_l \cdot x)_{(i)} - (n_l \cdot y)_{(i)} \right)^2

    with the sorted projections of both clouds. A shift by s gives exactly ``|s|^2 / d``: the
    directions are spherical designs.

    Raises:
        ValueError: If the clouds have different numbers of points.

    Source:
        Rabin et al., "Wasserstein barycenter and its application to texture mixing", 2011.
    """
    if len(first) != len(second):
        raise ValueError(
            f"sorted projections are compared one by one, which needs clouds of equal size; got "
            f"{len(first)} and {len(second)} points. Compare the same points in both."
        )
    directions = _directions(first.shape[1])
    one, two = (
        (cloud.detach().cpu().double() @ directions).sort(dim=0).values for cloud in (first, second)
    )
    return float((one - two).square().mean())


def _directions(dimension: int) -> Float[Tensor, "d l"]:
    """Unit vectors whose mean outer product is the identity over ``dimension``."""
    if dimension == 2:
        angle = torch.arange(PLANAR_DIRECTIONS, dtype=torch.float64) * math.pi / PLANAR_DIRECTIONS
        return torch.stack([angle.cos(), angle.sin()])
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    icosahedron = [
        np.roll((0.0, 1.0, sign * golden), shift) for sign in (1.0, -1.0) for shift in range(3)
    ]
    dodecahedron = [
        np.roll((0.0, 1.0 / golden, sign * golden), shift)
        for sign in (1.0, -1.0)
        for shift in range(3)
    ]
    cube = [(1.0, a, b) for a in (1.0, -1.0) for b in (1.0, -1.0)]
    vectors = torch.from_numpy(np.array([*icosahedron, *dodecahedron, *cube]))
    return (vectors / vectors.norm(dim=1, keepdim=True)).T
