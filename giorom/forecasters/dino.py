"""The field of DINo: a Fourier multiplicative filter network whose layers are shifted by the code.

    h_0 = f_0(x) (A_0 c + b_0),   h_l = f_l(x) (B_l h_{l-1} + b_l + A_l c),

with f_l = [sin, cos](W_l x + p_l).

Auto-decoded: training keeps a code for every frame and descends on it; the code of a new frame is
found by gradient descent with the network frozen.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.forecasters.coded_field import CodedField, check_sizes


@dataclass(frozen=True, kw_only=True)
class DinoConfig:
    """Size of the network, and how codes are found."""

    code: int = 64
    """Length of the code."""

    width: int = 64
    """Width of the layers; even."""

    layers: int = 3
    """Multiplicative layers after the first."""

    frequency: float = 8.0
    """Scale of the frequencies. The published 64 is for images; between the few points of a body
    it invents what is not there."""

    fit_steps: int = 300
    """Steps of the descent for the code of a new frame."""

    fit_rate: float = 1e-2
    """Its learning rate."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        check_sizes(
            self,
            counts=("code", "width", "layers", "fit_steps"),
            positive=("frequency", "fit_rate"),
        )
        if self.width % 2:
            raise ValueError(
                f"DinoConfig.width must be even, half sines and half cosines, got {self.width!r}."
            )

    @classmethod
    def published(cls) -> "DinoConfig":
        """The published size and frequencies (Navier-Stokes)."""
        return cls(code=100, frequency=64.0)


class DinoField(CodedField):
    """Fourier multiplicative filter network.

    Args:
        config: Size.
        dimension: Space dimension.
        states: Numbers that make a state.

    Source:
        Yin et al., "Continuous PDE dynamics forecasting with implicit neural representations",
        ICLR 2023; Fathony et al., "Multiplicative filter networks", ICLR 2021.
    """

    stores_codes = True

    def __init__(self, config: DinoConfig, *, dimension: int, states: int) -> None:
        super().__init__(config.code)
        self.config = config
        width, count = config.width, config.layers + 1
        self.filters = nn.ModuleList(nn.Linear(dimension, width // 2) for _ in range(count))
        self.shifts = nn.ModuleList(nn.Linear(config.code, width, bias=False) for _ in range(count))
        self.first = nn.Parameter(torch.rand(width) / width)
        self.mixers = nn.ModuleList(nn.Linear(width, width) for _ in range(config.layers))
        self.output = nn.Linear(width, states)
        for layer in self.filters:
            limit = config.frequency / math.sqrt(count * dimension)
            nn.init.uniform_(layer.weight, -limit, limit)
            nn.init.uniform_(layer.bias, -math.pi, math.pi)
        for layer in self.mixers:
            limit = math.sqrt(6.0 / width)
            nn.init.uniform_(layer.weight, -limit, limit)

    def forward(
        self, point: Float[Tensor, "n p d"], code: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n p s"]:
        """State at the points of some frames."""
        value = self.first.expand(1, 1, -1)
        for number, (layer, shift) in enumerate(zip(self.filters, self.shifts, strict=True)):
            angle = layer(point)
            wave = torch.cat([angle.sin(), angle.cos()], dim=-1)
            mixed = value if number == 0 else self.mixers[number - 1](value)
            value = wave * (mixed + shift(code)[:, None])
        return self.output(value)

    def fit(
        self, point: Float[Tensor, "n p d"], state: Float[Tensor, "n p s"]
    ) -> Float[Tensor, "n c"]:
        """Codes by gradient descent from zero."""
        code = state.new_zeros(len(state), self.code, requires_grad=True)
        optimizer = torch.optim.Adam([code], lr=self.config.fit_rate)
        with torch.enable_grad():
            for _ in range(self.config.fit_steps):
                error = self.misfit(point, state, code)
                (code.grad,) = torch.autograd.grad(error, [code])
                optimizer.step()
        return code.detach()

    def loss(
        self,
        point: Float[Tensor, "n p d"],
        state: Float[Tensor, "n p s"],
        code: Float[Tensor, "n c"] | None,
    ) -> Float[Tensor, ""]:
        """Mean squared error with the stored codes."""
        if code is None:
            raise ValueError("DinoField is trained with stored codes, got none. Pass them.")
        return (self(point, code) - state).square().mean()
