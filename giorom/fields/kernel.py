"""A learned kernel over the samples around each point of the undeformed body.

The integral transform of the paper's third version in a form that cannot move a resting body:

    phi(X) = X + sum_k w_k(X) [u_k + R((X - X_k) / h, (u_k - u) / h) h],   u = sum_k w_k(X) u_k.

The weights are a Gaussian of the distance, normalised to sum to one, so that translations are
exact and a point far from all samples follows the nearest. Its width h is learned in units of the
spacing of the samples, which carries it to other numbers of samples. R is a small network that
vanishes where the samples move alike.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder, relative_error
from giorom.fields.neighbors import body_labels, nearest_samples, sample_spacing

FIRST_WIDTH = 0.7
"""Width before training, in units of the spacing of the samples."""


@dataclass(frozen=True, kw_only=True)
class KernelConfig:
    """Size of the kernel."""

    neighbors: int = 12
    """Samples in a neighbourhood."""

    correction: bool = True
    """Whether there is a network R; without it the width alone is learned."""

    hidden: int = 32
    """Width of the network's two hidden layers."""

    def __post_init__(self) -> None:
        """Reject sizes no kernel can be built with."""
        for name in ("neighbors", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"KernelConfig.{name} must be >= 1, got {getattr(self, name)!r}.")


@dataclass(frozen=True, kw_only=True)
class Neighborhood:
    """The samples around some points."""

    index: Int[Tensor, "p k"]
    """Rows of the samples."""

    same: Bool[Tensor, "p k"]
    """Which of them are of the same body."""

    offset: Float[Tensor, "p k d"]
    """The points as seen from the samples, in units of the spacing."""

    spacing: float
    """Median distance of a sample to the nearest other one [m]."""


class KernelField(Field):
    """Normalised kernel with a learned width and a learned correction.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        The kernel reduced-order model of the GIOROM authors, arXiv:2407.03925v3, of which the
        normalisation, the learned width and the vanishing correction are changes of ours.
    """

    def __init__(self, config: KernelConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.log_width = nn.Parameter(torch.tensor(FIRST_WIDTH).log())
        self.network = None
        if config.correction:
            width = config.hidden
            self.network = nn.Sequential(
                nn.Linear(2 * dimension, width),
                nn.GELU(),
                nn.Linear(width, width),
                nn.GELU(),
                nn.Linear(width, dimension, bias=False),
            )

    def neighborhood(
        self, reference: Float[Tensor, "q d"], query: Float[Tensor, "p d"]
    ) -> Neighborhood:
        """Who speaks for each query point."""
        labels = body_labels(reference, query, least=self.dimension + 1)
        index, same = nearest_samples(reference, query, count=self.config.neighbors, labels=labels)
        spacing = sample_spacing(reference)
        offset = (query[:, None] - reference[index]) / spacing
        return Neighborhood(index=index, same=same, offset=offset, spacing=spacing)

    def weights(self, around: Neighborhood) -> Float[Tensor, "p k"]:
        """The normalised kernel."""
        exponent = -(around.offset / self.log_width.exp()).square().sum(dim=2)
        return exponent.masked_fill(~around.same, -torch.inf).softmax(dim=1)

    def displacement(
        self,
        around: Neighborhood,
        weights: Float[Tensor, "p k"],
        displacement: Float[Tensor, "*t q d"],
    ) -> Float[Tensor, "*t p d"]:
        """Displacement of the query points from that of the samples [m]."""
        moved = displacement[..., around.index, :]
        mean = torch.einsum("pk,...pkd->...pd", weights, moved)
        if self.network is None:
            return mean
        width = self.log_width.exp()
        strain = (moved - mean[..., None, :]) / (width * around.spacing)
        where = around.offset / width
        alike = self.network(torch.cat([where, torch.zeros_like(where)], dim=-1))
        found = self.network(torch.cat([where.expand_as(strain), strain], dim=-1)) - alike
        correction = torch.einsum("pk,...pkd->...pd", weights, found)
        return mean + width * around.spacing * correction

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error of the points that are not samples; see ``Field.loss``."""
        around = self.neighborhood(reference[:solve_count], reference[solve_count:])
        found = self.displacement(around, self.weights(around), displacement[:, :solve_count])
        return relative_error(found, displacement[:, solve_count:])

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,  # noqa: ARG002
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``."""
        return KernelDecoder(self, reference, query, held=held)


class KernelDecoder(FieldDecoder):
    """A kernel field bound to one body.

    Args:
        field: The kernel.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: KernelField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
    ) -> None:
        super().__init__(reference, query, held=held)
        self.field = field
        with torch.no_grad():
            self.around = field.neighborhood(reference, query)
            self.weights = field.weights(self.around)

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + the displacement that the kernel gives."""
        with torch.no_grad():
            displacement = position - self.reference
            return self.query + self.field.displacement(self.around, self.weights, displacement)
