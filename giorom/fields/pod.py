"""Proper orthogonal decomposition of the training motions, on a grid over the undeformed bodies.

Bodies differ in shape and in the number of their particles, so that modes cannot be vectors over
particles. Here they live at the nodes of a regular grid over the space that the undeformed training
bodies fill, and are interpolated linearly in between. A node outside a body has no displacement in
its snapshots; those gaps are filled by the modes themselves, over and over (gappy POD). The
coefficients of a frame follow from the samples by least squares, as with the neural basis.

By default no mean is subtracted: a body at rest has the coefficients zero and rests. The textbook
decomposition subtracts the mean displacement of the snapshots (``center``), which gives the modes
more to say; a body at rest is then recovered as well as any other frame, no better.
"""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from giorom.fields.contract import Field, FieldDecoder
from giorom.fields.local import polynomial_weights
from giorom.fields.neighbors import nearest_samples
from giorom.fields.neural_basis import BasisDecoder
from giorom.state import Trajectory

MARGIN = 1.001
"""Size of the grid in units of the extent of the training bodies."""


@dataclass(frozen=True, kw_only=True)
class PodConfig:
    """Size of the basis."""

    modes: int = 32
    """Number r of modes."""

    nodes: int = 4096
    """Most nodes of the grid; 64 on a side in the plane, 16 in space."""

    snapshots: int = 512
    """Most training frames that are decomposed; about as many of each motion."""

    sweeps: int = 20
    """How often the gaps are filled."""

    center: bool = False
    """Whether the modes are of displacements less their mean over the snapshots."""

    ridge: float = 1e-6
    """Regularisation of the normal equations, relative to the mean of their diagonal."""

    def __post_init__(self) -> None:
        """Reject sizes no basis can be built with."""
        for name, least in (("modes", 1), ("nodes", 8), ("snapshots", 1), ("sweeps", 0)):
            if getattr(self, name) < least:
                raise ValueError(
                    f"PodConfig.{name} must be >= {least}, got {getattr(self, name)!r}."
                )
        if not self.ridge >= 0.0:
            raise ValueError(f"PodConfig.ridge must be >= 0, got {self.ridge!r}.")

    def side(self, dimension: int) -> int:
        """Nodes on a side."""
        return int(self.nodes ** (1.0 / dimension) + 1e-9)


