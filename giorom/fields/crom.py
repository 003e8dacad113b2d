"""A nonlinear decoder of points and a code, whose code is solved for: CROM.

    phi(X) = X + s [g(X, q) - g(X, 0)],

with a network g and few coefficients q. As for every field here, q of a frame follows from the
samples: an encoder of the samples gives the first guess and damped Gauss-Newton steps on the
misfit at the samples refine it. Published CROM encodes all particles in a fixed order; a set
encoder (PointNet) takes any number in any order. Trained with the code of the encoder, on new
points and frames in every step, which codes stored per frame would not allow.

Subtracting g(X, 0), and the encoder's answer to a body at rest, makes a body at rest rest.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.fields.contract import Field, FieldDecoder, relative_error
from giorom.fields.gauss_newton import gauss_newton
from giorom.state import Trajectory

QUERIES_AT_ONCE = 1 << 14
"""Query points that are decoded together; bounds the memory."""

TRAINED_POINTS = 64
"""Most points of a frame that are compared in a training step."""


@dataclass(frozen=True, kw_only=True)
class CromConfig:
    """Size of decoder and encoder, and how the code is solved for."""

    latent: int = 32
    """Length of the code q."""

    width: int = 128
    """Width of the hidden layers of the decoder."""

    depth: int = 5
    """Hidden layers of the decoder."""

    activation: Literal["elu", "sine"] = "elu"
    """Activation after every hidden layer."""

    frequency: float = 1.0
    """Factor of the argument of the sine. With the published 30 nothing is learned in minutes."""

    encoder_width: int = 96
    """Width of the encoder of the samples."""

    iterations: int = 6
    """Gauss-Newton steps of a frame; 0: the encoder's code is kept."""

    damping: float = 1e-4
    """Damping of the steps, relative to the mean of the diagonal of the normal matrix."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        for name in ("latent", "width", "depth", "encoder_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"CromConfig.{name} must be >= 1, got {getattr(self, name)!r}.")
        for name in ("iterations", "damping"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"CromConfig.{name} must be >= 0, got {getattr(self, name)!r}.")
        if not self.frequency > 0.0:
            raise ValueError(f"CromConfig.frequency must be > 0, got {self.frequency!r}.")

    @classmethod
    def published(cls) -> "CromConfig":
        """The size of the published code: six coefficients, width 30."""
        return cls(latent=6, width=30)


class CodedNetwork(nn.Module):
    """The network g(X, q), with its Jacobian in q; no last bias, which g(X, 0) would cancel.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, config: CromConfig, *, dimension: int) -> None:
        super().__init__()
        self.sine = config.frequency if config.activation == "sine" else None
        self.place = nn.Linear(dimension, config.width)
        self.code = nn.Linear(config.latent, config.width, bias=False)
        widths = [config.width] * config.depth
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.output = nn.Linear(config.width, dimension, bias=False)
        for layer in (self.place, self.code, *self.hidden, self.output):
            if self.sine is None:
                nn.init.xavier_uniform_(layer.weight)
            else:  # the first layer spreads over periods, the others keep the variance
                first = layer in (self.place, self.code)
                fan = layer.in_features
                limit = 1.0 / fan if first else (6.0 / fan) ** 0.5 / self.sine
                nn.init.uniform_(layer.weight, -limit, limit)
        for layer in (self.place, *self.hidden):
            nn.init.zeros_(layer.bias)

    def forward(
        self, point: Float[Tensor, "p d"], code: Float[Tensor, "*t r"]
    ) -> Float[Tensor, "*t p d"]:
        """Values at every point for every code."""
        value = self._activation(self.place(point) + self.code(code)[..., None, :])
        for layer in self.hidden:
            value = self._activation(layer(value))
        return self.output(value)

    def linearize(
        self, point: Float[Tensor, "p d"], code: Float[Tensor, " r"]
    ) -> tuple[Float[Tensor, "p d"], Float[Tensor, "p d r"]]:
        """Values and their Jacobian in the code, by the chain rule from the output backwards."""
        level = self.place(point) + self.code(code)
        slopes, value = [self._slope(level)], self._activation(level)
        for layer in self.hidden:
            level = layer(value)
            slopes.append(self._slope(level))
            value = self._activation(level)
        back = self.output.weight * slopes[-1][:, None]
        for layer, slope in zip(reversed(self.hidden), reversed(slopes[:-1]), strict=True):
            back = (back @ layer.weight) * slope[:, None]
        return self.output(value), back @ self.code.weight

    def _activation(self, level: Tensor) -> Tensor:
        return nn.functional.elu(level) if self.sine is None else torch.sin(self.sine * level)

    def _slope(self, level: Tensor) -> Tensor:
        if self.sine is None:
            return level.clamp(max=0.0).exp()
        return self.sine * torch.cos(self.sine * level)


