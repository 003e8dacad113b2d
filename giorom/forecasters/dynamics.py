"""How a code changes in time: a learned ordinary differential equation dz/dt = F(z, s).

s is what does not change in time: where the undeformed body is and how large. A code describes
displacement and velocity of a frame, so that the equation is of first order in the code and of
second order in the motion. Times are in units of the stride of the training frames.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True, kw_only=True)
class DynamicsConfig:
    """Size of the network F."""

    width: int = 128
    """Width of the hidden layers."""

    depth: int = 3
    """Hidden layers."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        for name in ("width", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"DynamicsConfig.{name} must be >= 1, got {getattr(self, name)!r}."
                )

    @classmethod
    def published(cls) -> "DynamicsConfig":
        """The size in DINo and CORAL."""
        return cls(width=512)


class Swish(nn.Module):
    """x sigmoid(beta x) with a learned beta."""

    def __init__(self) -> None:
        super().__init__()
        self.beta = nn.Parameter(torch.ones(()))

    def forward(self, value: Tensor) -> Tensor:
        """The activation."""
        return value * torch.sigmoid(self.beta * value)


class LatentDynamics(nn.Module):
    """Neural ordinary differential equation of a code.

    Args:
        config: Size.
        code: Length of the code.
        context: Length of s.

    Source:
        Chen et al., "Neural ordinary differential equations", NeurIPS 2018.
    """

    def __init__(self, config: DynamicsConfig, *, code: int, context: int) -> None:
        super().__init__()
        self.config = config
        widths = [code + context, *([config.width] * config.depth)]
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [nn.Linear(inputs, outputs), Swish()]
        self.network = nn.Sequential(*layers, nn.Linear(config.width, code))

    def forward(
        self, code: Float[Tensor, "n c"], context: Float[Tensor, "n k"]
    ) -> Float[Tensor, "n c"]:
        """Rate of change of the code."""
        return self.network(torch.cat([code, context], dim=-1))

    def integrate(
        self,
        code: Float[Tensor, "n c"],
        context: Float[Tensor, "n k"],
        times: Float[Tensor, " t"],
    ) -> Float[Tensor, "t n c"]:
        """Codes at some times, the first of which is that of the given ones.

        One step of the classical Runge-Kutta method between every two times.
        """
        from torchdiffeq import odeint

        if len(times) == 1:
            return code[None]
        return odeint(lambda _, value: self(value, context), code, times, method="rk4")
