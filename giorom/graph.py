"""Connect the sampled particles: radius graphs, the radius itself, Delaunay graphs.

Stage 3 of the pipeline. An edge joins two particles of the same scene whose distance is at
most ``radius``; every edge has its reverse, every particle has a self-loop, and no particle
ever loses a neighbour to a cap. Delaunay graphs, which the paper tried, join the corners of
the simplices of a triangulation instead. The radius follows from connectivity: the sparse graph
must have as many connected components as the full-order one (arXiv:2407.03925v2, section 5.2),
which a minimum spanning tree answers in closed form.
"""

import math
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor

from giorom.delaunay import delaunay_pairs


@dataclass(frozen=True, kw_only=True)
class GraphConfig:
    """How the interaction graph is built."""

    kind: Literal["radius", "delaunay", "delaunay_official"] = "radius"
    """Neighbours within the radius, neighbours in the Delaunay triangulation, or what the official
    code keeps of the latter: three edges of each simplex, in one direction, without self-loops."""

    radius: float | None = None
    """Interaction radius [m]; null: chosen from the connected components of the training bodies. A
    Delaunay graph has it as unit of length alone."""

    margin: float = 1.5
    """Factor on the smallest radius that keeps the components of the full graph."""

    configuration: Literal["current", "reference"] = "current"
    """Positions that decide who is a neighbour: the current ones (the paper), or those of the
    undeformed body, whose graph never changes and suits solids that do not tear."""

    def __post_init__(self) -> None:
        """Reject values no graph can be built from."""
        if self.radius is not None and not self.radius > 0.0:
            raise ValueError(f"GraphConfig.radius must be > 0 m, got {self.radius!r}.")
        if not self.margin >= 1.0:
            raise ValueError(
                f"GraphConfig.margin must be >= 1, got {self.margin!r}: below one the sparse graph "
                f"falls apart."
            )


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Directed edges, grouped by receiver."""

    sender: Int[Tensor, " e"]
    """Particle each message comes from."""

    receiver: Int[Tensor, " e"]
    """Particle each message goes to, ascending."""

    offset: Int[Tensor, " q_plus_one"]
    """First edge of each receiver; one more entry than there are particles."""

    def to(self, device: torch.device | str) -> "Edges":
        """The same edges on ``device``."""
        return type(self)(
            sender=self.sender.to(device),
            receiver=self.receiver.to(device),
            offset=self.offset.to(device),
        )


@dataclass(frozen=True, kw_only=True)
class RadiusChoice:
    """A graph radius and the reason for it."""

    radius: float
    """Chosen radius [m]."""

    smallest: float
    """Smallest radius whose graph has the wanted number of components [m]."""

    margin: float
    """Factor between the two."""

    components: int
    """Connected components of the full-order graph."""

    full_radius: float
    """Radius of the full-order graph [m]."""

    mean_degree: float
    """Mean number of neighbours of a sampled particle at the chosen radius, itself excluded; NaN
    where the radius was given and not chosen."""

    def __str__(self) -> str:
        """One line for a log."""
        degree = "" if math.isnan(self.mean_degree) else f"; {self.mean_degree:.1f} neighbours each"
        return (
            f"graph radius {self.radius:.4f} m = {self.margin:.3g} x "
            f"{max(self.smallest, self.full_radius):.4f} m: {self.smallest:.4f} m is the smallest "
            f"that keeps the {self.components} component(s) of the full graph, whose "
            f"radius is {self.full_radius:.4f} m{degree}"
        )


def radius_edges(position: Float[Tensor, "q d"], batch: Int[Tensor, " q"], radius: float) -> Edges:
    """Connect all particles of the same scene that lie within ``radius``.

    Args:
        position: Positions [m].
        batch: Scene of each particle, ascending.
        radius: Largest distance of two neighbours [m].

    Returns:
        Edges in both directions with self-loops, sorted by receiver, then sender.

    Raises:
        ValueError: If ``radius`` is not positive or a position is not finite.
    """
    if not radius > 0.0:
        raise ValueError(f"radius must be > 0 m, got {radius!r}.")
    if not bool(torch.isfinite(position).all()):
        raise ValueError("positions must be finite, found NaN or infinity; no graph can be built.")
    if position.device.type == "cpu":
        sender, receiver = _pairs_by_tree(position, batch, radius)
    else:
        sender, receiver = _pairs_by_cells(position, batch, radius)
    return _sorted_edges(sender, receiver, position.shape[0])


def delaunay_edges(
    position: Float[Tensor, "q d"], batch: Int[Tensor, " q"], *, official: bool = False
) -> Edges:
    """Connect the corners of every simplex of the Delaunay triangulation of each scene.

    Args:
        position: Positions [m].
        batch: Scene of each particle, ascending.
        official: Keep what the official code keeps: the edges between the first three corners of a
            simplex, from the lower to the higher particle number, no self-loops.

    Returns:
        Edges sorted by receiver, then sender; both directions and self-loops unless ``official``.

    Raises:
        ValueError: If a position is not finite, or all particles of a scene lie in a plane (in 2-D
            on a line).

    Source:
        arXiv:2407.03925v2, Table 13 (Delaunay graphs).
    """
    if not bool(torch.isfinite(position).all()):
        raise ValueError("positions must be finite, found NaN or infinity; no graph can be built.")
    points, scene = position.detach().cpu().double().numpy(), batch.cpu().numpy()
    found = [] if official else [np.stack([np.arange(len(points))] * 2, axis=1)]
    for start, stop in _scene_ranges(scene):
        pairs = delaunay_pairs(points[start:stop], official=official) + start
        found += [pairs] if official else [pairs, pairs[:, ::-1]]
    pairs = torch.from_numpy(np.concatenate(found)).to(position.device)
    return _sorted_edges(pairs[:, 0], pairs[:, 1], len(points))


def connect_points(
    position: Float[Tensor, "q d"], batch: Int[Tensor, " q"], *, radius: float, kind: str
) -> Edges:
    """The graph of a ``GraphConfig.kind``; ``radius`` in metres counts for one of them."""
    if kind == "radius":
        return radius_edges(position, batch, radius)
    return delaunay_edges(position, batch, official=kind == "delaunay_official")


def concatenate_edges(edges: list[Edges]) -> Edges:
    """Put the graphs of several scenes side by side, in the order of the scenes."""
    shift = np.cumsum([0] + [len(e.offset) - 1 for e in edges])
    first_edge = np.cumsum([0] + [len(e.sender) for e in edges])
    last = edges[-1].offset[-1:] + int(first_edge[-2])
    return Edges(
        sender=torch.cat([e.sender + int(s) for e, s in zip(edges, shift, strict=False)]),
        receiver=torch.cat([e.receiver + int(s) for e, s in zip(edges, shift, strict=False)]),
        offset=torch.cat(
            [e.offset[:-1] + int(f) for e, f in zip(edges, first_edge, strict=False)] + [last]
        ),
    )


def component_count(position: Float[Tensor, "q d"], radius: float) -> int:
    """Number of connected components of the radius graph of one scene."""
    return int(component_labels(position, radius).max()) + 1 if len(position) else 0


def component_labels(position: Float[Tensor, "q d"], radius: float) -> Int[Tensor, " q"]:
    """Connected component of the radius graph of one scene that each particle belongs to."""
    # Particles at one place are one component; all pairs of them would fill the memory.
    points = position.detach().cpu().double().numpy()
    places, place = np.unique(points, axis=0, return_inverse=True)
    labels = connected_components(_distance_graph(places, radius), directed=False)[1]
    return torch.from_numpy(labels[place.reshape(-1)].astype(np.int64))


def nearest_points(
    points: Float[np.ndarray, "p d"],
    chosen: Int[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """The nearest other point of some points.

    Points at one place are searched for once: a k-d tree cannot part them, and each would be
    compared with all others.

    Args:
        points: All positions of one scene [m].
        chosen: Rows of those that are asked about.

    Returns:
        Distance [m], infinite for a point that is alone, and row of the nearest other point.
    """
    places, first, place, count = np.unique(
        points, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    place = place.reshape(-1)  # NumPy 2.0 alone gives it a second axis
    last = np.zeros(len(places), np.int64)
    last[place] = np.arange(len(points))
    here = place[chosen]
    twin = np.where(first[here] == chosen, last[here], first[here])
    distance, found = cKDTree(places).query(points[chosen], k=2)
    other = np.where(found[:, 0] == here, found[:, 1], found[:, 0])
    neighbor = first[np.minimum(other, len(places) - 1)]
    alone = count[here] == 1
    return np.where(alone, distance[:, 1], 0.0), np.where(alone, neighbor, twin)


def nearest_distances(points: Float[np.ndarray, "p d"]) -> Float[np.ndarray, " p"]:
    """Distance of each point to the nearest other one; infinite for a single point [m]."""
    return nearest_points(points, np.arange(len(points)))[0]


def smallest_radius(position: Float[Tensor, "q d"], components: int) -> float:
    """Smallest radius whose graph has at most ``components`` connected components.

    The radius graph of radius r contains every edge of the Euclidean minimum spanning tree
    that is no longer than r and has the components those edges leave, so the answer is the
    (q - components)-th shortest edge of the tree.

    Args:
        position: Sampled positions of one scene [m].
        components: Wanted number of components, at least one.

    Returns:
        The radius [m], rounded up; 0 if there are no more particles than components.

    Raises:
        ValueError: If ``components`` is less than one.
    """
    if components < 1:
        raise ValueError(f"components must be >= 1, got {components!r}; no radius gives fewer.")
    points = position.detach().cpu().double().numpy()
    needed = len(points) - components
    if needed <= 0:
        return 0.0
    radius = 2.0 * float(np.median(nearest_distances(points))) or 1e-12
    while True:
        tree = minimum_spanning_tree(_distance_graph(points, radius))
        if tree.nnz >= needed:
            # Rounded up: the square of a rounded length may fall short of the squared distance.
            return float(np.sort(tree.data)[needed - 1]) * (1.0 + 1e-12)
        radius *= 2.0


def choose_radius(
    sparse: Float[Tensor, "q d"],
    full: Float[Tensor, "p d"],
    *,
    margin: float,
    full_radius: float | None = None,
) -> RadiusChoice:
    """Choose the radius at which the sparse graph is as connected as the full one.

    Args:
        sparse: Sampled positions of one scene [m].
        full: All positions of that scene [m].
        margin: Factor on the smallest radius that will do, at least one.
        full_radius: Radius of the full graph [m]; by default twice the median distance to the
            nearest neighbour.

    Raises:
        ValueError: If ``full`` has a single particle and no radius is given.

    Source:
        arXiv:2407.03925v2, section 5.2 (equal number of components); the closed form is ours.
    """
    if full_radius is None:
        if full.shape[0] < 2:
            raise ValueError(
                "a body of one particle has no neighbour to choose a graph radius from. Set the "
                "radius."
            )
        points = full.detach().cpu().double().numpy()
        full_radius = 2.0 * float(np.median(nearest_distances(points)))
    components = component_count(full, full_radius)
    smallest = smallest_radius(sparse, components)
    radius = margin * max(smallest, full_radius)
    pairs = cKDTree(sparse.detach().cpu().double().numpy()).query_pairs(
        radius, output_type="ndarray"
    )
    return RadiusChoice(
        radius=radius,
        smallest=smallest,
        margin=margin,
        components=components,
        full_radius=full_radius,
        mean_degree=2.0 * len(pairs) / sparse.shape[0],
    )


def _distance_graph(points: np.ndarray, radius: float) -> coo_matrix:
    """Upper triangle of the distance matrix, cut at ``radius``."""
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # SciPy reads a stored zero as "no edge": coincident particles are neighbours all the same.
    length = np.maximum(length, np.finfo(np.float64).tiny)
    return coo_matrix((length, (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))


def _pairs_by_tree(position: Tensor, batch: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Neighbour pairs on the CPU, one k-d tree per scene; self-loops included."""
    points, scene = position.detach().double().numpy(), batch.numpy()
    found = [np.stack([np.arange(len(points))] * 2, axis=1)]
    for start, stop in _scene_ranges(scene):
        pairs = cKDTree(points[start:stop]).query_pairs(radius, output_type="ndarray") + start
        found += [pairs, pairs[:, ::-1]]
    pairs = torch.from_numpy(np.concatenate(found))
    return pairs[:, 0], pairs[:, 1]


