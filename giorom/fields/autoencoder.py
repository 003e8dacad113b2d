"""The autoencoder baseline: a set encoder of the samples, a network that decodes any point.

The samples' displacement about their mean is brought to unit size, encoded point by point, pooled
over the samples, and turned into a latent vector z; a second network gives the displacement at X
from X and z. Mean and size are put back at the end, so that translations are exact and a resting
body rests. Unlike the linear bases it is not exact for anything else.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder, relative_error
from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig:
    """Size of encoder and decoder."""

    latent: int = 32
    """Length of the latent vector."""

    width: int = 96
    """Width of the hidden layers."""

    depth: int = 3
    """Hidden layers of the decoder."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        for name in ("latent", "width", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"AutoencoderConfig.{name} must be >= 1, got {getattr(self, name)!r}."
                )


class AutoencoderField(Field):
    """Point-set encoder and coordinate decoder.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        The nonlinear baseline of arXiv:2407.03925v2 for bodies of any number of points; pooling
        as in Qi et al., "PointNet", CVPR 2017.
    """

    scale: Tensor

    def __init__(self, config: AutoencoderConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.register_buffer("scale", torch.ones(2))
        width = config.width
        self.encoder = nn.Sequential(
            nn.Linear(2 * dimension, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
        )
        self.to_latent = nn.Linear(2 * width + 1, config.latent)
        layers: list[nn.Module] = [nn.Linear(dimension + config.latent + 1, width), nn.GELU()]
        for _ in range(config.depth - 1):
            layers += [nn.Linear(width, width), nn.GELU()]
        self.decoder = nn.Sequential(*layers, nn.Linear(width, dimension))

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Units of length: the spread of the bodies, and that of their displacements [m]."""
        bodies = [t.position[0] - t.position[0].mean(dim=0) for t in trajectories]
        moves = [_centered(t.position[1:] - t.position[0])[0] for t in trajectories]
        for number, parts in enumerate((bodies, moves)):
            squares = torch.stack([part.double().square().sum(dim=-1).mean() for part in parts])
            self.scale[number] = squares.mean().sqrt().clamp_min(1e-12)

    def displacement(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        displacement: Float[Tensor, "*t q d"],
    ) -> Float[Tensor, "*t p d"]:
        """Displacement of the query points from that of the samples [m]."""
        body, move = self.scale
        center = reference.mean(dim=0)
        shape, mean = _centered(displacement)
        size = shape.square().sum(dim=-1).mean(dim=-1).sqrt()[..., None, None]
        unit = shape / size.clamp_min(1e-12)
        level = torch.log(size / move + 1e-3)
        where = ((reference - center) / body).expand_as(unit)
        points = self.encoder(torch.cat([where, unit], dim=-1))
        pooled = torch.cat([points.mean(dim=-2), points.amax(dim=-2), level[..., 0]], dim=-1)
        latent = self.to_latent(pooled)[..., None, :]
        at = (query - center) / body
        count = (*latent.shape[:-2], len(query))
        inputs = [part.expand(*count, part.shape[-1]) for part in (at, latent, level)]
        return mean + size * self.decoder(torch.cat(inputs, dim=-1))

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error of the points that are not samples; see ``Field.loss``."""
        samples, query = reference[:solve_count], reference[solve_count:]
        found = self.displacement(samples, query, displacement[:, :solve_count])
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
        return AutoencoderDecoder(self, reference, query, held=held)


class AutoencoderDecoder(FieldDecoder):
    """An autoencoder bound to one body.

    Args:
        field: Encoder and decoder.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: AutoencoderField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
    ) -> None:
        super().__init__(reference, query, held=held)
        self.field = field

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + the decoded displacement."""
        with torch.no_grad():
            displacement = position - self.reference
            found = self.field.displacement(self.reference, self.query, displacement)
            return self.query + found


def _centered(displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Displacements less their mean over the points, and that mean."""
    mean = displacement.mean(dim=-2, keepdim=True)
    return displacement - mean, mean
