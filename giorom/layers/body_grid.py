r"""A coarse grid fixed to an undeformed body: what turns node displacements into forces.

The displacement of the body is a quadratic spline on the nodes, :math:`u(X) = \sum_i N_i(X) u_i`.
All integrals run over the whole undeformed body, over small cells that hold its particles, so that
nothing here depends on how many samples a simulation follows. Masses and volumes count particles;
only ratios matter. Set up in float64, once per body; used in the precision of the state.
"""

import math
import weakref
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.layers.spline_grid import spline_weights
from giorom.state import Body

ROUNDING = 0.25
"""How far a row of nodes may lie below the highest held particle and still hold [rows]."""

MOST_NODES = 4000
"""Largest number of free nodes: each of their few dense matrices then takes 128 MB."""

MOST_BOX_NODES = 1 << 24
"""Largest number of nodes in the box around a body, most of which no particle may touch."""

SMALLEST_MASS = 1e-6
"""Mass that is added to every node, over that of the heaviest."""

SMOOTHNESS = 1e-3
"""Weight of the second differences where samples do not determine a node."""

TINY = 1e-8
"""Weight of the displacement itself, where not even those do."""


@dataclass(frozen=True, kw_only=True)
class BodyGridConfig:
    """How a body is covered."""

    spacing: tuple[float, ...]
    """Distance between nodes along each axis [m]."""

    cells: int
    """Cells per node distance and axis over which the body is integrated."""

    lumped: float
    """Share of the mass that sits on the nodes; the rest is spread as the splines are."""

    held_rows: float | None
    """Distance of the rows that hold the body [m], counted from zero; none: it is held up to
    its highest held particle."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How some samples read the nodes, and how nodes are found from them."""

    node: Int[Tensor, "q k"]
    """Nodes around each sample."""

    weight: Float[Tensor, "q k"]
    """Their weights; nodes outside the body have none."""

    moving: Int[Tensor, " f"]
    """Samples that are not held."""

    fit: Float[Tensor, "n f"]
    """Free nodes from the values of those samples: least squares and second differences."""

    drag: Float[Tensor, "h c"]
    """Held nodes from the values of the held samples, an affine motion."""

    def __call__(self, value: Float[Tensor, "m d"]) -> Float[Tensor, "q d"]:
        """Values at the samples from those at all nodes."""
        return (self.weight[:, None] @ value[self.node])[:, 0]