def _scene_ranges(scene: np.ndarray) -> list[tuple[int, int]]:
    """First particle of each scene and of the next."""
    starts = np.flatnonzero(np.r_[True, scene[1:] != scene[:-1], True]) if len(scene) else [0]
    return [(int(start), int(stop)) for start, stop in pairwise(starts)]


def _pairs_by_cells(position: Tensor, batch: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Neighbour pairs on any device by a cell list of side ``radius``; self-loops included."""
    count, dimension = position.shape
    cell = torch.floor((position - position.min(dim=0).values) / radius).long() + 1
    shape = cell.max(dim=0).values + 2

    def key(cells: Tensor) -> Tensor:
        number = batch
        for axis in range(dimension):
            number = number * shape[axis] + cells[:, axis]
        return number

    order = torch.argsort(key(cell))
    sorted_key = key(cell)[order]
    receivers, senders = [], []
    for shift in product((-1, 0, 1), repeat=dimension):
        wanted = key(cell + torch.tensor(shift, device=position.device))
        first = torch.searchsorted(sorted_key, wanted)
        length = torch.searchsorted(sorted_key, wanted, right=True) - first
        receiver = torch.repeat_interleave(torch.arange(count, device=position.device), length)
        within = torch.arange(len(receiver), device=position.device) - torch.repeat_interleave(
            torch.cumsum(length, 0) - length, length
        )
        sender = order[first[receiver] + within]
        near = (position[sender] - position[receiver]).square().sum(1) <= radius * radius
        receivers.append(receiver[near])
        senders.append(sender[near])
    return torch.cat(senders), torch.cat(receivers)


def _sorted_edges(sender: Tensor, receiver: Tensor, count: int) -> Edges:
    """Sort pairs by receiver, then sender, and mark where each receiver begins."""
    order = torch.argsort(receiver * count + sender)
    receiver = receiver[order]
    offset = torch.searchsorted(receiver, torch.arange(count + 1, device=receiver.device))
    return Edges(sender=sender[order], receiver=receiver, offset=offset)