class CromField(Field):
    """Nonlinear coordinate decoder and set encoder.

    Args:
        config: Size.
        dimension: Space dimension, 2 or 3.

    Source:
        Chen et al., "CROM: Continuous reduced-order modeling of PDEs using implicit neural
        representations", ICLR 2023; pooling as in Qi et al., "PointNet", CVPR 2017.
    """

    center: Tensor
    scale: Tensor
    size: Tensor

    def __init__(self, config: CromConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config
        self.register_buffer("center", torch.zeros(dimension))
        self.register_buffer("scale", torch.ones(dimension))
        self.register_buffer("size", torch.ones(()))
        self.network = CodedNetwork(config, dimension=dimension)
        width = config.encoder_width
        self.encoder = nn.Sequential(
            nn.Linear(2 * dimension, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
        )
        self.to_code = nn.Linear(2 * width, config.latent, bias=False)

    def prepare(self, trajectories: list[Trajectory]) -> None:
        """Units of length: the spread of the bodies, and the size of their displacements [m]."""
        bodies = torch.cat([t.position[0] for t in trajectories])
        self.center.copy_(bodies.mean(dim=0))
        self.scale.copy_(bodies.std(dim=0).clamp_min(1e-6))
        squares = [(t.position[1:] - t.position[0]).double().square().mean() for t in trajectories]
        self.size.copy_(torch.stack(squares).mean().sqrt().clamp_min(1e-12))

    def point(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, "p d"]:
        """Undeformed positions in the units of the network."""
        return (reference - self.center) / self.scale

    def encode(
        self, point: Float[Tensor, "q d"], moved: Float[Tensor, "*t q d"]
    ) -> Float[Tensor, "*t r"]:
        """First guess of the code from points and displacements in the units of the network."""
        pooled = []
        alike = moved[:1] if moved.dim() > 2 else moved  # one frame at rest is like any other
        for value in (moved, torch.zeros_like(alike)):
            each = self.encoder(torch.cat([point.expand_as(value), value], dim=-1))
            pooled.append(torch.cat([each.mean(dim=-2), each.amax(dim=-2)], dim=-1))
        return self.to_code(pooled[0] - pooled[1])

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error of some points with the encoder's code; see ``Field.loss``."""
        point = self.point(reference)
        code = self.encode(point[:solve_count], displacement[:, :solve_count] / self.size)
        # The network is dear: fewer points and more steps learn faster.
        chosen = slice(solve_count, solve_count + TRAINED_POINTS)
        point = point[chosen]
        found = self.network(point, code) - self.network(point, torch.zeros_like(code[:1]))
        return relative_error(self.size * found, displacement[:, chosen])

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,  # noqa: ARG002
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``."""
        return CromDecoder(self, reference, query, held=held)


class CromDecoder(FieldDecoder):
    """A nonlinear field bound to one body.

    Args:
        field: Decoder and encoder.
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
    """

    def __init__(
        self,
        field: CromField,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
    ) -> None:
        super().__init__(reference, query, held=held)
        self.field = field
        with torch.no_grad():
            self.sample = field.point(reference)
            self.parts = field.point(query).split(QUERIES_AT_ONCE)
            rest = reference.new_zeros(field.config.latent)
            self.sample_rest = field.network.linearize(self.sample, rest)[0]
            self.rest = [field.network(part, rest) for part in self.parts]

    def code(self, position: Float[Tensor, "q d"]) -> Float[Tensor, " r"]:
        """The code that fits the samples."""
        field, config = self.field, self.field.config
        with torch.no_grad():
            moved = (position - self.reference) / field.size
            start = field.encode(self.sample, moved)

            def linearize(code: Tensor) -> tuple[Tensor, Tensor]:
                value, jacobian = field.network.linearize(self.sample, code)
                return (value - self.sample_rest).flatten(), jacobian.flatten(0, 1)

            return gauss_newton(
                linearize,
                moved.flatten(),
                start,
                iterations=config.iterations,
                damping=config.damping,
            )

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """X + the decoded displacement."""
        code = self.code(position)
        with torch.no_grad():
            found = [
                self.field.network(part, code) - rest
                for part, rest in zip(self.parts, self.rest, strict=True)
            ]
            return self.query + self.field.size * torch.cat(found)