class PodField(Field):
    """Gappy proper orthogonal decomposition on a grid.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        Everson and Sirovich, "Karhunen-Loeve procedure for gappy data", J. Opt. Soc. Am. A
        12(8), 1995.
    """

    origin: Tensor
    cell: Tensor
    mode: Tensor
    mean: Tensor

    def __init__(self, config: PodConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        shape = (config.side(dimension) ** dimension, dimension, config.modes)
        self.register_buffer("origin", torch.zeros(dimension))
        self.register_buffer("cell", torch.ones(dimension))
        self.register_buffer("mode", torch.zeros(shape))
        self.register_buffer("mean", torch.zeros(shape[:2]))

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Decompose snapshots of the training motions.

        Raises:
            ValueError: If there are fewer snapshots than modes.
        """
        bodies = torch.cat([t.position[0] for t in trajectories])
        low, high = bodies.amin(dim=0), bodies.amax(dim=0)
        extent = (high - low).clamp_min(1e-9) * MARGIN
        self.cell.copy_(extent / (self.config.side(self.dimension) - 1))
        self.origin.copy_((low + high - extent) / 2)
        frames = max(1, self.config.snapshots // len(trajectories))
        columns, known = [], []
        for trajectory in trajectories[: self.config.snapshots]:
            value, inside = self._snapshots(trajectory, frames)
            columns.append(value)
            known.append(inside[:, None].expand_as(value))
        snapshots, mask = torch.cat(columns, dim=1), torch.cat(known, dim=1)
        if snapshots.shape[1] < self.config.modes:
            raise ValueError(
                f"{snapshots.shape[1]} training frames cannot give {self.config.modes} modes. "
                f"Lower PodConfig.modes or train on more frames."
            )
        if self.config.center:
            mean = snapshots.sum(dim=1) / mask.sum(dim=1).clamp_min(1)
            snapshots = torch.where(mask, snapshots - mean[:, None], 0.0)
            self.mean.copy_(mean.unflatten(0, (-1, self.dimension)))
        modes = gappy_modes(snapshots, mask, self.config.modes, sweeps=self.config.sweeps)
        self.mode.copy_(modes.unflatten(0, (-1, self.dimension)))

    def _snapshots(self, trajectory: Trajectory, frames: int) -> tuple[Tensor, Tensor]:
        """Displacements of the nodes at some frames, and which rows are within the body."""
        body, dimension = trajectory.position[0].double(), self.dimension
        chosen = torch.linspace(1, trajectory.frame_count - 1, frames).round().long().unique()
        moved = trajectory.position[chosen].double() - body
        labels = (torch.zeros(len(body)).long(), torch.zeros(len(self.nodes())).long())
        index, same = nearest_samples(body, self.nodes(), count=4 * dimension, labels=labels)
        distance = (body[index[:, 0]] - self.nodes()).norm(dim=1)
        inside = distance <= float(self.cell.norm())
        weights = polynomial_weights(body, self.nodes(), index, same=same, degree=1)
        value = torch.einsum("pk,tpkd->pdt", weights, moved[:, index])
        value = value * inside[:, None, None]
        return value.flatten(0, 1), inside.repeat_interleave(dimension)

    def nodes(self) -> Float[Tensor, "n d"]:
        """Places of the nodes [m]."""
        steps = torch.arange(self.config.side(self.dimension), dtype=torch.float64)
        axes = [
            float(origin) + float(cell) * steps
            for origin, cell in zip(self.origin, self.cell, strict=True)
        ]
        return torch.cartesian_prod(*axes)

    def basis(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, "p d r"]:
        """Modes at any points, linear between the nodes, constant outside the grid."""
        return self._interpolated(self.mode, reference)

    def mean_displacement(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, "p d"]:
        """Mean displacement of the snapshots at any points [m]; zero unless ``center``."""
        return self._interpolated(self.mean[:, :, None], reference)[:, :, 0]

    def check_prepared(self) -> None:
        """Refuse to decode without modes.

        Raises:
            ValueError: If the field has not been prepared.
        """
        if not bool(self.mode.any()):
            raise ValueError(
                "the POD field holds no modes yet; prepare it with training trajectories, which "
                "giorom train does."
            )

    def _interpolated(
        self, table: Float[Tensor, "n d r"], reference: Float[Tensor, "p d"]
    ) -> Float[Tensor, "p d r"]:
        """Values at the nodes, linear in between."""
        side = self.config.side(self.dimension)
        place = ((reference - self.origin) / self.cell).clamp(0.0, side - 1.0)
        corner = place.floor().clamp(max=side - 2.0)
        share, corner = place - corner, corner.long()
        result = torch.zeros_like(table[:1]).expand(len(reference), -1, -1).clone()
        for shift in itertools.product((0, 1), repeat=self.dimension):
            step = torch.tensor(shift, device=corner.device)
            weight = torch.where(step == 1, share, 1.0 - share).prod(dim=1)
            number = corner[:, 0] + step[0]
            for axis in range(1, self.dimension):
                number = number * side + corner[:, axis] + step[axis]
            result += weight[:, None, None] * table[number]
        return result

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,  # noqa: ARG002
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``.

        Raises:
            ValueError: If the field has not been prepared.
        """
        self.check_prepared()
        settings = {"ridge": self.config.ridge, "held": held}
        if not self.config.center:
            return BasisDecoder(self.basis, reference, query, **settings)
        return CenteredDecoder(self, reference, query, **settings)


class CenteredDecoder(BasisDecoder):
    """A basis of what is left when the mean displacement is subtracted.

    Args:
        field: Basis and mean.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        ridge: Regularisation of the normal equations.
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: PodField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        ridge: float,
        held: Bool[Tensor, " p"] | None = None,
    ) -> None:
        super().__init__(field.basis, reference, query, ridge=ridge, held=held)
        self.sample_mean = field.mean_displacement(reference)
        self.query_mean = field.mean_displacement(query)

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + mean + U(X) q."""
        return super().recover(position - self.sample_mean) + self.query_mean


def gappy_modes(
    snapshots: Float[Tensor, "n m"], known: Bool[Tensor, "n m"], count: int, *, sweeps: int
) -> Float[Tensor, "n r"]:
    """Orthonormal modes of snapshots with gaps, by alternating filling and decomposition.

    Args:
        snapshots: One snapshot per column; zero where not known.
        known: Which entries are known.
        count: Number r of modes.
        sweeps: How often the gaps are filled.
    """
    filled = snapshots.clone()
    modes = _leading(filled, count)
    for _ in range(sweeps):
        filled = torch.where(known, snapshots, modes @ (modes.T @ filled))
        modes = _leading(filled, count)
    return modes


def _leading(matrix: Float[Tensor, "n m"], count: int) -> Float[Tensor, "n r"]:
    """Leading left singular vectors, by the eigenvectors of the smaller Gram matrix."""
    rows, columns = matrix.shape
    if rows <= columns:
        return torch.linalg.eigh(matrix @ matrix.T).eigenvectors[:, -count:].flip(1)
    value, vector = torch.linalg.eigh(matrix.T @ matrix)
    modes = matrix @ vector[:, -count:].flip(1)
    lengths = value[-count:].flip(0).clamp_min(1e-24 * float(value[-1].clamp_min(1e-300))).sqrt()
    return modes / lengths
