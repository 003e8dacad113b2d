"""Suggest how many particles to simulate and how far they should see.

The rule: a twentieth of the particles, but at least 200 and at most 2,000, by farthest point
sampling of the first frame, and the radius at which their graph is as connected as that of all
particles (``giorom.graph.choose_radius``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from giorom.data.measure import Beginning
from giorom.graph import GraphConfig, choose_radius
from giorom.sampling import sample_farthest

__all__ = ["Suggestion", "suggest"]

REDUCTION, FEWEST, MOST = 20, 200, 2000
"""Particles per sample, and the limits of the number of samples."""


@dataclass(frozen=True, kw_only=True)
class Suggestion:
    """Number of samples and graph radius that fit some data."""

    sparse_points: int
    """Number of samples of the largest of the bodies looked at."""

    radius: float | None
    """Graph radius [m]; None where the particles do not determine one."""

    neighbors: Int[np.ndarray, " n"]
    """Neighbours of each sample at that radius, itself not counted."""

    text: str
    """The reason, in one sentence."""


def suggest(beginnings: Sequence[Beginning]) -> Suggestion:
    """Suggest samples and radius from the first frames of some bodies.

    Args:
        beginnings: Their positions; a radius must do for all of them.
    """
    counts, samples, radii = [], [], []
    beginnings = [beginning for beginning in beginnings if len(beginning.position)]
    for beginning in beginnings:
        position = torch.from_numpy(beginning.position)
        wanted = min(MOST, max(FEWEST, round(beginning.particles / REDUCTION)))
        counts.append(min(wanted, len(position)))
        samples.append(position[sample_farthest(position, counts[-1])])
        radii.append(_radius(samples[-1], position))
    known = [radius for radius in radii if radius]
    if not known:
        text = "the particles lie at too few places to tell a radius."
        count = max(counts, default=0)
        return Suggestion(
            sparse_points=count, radius=None, neighbors=np.zeros(0, np.int64), text=text
        )
    radius = max(known)
    thinned = sum(len(b.position) < b.particles for b in beginnings)
    text = (
        f"from the first frames of {len(beginnings)} trajectories"
        + (
            f", {thinned} of them seen through {len(beginnings[0].position)} particles"
            * (thinned > 0)
        )
        + f"; margin {GraphConfig().margin:g} on the connectivity of all particles"
    )
    neighbors = [neighbor_counts(points.numpy(), radius) for points in samples]
    return Suggestion(
        sparse_points=max(counts), radius=radius, neighbors=np.concatenate(neighbors), text=text
    )


def neighbor_counts(position: Float[np.ndarray, "q d"], radius: float) -> Int[np.ndarray, " q"]:
    """Number of other particles within ``radius`` of each [m]."""
    tree = cKDTree(position)
    found = tree.query_ball_point(position, radius, return_length=True)
    return np.asarray(found, np.int64) - 1


def _radius(samples: torch.Tensor, full: torch.Tensor) -> float | None:
    """The radius one body asks for, if it determines one [m]."""
    if len(full) < 2:
        return None
    return choose_radius(samples, full, margin=GraphConfig().margin).radius or None
