"""A coded field with a differential equation of its code: first frames in, a whole motion out."""

from dataclasses import dataclass
from dataclasses import field as default
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.forecasters.coded_field import CodedField
from giorom.forecasters.coral import CoralConfig, CoralField
from giorom.forecasters.dino import DinoConfig, DinoField
from giorom.forecasters.dynamics import DynamicsConfig, LatentDynamics
from giorom.forecasters.motions import Motions


@dataclass(frozen=True, kw_only=True)
class ForecasterConfig:
    """Which coded field, and the sizes."""

    kind: Literal["dino", "coral"] = "dino"
    """The coded field that is used."""

    dino: DinoConfig = default(default_factory=DinoConfig)
    """Auto-decoded filter network."""

    coral: CoralConfig = default(default_factory=CoralConfig)
    """Meta-learned network of sines."""

    dynamics: DynamicsConfig = default(default_factory=DynamicsConfig)
    """The differential equation."""

    @classmethod
    def published(cls, kind: Literal["dino", "coral"]) -> "ForecasterConfig":
        """The published sizes."""
        return cls(
            kind=kind,
            dino=DinoConfig.published(),
            coral=CoralConfig.published(),
            dynamics=DynamicsConfig.published(),
        )


class LatentForecaster(nn.Module):
    """Coded field and latent dynamics, with the units of both.

    Args:
        config: Sizes.
        dimension: Space dimension, 2 or 3.
    """

    center: Tensor
    extent: Tensor
    size: Tensor
    context_mean: Tensor
    context_scale: Tensor
    code_mean: Tensor
    code_scale: Tensor
    stride: Tensor

    def __init__(self, config: ForecasterConfig, *, dimension: int) -> None:
        super().__init__()
        self.config, self.dimension = config, dimension
        sizes = {"dimension": dimension, "states": 2 * dimension}
        self.field: CodedField = (
            DinoField(config.dino, **sizes)
            if config.kind == "dino"
            else CoralField(config.coral, **sizes)
        )
        code, context = self.field.code, 2 * dimension
        self.dynamics = LatentDynamics(config.dynamics, code=code, context=context)
        self.register_buffer("center", torch.zeros(dimension))
        self.register_buffer("extent", torch.ones(()))
        self.register_buffer("size", torch.ones(2 * dimension))
        self.register_buffer("context_mean", torch.zeros(context))
        self.register_buffer("context_scale", torch.ones(context))
        self.register_buffer("code_mean", torch.zeros(code))
        self.register_buffer("code_scale", torch.ones(()))
        self.register_buffer("stride", torch.ones(()))

    def prepare(self, motions: Motions) -> None:
        """Units of place, state, context and time."""
        low, high = motions.point.amin(dim=(0, 1)), motions.point.amax(dim=(0, 1))
        self.center.copy_((low + high) / 2)
        self.extent.copy_(((high - low) / 2).amax().clamp_min(1e-12))
        squares = motions.state.double().square().mean(dim=(0, 1, 2)).unflatten(0, (2, -1))
        size = squares.mean(dim=1).sqrt().clamp_min(1e-12)
        self.size.copy_(size.repeat_interleave(self.dimension))
        context = torch.stack([self._raw_context(point) for point in motions.point])
        self.context_mean.copy_(context.mean(dim=0))
        self.context_scale.copy_(context.std(dim=0, correction=0).clamp_min(1e-3))
        self.stride.fill_(motions.stride)

    def set_codes(self, code: Float[Tensor, "n c"]) -> None:
        """Units of the code in which its equation is learned."""
        self.code_mean.copy_(code.mean(dim=0))
        self.code_scale.copy_(code.std(dim=0, correction=0).square().mean().sqrt().clamp_min(1e-9))

    def place(self, reference: Float[Tensor, "*n p d"]) -> Float[Tensor, "*n p d"]:
        """Undeformed positions in the units of the field."""
        return (reference - self.center) / self.extent

    def context(self, reference: Float[Tensor, "p d"]) -> Float[Tensor, " k"]:
        """Where the undeformed body is and how large, in units of the training bodies."""
        return (self._raw_context(reference) - self.context_mean) / self.context_scale

    def _raw_context(self, reference: Tensor) -> Tensor:
        place = self.place(reference)
        return torch.cat([place.mean(dim=0), place.std(dim=0, correction=0)])

    def encode(
        self, reference: Float[Tensor, "q d"], position: Float[Tensor, "w q d"]
    ) -> Float[Tensor, " c"]:
        """Code of the last of some frames from its samples.

        Args:
            reference: Undeformed positions of the samples [m].
            position: Their positions at two or more frames in a row [m].
        """
        state = torch.cat([position[-1] - reference, position[-1] - position[-2]], dim=-1)
        point = self.place(reference)
        return self.field.fit(point[None], (state / self.size)[None])[0]

    def decode(
        self, code: Float[Tensor, "t c"], query: Float[Tensor, "p d"]
    ) -> Float[Tensor, "t p d"]:
        """Positions of all points for many codes [m]."""
        state = self.field.decode(self.place(query), code) * self.size
        return query + state[..., : self.dimension]

    def forecast(
        self,
        reference: Float[Tensor, "q d"],
        given: Float[Tensor, "w q d"],
        query: Float[Tensor, "p d"],
        *,
        frames: int,
        held: Bool[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "t p d"]:
        """Positions of all points at the frames after the given ones [m].

        Args:
            reference: Undeformed positions of the samples [m].
            given: Positions of the samples at the frames that are known, two or more [m].
            query: Undeformed positions of all points [m].
            frames: Number of frames to forecast.
            held: Points that never move.

        Raises:
            ValueError: If fewer than two frames are given.
        """
        if len(given) < 2:
            raise ValueError(
                f"a forecast needs two given frames, for the velocity, got {len(given)}. Give more."
            )
        with torch.no_grad():
            start = (self.encode(reference, given) - self.code_mean) / self.code_scale
            times = torch.arange(frames + 1).to(start) / self.stride
            context = self.context(query)
            path = self.dynamics.integrate(start[None], context[None], times)[1:, 0]
            found = self.decode(path * self.code_scale + self.code_mean, query)
        return found if held is None else torch.where(held[:, None], query, found)
