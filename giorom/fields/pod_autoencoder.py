"""An autoencoder of POD coefficients: the classical nonlinear manifold, for bodies of any points.

The autoencoder of Lee and Carlberg compresses the whole state in a fixed order of the unknowns,
which bodies of other particles do not have, and whose layers would grow with the particles. Here
the state is first written in many POD modes over the undeformed bodies (``pod``), whose
coefficients follow from the samples by least squares, and the network compresses those:

    phi(X) = X + M(X) [D(E(c)) - D(E(0))],   c = argmin sum_k |u_k - M(X_k) c|^2.

What the network says of a body at rest is subtracted, so that it rests.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder, relative_error
from giorom.fields.neural_basis import SampleSolver
from giorom.fields.pod import PodConfig, PodField
from giorom.state import Trajectory

SMALLEST = 1e-2
"""Least unit of a coefficient, relative to the largest."""

POINTS = 500
"""Points of a training body that show how large its coefficients are, about."""


@dataclass(frozen=True, kw_only=True)
class PodAutoencoderConfig:
    """Size of the basis and of the network."""

    modes: int = 64
    """Number of POD modes whose coefficients are compressed."""

    latent: int = 32
    """Length of the latent vector."""

    width: int = 128
    """Width of the hidden layers."""

    depth: int = 2
    """Hidden layers of the encoder, and of the decoder."""

    nodes: int = 4096
    """Most nodes of the grid the modes live on; see ``PodConfig``."""

    snapshots: int = 512
    """Most training frames that are decomposed; see ``PodConfig``."""

    ridge: float = 1e-3
    """Regularisation of the normal equations; there may be more modes than samples."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        for name in ("modes", "latent", "width", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"PodAutoencoderConfig.{name} must be >= 1, got {getattr(self, name)!r}."
                )
        self.basis()

    def basis(self) -> PodConfig:
        """Settings of the basis."""
        return PodConfig(
            modes=self.modes, nodes=self.nodes, snapshots=self.snapshots, ridge=self.ridge
        )


class PodAutoencoderField(Field):
    """Autoencoder of POD coefficients.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        Lee and Carlberg, "Model reduction of dynamical systems on nonlinear manifolds using deep
        convolutional autoencoders", J. Comput. Phys. 404, 2020; on coefficients instead of states
        as in Fresca and Manzoni, "POD-DL-ROM", Comput. Methods Appl. Mech. Eng. 388, 2022.
    """

    spread: Tensor

    def __init__(self, config: PodAutoencoderConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.register_buffer("spread", torch.ones(config.modes))
        self.pod = PodField(config.basis(), dimension=dimension)
        inner = [config.width] * config.depth
        self.encoder = _perceptron([config.modes, *inner, config.latent], bias=True)
        self.decoder = _perceptron([config.latent, *inner, config.modes], bias=False)

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Decompose snapshots of the training motions, and see how large coefficients are.

        Those of bodies that fill a part of the grid follow from their points, as in use.
        """
        self.pod.prepare(trajectories)
        squares = []
        for trajectory in trajectories:
            points = trajectory.position[:, :: max(1, trajectory.position.shape[1] // POINTS)]
            solver = SampleSolver(self.pod.basis(points[0]), ridge=self.config.ridge)
            squares.append(solver.solve(points[1:] - points[0]).square().mean(dim=0))
        spread = torch.stack(squares).mean(dim=0).sqrt()
        # What hardly occurs in training is not blown up to the size of what does.
        self.spread.copy_(spread.clamp_min(SMALLEST * float(spread.max().clamp_min(1e-12))))

    def scaled_basis(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, "p d m"]:
        """Modes in units of what their coefficients are in training.

        Ridge regression in these units prefers the usual where the samples leave a choice.
        """
        return self.pod.basis(reference) * self.spread

    def compressed(self, coefficient: Float[Tensor, "*t m"]) -> Float[Tensor, "*t m"]:
        """The scaled coefficients after the bottleneck."""
        rest = self.decoder(self.encoder(torch.zeros_like(coefficient)))
        return self.decoder(self.encoder(coefficient)) - rest

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error of the points that are not samples; see ``Field.loss``."""
        basis = self.scaled_basis(reference)
        solver = SampleSolver(basis[:solve_count], ridge=self.config.ridge)
        coefficient = solver.solve(displacement[:, :solve_count]).to(basis.dtype)
        found = torch.einsum("pdm,tm->tpd", basis[solve_count:], self.compressed(coefficient))
        return relative_error(found, displacement[:, solve_count:])

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
        self.pod.check_prepared()
        return PodAutoencoderDecoder(self, reference, query, held=held)


class PodAutoencoderDecoder(FieldDecoder):
    """An autoencoder of POD coefficients bound to one body.

    Args:
        field: The basis and the network.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: PodAutoencoderField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
    ) -> None:
        super().__init__(reference, query, held=held)
        self.field = field
        with torch.no_grad():
            self.solver = SampleSolver(field.scaled_basis(reference), ridge=field.config.ridge)
            self.basis = field.scaled_basis(query).flatten(0, 1)

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + the displacement of the compressed coefficients."""
        with torch.no_grad():
            coefficient = self.solver.solve(position - self.reference).to(self.basis.dtype)
            found = self.basis @ self.field.compressed(coefficient)
            return self.query + found.reshape(self.query.shape)


def _perceptron(widths: list[int], *, bias: bool) -> nn.Sequential:
    """Linear layers with ELU between them; the decoder's last bias would cancel."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths[:-1]):
        layers += [nn.Linear(inputs, outputs), nn.ELU()]
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1], bias=bias))
