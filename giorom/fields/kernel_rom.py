"""The kernel reduced-order model of the paper's third version, at its published size.

Displacements and a few features of the samples are smoothed to every point with a kernel of fixed
width over the undeformed body, and a network of the smoothed values and of the place corrects:

    phi(X) = X + u(X) + s [R(f(X), u(X) / s, gamma(X)) - R(f_0(X), 0, gamma(X))],
    f = GELU(W u_k / s + b),   gamma(X) = sin, cos(2^l pi X).

As published: what is smoothed, and the network (5,967 parameters in space, of which the three last
biases would cancel here). Changed: the kernel is a Gaussian over the nearest samples instead of a
random look-up in a grid, its width is in units of the spacing of the samples, no point is without
neighbours, positions are not clipped, and what R says of a body at rest is subtracted. ``kernel``
is the same idea with a learned width.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder, relative_error
from giorom.fields.neighbors import body_labels, nearest_samples, sample_spacing
from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class KernelRomConfig:
    """Size of the kernel and of the network."""

    neighbors: int = 12
    """Samples in a neighbourhood."""

    width: float = 0.6
    """Standard deviation of the Gaussian in units of the spacing of the samples; that of the
    published grid and look-up at their published number of samples."""

    channels: int = 3
    """Features smoothed beside the displacement."""

    octaves: int = 3
    """Frequencies of the place."""

    hidden: int = 64
    """Width of the network's two hidden layers."""

    def __post_init__(self) -> None:
        """Reject sizes no kernel can be built with."""
        for name in ("neighbors", "channels", "octaves", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"KernelRomConfig.{name} must be >= 1, got {getattr(self, name)!r}."
                )
        if not self.width > 0.0:
            raise ValueError(f"KernelRomConfig.width must be > 0, got {self.width!r}.")


@dataclass(frozen=True, kw_only=True)
class Smoothing:
    """What is fixed for one body: who speaks for each point and how loud, and where it is."""

    index: Tensor
    """Samples around each point, (p k)."""

    weights: Tensor
    """Their weights, (p k)."""

    place: Tensor
    """Sines and cosines of the place, (p c)."""


class KernelRomField(Field):
    """Kernel of fixed width with a pointwise network.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        Public code of the GIOROM authors for "Learning Lagrangian Interaction Dynamics with
        Sampling-Based Model Order Reduction" (arXiv:2407.03925v3 and later); facts only.
    """

    low: Tensor
    extent: Tensor

    def __init__(self, config: KernelRomConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.register_buffer("low", torch.zeros(dimension))
        self.register_buffer("extent", torch.ones(()))
        self.content = nn.Linear(dimension, config.channels)
        inputs = config.channels + dimension + 2 * config.octaves * dimension
        self.network = nn.Sequential(
            nn.Linear(inputs, config.hidden),
            nn.GELU(),
            nn.Linear(config.hidden, config.hidden),
            nn.GELU(),
            nn.Linear(config.hidden, dimension, bias=False),
        )

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Unit of length: the largest extent of all training positions [m]."""
        positions = torch.cat([t.position.flatten(0, 1) for t in trajectories])
        low, high = positions.amin(dim=0), positions.amax(dim=0)
        self.low.copy_(low)
        self.extent.copy_((high - low).amax().clamp_min(1e-12))

    def smoothing(self, reference: Float[Tensor, "q d"], query: Float[Tensor, "p d"]) -> Smoothing:
        """What is fixed for one body."""
        labels = body_labels(reference, query, least=self.dimension + 1)
        index, same = nearest_samples(reference, query, count=self.config.neighbors, labels=labels)
        width = self.config.width * sample_spacing(reference)
        distance = (query[:, None] - reference[index]) / width
        exponent = (-0.5 * distance.square().sum(dim=2)).masked_fill(~same, -torch.inf)
        octave = 2.0 ** torch.arange(self.config.octaves).to(query)
        angle = torch.pi * ((query - self.low) / self.extent)[..., None] * octave
        place = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(1)
        return Smoothing(index=index, weights=exponent.softmax(dim=1), place=place)

    def displacement(
        self, smoothing: Smoothing, displacement: Float[Tensor, "*t q d"]
    ) -> Float[Tensor, "*t p d"]:
        """Displacement of the query points from that of the samples [m]."""

        def smoothed(value: Tensor) -> Tensor:
            around = value[..., smoothing.index, :]
            return torch.einsum("pk,...pkc->...pc", smoothing.weights, around)

        def corrected(moved: Tensor, mean: Tensor) -> Tensor:
            feature = smoothed(nn.functional.gelu(self.content(moved)))
            place = smoothing.place.expand(*mean.shape[:-1], -1)
            return self.network(torch.cat([feature, mean, place], dim=-1))

        moved = displacement / self.extent
        mean = smoothed(moved)
        rest = corrected(torch.zeros_like(moved), torch.zeros_like(mean))
        return self.extent * (mean + corrected(moved, mean) - rest)

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error of the points that are not samples; see ``Field.loss``."""
        smoothing = self.smoothing(reference[:solve_count], reference[solve_count:])
        found = self.displacement(smoothing, displacement[:, :solve_count])
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
        return KernelRomDecoder(self, reference, query, held=held)


class KernelRomDecoder(FieldDecoder):
    """A kernel field bound to one body.

    Args:
        field: The kernel and its network.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: KernelRomField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
    ) -> None:
        super().__init__(reference, query, held=held)
        self.field = field
        with torch.no_grad():
            self.smoothing = field.smoothing(reference, query)

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + the displacement that the kernel gives."""
        with torch.no_grad():
            moved = position - self.reference
            return self.query + self.field.displacement(self.smoothing, moved)