class BodyGrid:
    """Operators of one body, free nodes first, then held ones.

    Args:
        body: Undeformed particles and which of them are held.
        config: How it is covered.
    """

    def __init__(self, body: Body, config: BodyGridConfig) -> None:
        self.spacing = np.array(config.spacing)
        position = body.position.double().cpu().numpy()
        held = body.kinematic.cpu().numpy()
        plane = held_plane(position, held, rows=config.held_rows)
        self._place(position, plane)
        live = position[~held]
        self._number_nodes(live, plane)
        node, weight, _ = self._stencil(live)
        reads = self._matrix(node, weight)[:, : self.free_count]
        mass = np.asarray(reads.sum(axis=0)).ravel()
        added = SMALLEST_MASS * mass.max()
        self.mass = torch.from_numpy(mass + added).float()
        stiffness = self._integrate(live, body.particle_type.cpu().numpy()[~held], config.cells)
        spread = (1.0 - config.lumped) * (reads.T @ reads)
        total = spread + scipy.sparse.diags_array(config.lumped * mass + added)
        self._whiten(torch.from_numpy(total.toarray()), stiffness)
        self._differences = self._second_differences()
        self._readings: dict[bytes, Reading] = {}
        self._inverse: tuple[float, Tensor] | None = None

    @property
    def free_count(self) -> int:
        """Nodes that move as forces say."""
        return self._free_count

    @property
    def node_count(self) -> int:
        """All nodes."""
        return len(self.node_position)

    def inverse_mass(self, inertia: float) -> Float[Tensor, "n n"]:
        r"""Inverse of the mass of the free nodes, with inertia added for the shortest waves.

        :math:`(M + \beta^2 K M^{-1} K)^{-1}` with the stiffness :math:`K` of a unit modulus over
        density: a wave of squared frequency w becomes one of
        :math:`w / (1 + \beta^2 w^2) \le 1 / (2 \beta)`.

        Args:
            inertia: The factor beta [m^2].

        Raises:
            FloatingPointError: If it is too large to be inverted.
        """
        if self._inverse is None or self._inverse[0] != inertia:
            slowed = inertia**2 * self._white_stiffness @ self._white_stiffness
            slowed.diagonal().add_(1.0)
            factor, failed = torch.linalg.cholesky_ex(slowed)
            if failed or not math.isfinite(inertia):
                raise FloatingPointError(
                    f"the body is too stiff for its steps: waves slowed by {inertia:.3g} m^2 leave "
                    f"no mass that can be inverted. Lower the stiffness or the viscosity, or raise "
                    f"BodyStepperConfig.substeps."
                )
            white = torch.cholesky_inverse(factor)
            self._inverse = inertia, (self._whitening.T @ white @ self._whitening).float()
        return self._inverse[1]

    def reading(self, reference: Float[Tensor, "q d"], held: Tensor) -> Reading:
        """The operators of some samples, remembered.

        Args:
            reference: Undeformed positions of the samples [m].
            held: Which are held.
        """
        points, held_points = reference.detach().cpu().numpy(), held.cpu().numpy()
        key = points.tobytes() + held_points.tobytes()
        if key not in self._readings:
            self._readings[key] = self._read(points.astype(np.float64), held_points)
        return self._readings[key]

    def _place(self, position: np.ndarray, plane: tuple[int, float] | None) -> None:
        """Lay the grid: the middle of the body on a node, or a row of nodes on the held plane."""
        low, high = position.min(axis=0), position.max(axis=0)
        anchor = 0.5 * (low + high)
        if plane is not None:
            anchor[plane[0]] = plane[1]
        first = np.floor((low - anchor) / self.spacing - 0.5) - 1
        last = np.floor((high - anchor) / self.spacing - 0.5) + 3
        nodes = np.prod(last - first + 1)
        if not nodes <= MOST_BOX_NODES:
            raise ValueError(
                f"a grid of {self.spacing.tolist()} m around a body of {(high - low).tolist()} m "
                f"would have {nodes:.3g} nodes; at most {MOST_BOX_NODES} are taken. Raise "
                f"BodyStepperConfig.spacing or height_spacing."
            )
        self._origin = anchor + first * self.spacing
        self._shape = tuple((last - first + 1).astype(int).tolist())

    def _number_nodes(self, live: np.ndarray, plane: tuple[int, float] | None) -> None:
        """Number the nodes that moving particles touch, free ones first."""
        self._number = np.arange(np.prod(self._shape))
        touched = np.unique(self._stencil(live)[0])
        place = np.stack(np.unravel_index(touched, self._shape), axis=1)
        place = self._origin + place * self.spacing
        fixed = np.zeros(len(touched), dtype=bool)
        if plane is not None:
            fixed = place[:, plane[0]] <= plane[1] + 1e-6 * self.spacing[plane[0]]
        if fixed.all():
            raise ValueError(
                f"a grid of {self.spacing.tolist()} m has no free node above the held part of the "
                f"body. Lower BodyStepperConfig.spacing."
            )
        order = np.argsort(fixed, kind="stable")
        self._free_count = int((~fixed).sum())
        if self._free_count > MOST_NODES:
            raise ValueError(
                f"a grid of {self.spacing.tolist()} m has {self._free_count} free nodes in this "
                f"body; at most {MOST_NODES} are taken, whose matrices fit into memory. Raise "
                f"BodyStepperConfig.spacing or height_spacing."
            )
        self._number = np.full(np.prod(self._shape), -1)
        self._number[touched[order]] = np.arange(len(touched))
        self.node_position = place[order]

    def _stencil(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers, weights and slopes [1/m] of the nodes around points; unknown nodes weigh 0."""
        count, d = points.shape
        place = (points - self._origin) / self.spacing
        base = np.clip(np.floor(place - 0.5), 0, np.array(self._shape) - 3)
        f = place - base
        each = np.stack(spline_weights(f), axis=-1)
        corner = np.stack(np.meshgrid(*[np.arange(3)] * d, indexing="ij"), -1).reshape(-1, d)
        weight = np.prod([each[:, axis, corner[:, axis]] for axis in range(d)], axis=0)
        node = base[:, None].astype(int) + corner
        flat = np.ravel_multi_index(tuple(np.moveaxis(node, 2, 0)), self._shape)
        number = self._number[flat]
        weight = np.where(number < 0, 0.0, weight)
        slope = 4.0 / self.spacing * weight[:, :, None] * (corner - f[:, None])
        return np.maximum(number, 0).reshape(count, -1), weight, slope

    def _matrix(self, node: np.ndarray, value: np.ndarray) -> scipy.sparse.csr_array:
        """Values of a stencil as a sparse matrix, one row per point."""
        rows = np.repeat(np.arange(len(node)), node.shape[1])
        shape = (len(node), self.node_count)
        return scipy.sparse.csr_array((value.ravel(), (rows, node.ravel())), shape=shape)

    def _whiten(self, mass: Float[Tensor, "n n"], stiffness: Float[Tensor, "n n"]) -> None:
        """Change to coordinates in which the mass is one."""
        unit = torch.eye(len(mass), dtype=mass.dtype)
        factor = torch.linalg.cholesky(mass)
        self._whitening = torch.linalg.solve_triangular(factor, unit, upper=False)
        self._white_stiffness = self._whitening @ stiffness @ self._whitening.T

    def _integrate(self, live: np.ndarray, kind: np.ndarray, cells: int) -> Float[Tensor, "n n"]:
        """Cells of the body, each with the volume, the centroid and the type of its particles.

        Returns:
            Stiffness of the free nodes for a unit modulus, the same for every axis.
        """
        cell = np.floor((live - self._origin) / (self.spacing / cells)).astype(int)
        _, first, member = np.unique(cell, axis=0, return_index=True, return_inverse=True)
        member = member.ravel()
        volume = np.bincount(member).astype(np.float64)
        axes = range(live.shape[1])
        centroid = np.stack([np.bincount(member, live[:, a]) / volume for a in axes], axis=1)
        node, _, slope = self._stencil(centroid)
        self.node, self.slope = torch.from_numpy(node), torch.from_numpy(slope).float()
        self.volume = torch.from_numpy(volume).float()
        self.particle_type = torch.from_numpy(kind[first])
        slopes = [self._matrix(node, slope[..., a])[:, : self.free_count] for a in axes]
        stiffness = sum(g.T @ scipy.sparse.diags_array(volume) @ g for g in slopes)
        return torch.from_numpy(stiffness.toarray())

    def _second_differences(self) -> scipy.sparse.csr_array:
        """One row for every three free nodes in a line."""
        grid = self._number.reshape(self._shape)
        free = np.where(grid < self.free_count, grid, -1)
        triples = []
        for axis, size in enumerate(self._shape):
            lines = [np.take(free, range(k, size - 2 + k), axis=axis).ravel() for k in range(3)]
            triple = np.stack(lines, axis=1)
            triples.append(triple[(triple >= 0).all(axis=1)])
        triple = np.concatenate(triples)
        return self._matrix(triple, np.tile([1.0, -2.0, 1.0], (len(triple), 1)))

    def _read(self, points: np.ndarray, held: np.ndarray) -> Reading:
        """Set up the operators of some samples."""
        node, weight, _ = self._stencil(points)
        n = self.free_count
        reads = self._matrix(node, weight)[~held, :n]
        smooth = self._differences[:, :n]
        normal = (reads.T @ reads + SMOOTHNESS * (smooth.T @ smooth)).toarray()
        normal = torch.from_numpy(normal + TINY * np.eye(n))
        factor = torch.linalg.cholesky(normal)
        fit = torch.cholesky_solve(torch.from_numpy(reads.toarray().T.copy()), factor)
        return Reading(
            node=torch.from_numpy(node),
            weight=torch.from_numpy(weight).float(),
            moving=torch.from_numpy(np.nonzero(~held)[0]),
            fit=fit.float(),
            drag=torch.from_numpy(self._affine(points[held])).float(),
        )

    def _affine(self, points: np.ndarray) -> np.ndarray:
        """Values at the held nodes from an affine function through those at some points."""
        fixed = self.node_position[self.free_count :]
        if not len(points) or not len(fixed):
            return np.zeros((len(fixed), len(points)))
        middle = points.mean(axis=0)

        def terms(place: np.ndarray) -> np.ndarray:
            return np.hstack([np.ones((len(place), 1)), (place - middle) / self.spacing])

        return terms(fixed) @ np.linalg.pinv(terms(points), rcond=1e-4)


def held_plane(
    position: np.ndarray, held: np.ndarray, *, rows: float | None
) -> tuple[int, float] | None:
    """Axis and height of the plane up to which a body is held [m], if it is.

    Args:
        position: Undeformed particles [m].
        held: Which of them are held.
        rows: As in ``BodyGridConfig``.

    Raises:
        ValueError: If the whole body is held, or it is not held from below.
    """
    if not held.any():
        return None
    if held.all():
        raise ValueError("every particle of the body is kinematic; nothing is left to simulate.")
    height = position[:, 1]
    top, lowest = height[held].max(), height[~held].min()
    if top > lowest + 0.5 * (height.max() - lowest):
        raise ValueError(
            f"the kinematic particles of the body reach up to {top:.4g} m and its free ones from "
            f"{lowest:.4g} to {height.max():.4g} m: the body stepper holds bodies from below "
            f"alone. Use a network instead."
        )
    if rows is not None:
        top = rows * np.ceil(top / rows - ROUNDING)
    return 1, float(top)


_KNOWN: weakref.WeakKeyDictionary[Body, dict[BodyGridConfig, BodyGrid]] = (
    weakref.WeakKeyDictionary()
)


def body_grid(body: Body, config: BodyGridConfig) -> BodyGrid:
    """The grid of a body, set up when it is first asked for and kept as long as the body is."""
    grids = _KNOWN.setdefault(body, {})
    if config not in grids:
        grids[config] = BodyGrid(body, config)
    return grids[config]
