"""Who is near whom: samples around query points, and the bodies both belong to.

Samples of another body are no neighbours: bodies that start side by side go different ways.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from giorom.graph import component_labels, nearest_distances

SAME_BODY = 3.0
"""Largest gap within a body, in units of the median distance to the nearest point. Uniformly random
points hang together from 2.6 in the plane."""

APART = 1e6
"""Distance put between bodies, in units of the extent of all points."""

PAIRS_AT_ONCE = 1 << 24
"""Most distances held in memory by the search on an accelerator."""


def body_labels(
    reference: Float[Tensor, "q d"], query: Float[Tensor, "p d"], *, least: int
) -> tuple[Int[Tensor, " q"], Int[Tensor, " p"]]:
    """Which body each sample and each query point is part of.

    Bodies are the connected components of all points together, with gaps up to ``SAME_BODY``
    median distances to the nearest point. A component with fewer samples than ``least`` cannot
    speak for itself: its points join the component of the nearest sample that can.

    Args:
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the query points [m].
        least: Fewest samples of a body.

    Returns:
        Labels of the samples and of the query points.
    """
    points = torch.cat([reference, query]).detach().cpu().double().numpy()
    places = np.unique(points, axis=0)
    labels = np.zeros(len(points), np.int64)
    if len(places) > 1:
        radius = SAME_BODY * float(np.median(nearest_distances(places)))
        labels = component_labels(torch.from_numpy(points), radius).numpy()
    count = len(reference)
    speaks = np.bincount(labels[:count], minlength=labels.max() + 1) >= least
    able = np.flatnonzero(speaks[labels[:count]])
    mute = np.flatnonzero(~speaks[labels])
    if len(able) == 0:
        labels[:] = 0
    elif len(mute):
        _, nearest = cKDTree(points[able]).query(points[mute])
        labels[mute] = labels[able[nearest]]
    both = torch.from_numpy(labels).to(reference.device)
    return both[:count], both[count:]


def nearest_samples(
    sample: Float[Tensor, "q d"],
    query: Float[Tensor, "p d"],
    *,
    count: int,
    labels: tuple[Int[Tensor, " q"], Int[Tensor, " p"]],
) -> tuple[Int[Tensor, "p k"], Bool[Tensor, "p k"]]:
    """The nearest samples of the same body around every query point.

    Args:
        sample: Positions of the samples [m].
        query: Positions of the query points [m].
        count: Wanted number k of neighbours; fewer if there are fewer samples.
        labels: Body of each sample and of each query point.

    Returns:
        Rows of the samples, nearest first, and which of them are of the same body.
    """
    everything = torch.cat([sample, query])
    extent = float((everything.amax(dim=0) - everything.amin(dim=0)).norm()) or 1.0
    far = APART * extent
    # One more axis keeps bodies apart, so that one search serves all of them.
    near = [
        torch.cat([points.detach().double(), far * label[:, None].double()], dim=1)
        for points, label in zip((sample, query), labels, strict=True)
    ]
    count = min(count, len(sample))
    search = _by_tree if sample.device.type == "cpu" else _by_distances
    found = search(*near, count)
    return found, labels[0][found] == labels[1][:, None]


def sample_spacing(sample: Float[Tensor, "q d"]) -> float:
    """Median distance of a sample to the nearest other one [m]."""
    points = np.unique(sample.detach().cpu().double().numpy(), axis=0)
    return float(np.median(nearest_distances(points))) if len(points) > 1 else 1.0


def _by_tree(sample: Tensor, query: Tensor, count: int) -> Tensor:
    _, found = cKDTree(sample.numpy()).query(query.numpy(), k=range(1, count + 1))
    return torch.from_numpy(found)


def _by_distances(sample: Tensor, query: Tensor, count: int) -> Tensor:
    rows = max(1, PAIRS_AT_ONCE // len(sample))
    parts = [
        (part[:, None] - sample[None]).square().sum(dim=2).topk(count, largest=False).indices
        for part in query.split(rows)
    ]
    return torch.cat(parts)
