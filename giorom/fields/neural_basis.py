"""A linear basis over the undeformed body as a neural field.

The field of the paper. A neural field U(X) gives ``modes`` displacement vectors at every point X
of the undeformed body, and the motion is phi(X) = X + U(X) q. The coefficients q of a frame follow
from the samples by least squares; for a fixed set of samples the normal matrix never changes, so
one Cholesky factorisation serves a whole trajectory.

The solve runs in float64 whatever the precision of the network.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder
from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class NeuralFieldConfig:
    """Size of the neural field."""

    modes: int = 20
    """Number r of basis functions."""

    width: int = 60
    """Width of the hidden layers."""

    depth: int = 5
    """Number of hidden layers."""

    activation: Literal["elu", "sine"] = "elu"
    """Activation after every hidden layer."""

    ridge: float = 1e-8
    """Regularisation of the normal equations, relative to the mean of their diagonal."""

    def __post_init__(self) -> None:
        """Reject sizes no field can be built with."""
        for name in ("modes", "width", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"NeuralFieldConfig.{name} must be >= 1, got {getattr(self, name)!r}."
                )
        if not self.ridge >= 0.0:
            raise ValueError(f"NeuralFieldConfig.ridge must be >= 0, got {self.ridge!r}.")


class NeuralField(Field):
    """Basis functions U(X) on the reference body.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        Chang et al., "LiCROM", SIGGRAPH Asia 2023 (linear basis as a neural field);
        arXiv:2407.03925v2, equations 4, 5 and 11.
    """

    center: Tensor
    scale: Tensor

    def __init__(self, config: NeuralFieldConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.register_buffer("center", torch.zeros(dimension))
        self.register_buffer("scale", torch.ones(dimension))
        widths = [dimension] + [config.width] * config.depth
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.output = nn.Linear(config.width, dimension * config.modes)
        for layer in [*self.hidden, self.output]:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def set_domain(self, reference: Float[Tensor, "p d"]) -> None:
        """Standardise the input by the spread of the training bodies."""
        self.center.copy_(reference.mean(dim=0))
        self.scale.copy_(reference.std(dim=0).clamp_min(1e-6))

    def forward(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, "p d r"]:
        """Basis vectors at the points ``reference`` [m]."""
        value = (reference - self.center) / self.scale
        for layer in self.hidden:
            value = layer(value)
            value = (
                torch.sin(value) if self.config.activation == "sine" else nn.functional.elu(value)
            )
        return self.output(value).unflatten(1, (self.dimension, self.config.modes))

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Standardise the input by the spread of the training bodies."""
        self.set_domain(torch.cat([t.position[0] for t in trajectories]))

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Error of the projection; see ``projection_loss``."""
        return projection_loss(self, reference, displacement, solve_count=solve_count)

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,  # noqa: ARG002
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``."""
        return BasisDecoder(self, reference, query, ridge=self.config.ridge, held=held)


class SampleSolver:
    """Least squares for the coefficients q, factorised once per set of samples.

    Args:
        basis: U at the samples.
        ridge: Regularisation, relative to the mean of the diagonal of the normal matrix.

    Raises:
        ValueError: If the samples do not determine the coefficients.
    """

    def __init__(self, basis: Float[Tensor, "q d r"], *, ridge: float) -> None:
        self.matrix = basis.flatten(0, 1).double()
        normal = self.matrix.T @ self.matrix
        strength = ridge * normal.diagonal().mean()
        identity = torch.eye(normal.shape[0], dtype=normal.dtype, device=normal.device)
        factor, failed = torch.linalg.cholesky_ex(normal + strength * identity)
        rounding = normal.shape[0] * torch.finfo(normal.dtype).eps * normal.diagonal()
        if int(failed) != 0 or bool((factor.diagonal().square() <= rounding).any()):
            raise ValueError(
                f"{basis.shape[0]} samples do not determine {basis.shape[2]} modes: the normal "
                f"matrix is singular. Sample more points, use fewer modes or raise "
                f"NeuralFieldConfig.ridge ({ridge:g})."
            )
        self.factor = factor

    def solve(self, displacement: Float[Tensor, "*t q d"]) -> Float[Tensor, "*t r"]:
        """Coefficients that fit ``displacement`` at the samples best (equation 4)."""
        right = displacement.double().flatten(-2) @ self.matrix
        columns = right.reshape(-1, right.shape[-1]).T
        return torch.cholesky_solve(columns, self.factor).T.reshape(right.shape)


class BasisDecoder(FieldDecoder):
    """A basis at one set of samples and one set of query points.

    Args:
        field: Basis vectors (p d r) at reference points (p d).
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        ridge: Regularisation of the normal equations.
        held: Query points that never move; by default none.
        chunk: Query points per evaluation of the field; bounds the memory.
    """

    def __init__(
        self,
        field: Callable[[Tensor], Tensor],
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        ridge: float,
        held: Bool[Tensor, " p"] | None = None,
        chunk: int = 65536,
    ) -> None:
        super().__init__(reference, query, held=held)
        with torch.no_grad():
            self.solver = SampleSolver(field(reference), ridge=ridge)
            rows = [field(part).flatten(0, 1) for part in query.split(chunk)]
        self.basis = torch.cat(rows)

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + U(X) q (equation 5)."""
        coefficients = self.solver.solve(position - self.reference).to(self.basis.dtype)
        return self.query + (self.basis @ coefficients).reshape(self.query.shape)


def projection_loss(
    field: NeuralField,
    reference: Float[Tensor, "p d"],
    displacement: Float[Tensor, "t p d"],
    *,
    solve_count: int,
) -> Float[Tensor, ""]:
    """Relative reconstruction error of held-back points, with q solved inside (equation 11).

    The first ``solve_count`` points determine q, the others are compared: training does what use
    does, and no encoder is needed.

    Args:
        field: The neural field.
        reference: Undeformed positions in random order [m].
        displacement: Displacements of the same points at some frames [m].
        solve_count: Number of points that play the part of the samples.

    Returns:
        Mean squared error over mean squared displacement, averaged over frames.

    Source:
        Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
        problems whose variables separate", SIAM J. Numer. Anal. 10(2), 1973.
    """
    basis = field(reference)
    solver = SampleSolver(basis[:solve_count], ridge=field.config.ridge)
    coefficients = solver.solve(displacement[:, :solve_count])
    target = displacement[:, solve_count:].double().flatten(1)
    found = coefficients @ basis[solve_count:].flatten(0, 1).double().T
    energy = displacement.double().square().mean(dim=(1, 2)) + 1e-12
    return ((found - target).square().mean(dim=1) / energy).mean().to(reference.dtype)
