"""The field of CORAL: a network of sines whose layers are shifted by a linear map of the code.

    h_l = sin(w (W_l h_{l-1} + b_l + S_l z)),   l = 1 ... L.

The code of a frame is the result of a few gradient steps from zero on the misfit at some of its
points. Training descends through these steps (second-order meta-learning) on the misfit at all.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.forecasters.coded_field import CodedField, check_sizes


@dataclass(frozen=True, kw_only=True)
class CoralConfig:
    """Size of the network, and how codes are found."""

    code: int = 64
    """Length of the code z."""

    width: int = 64
    """Width of the hidden layers."""

    layers: int = 3
    """Hidden layers."""

    frequency: float = 5.0
    """Factor w of the argument of the sine. The published 30 is for images; see ``DinoConfig``."""

    fit_steps: int = 3
    """Gradient steps to a code."""

    fit_rate: float = 3e-2
    """Their rate. The published 1e-2 belongs to a training of ten thousand epochs."""

    def __post_init__(self) -> None:
        """Reject sizes no network can be built with."""
        check_sizes(
            self,
            counts=("code", "width", "layers", "fit_steps"),
            positive=("frequency", "fit_rate"),
        )

    @classmethod
    def published(cls) -> "CoralConfig":
        """The published size, frequency and rate (Navier-Stokes)."""
        return cls(code=128, width=128, frequency=30.0, fit_rate=1e-2)


class CoralField(CodedField):
    """Modulated network of sines.

    Args:
        config: Size.
        dimension: Space dimension.
        states: Numbers that make a state.

    Source:
        Serrano et al., "Operator learning with neural fields: tackling PDEs on general
        geometries", NeurIPS 2023; Sitzmann et al., "Implicit neural representations with periodic
        activation functions", NeurIPS 2020.
    """

    def __init__(self, config: CoralConfig, *, dimension: int, states: int) -> None:
        super().__init__(config.code)
        self.config = config
        widths = [dimension, *([config.width] * config.layers)]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.shift = nn.Linear(config.code, config.width * config.layers)
        self.output = nn.Linear(config.width, states)
        for number, layer in enumerate([*self.hidden, self.output]):
            fan = layer.in_features
            limit = 1.0 / fan if number == 0 else math.sqrt(6.0 / fan) / config.frequency
            nn.init.uniform_(layer.weight, -limit, limit)
        nn.init.zeros_(self.shift.bias)

    def forward(
        self, point: Float[Tensor, "n p d"], code: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n p s"]:
        """State at the points of some frames."""
        value = point
        shifts = self.shift(code)[:, None].chunk(len(self.hidden), dim=-1)
        for layer, shift in zip(self.hidden, shifts, strict=True):
            value = torch.sin(self.config.frequency * (layer(value) + shift))
        return self.output(value)

    def fit(
        self, point: Float[Tensor, "n p d"], state: Float[Tensor, "n p s"]
    ) -> Float[Tensor, "n c"]:
        """Codes by a few gradient steps from zero."""
        with torch.enable_grad():
            return self._steps(point, state, differentiable=False).detach()

    def loss(
        self,
        point: Float[Tensor, "n p d"],
        state: Float[Tensor, "n p s"],
        code: Float[Tensor, "n c"] | None,
    ) -> Float[Tensor, ""]:
        """Mean squared error at all points with the code of the first half of them."""
        if code is not None:
            raise ValueError("CoralField finds its codes and stores none, got some. Pass None.")
        known = point.shape[1] // 2
        found = self._steps(point[:, :known], state[:, :known], differentiable=True)
        return (self(point, found) - state).square().mean()

    def _steps(self, point: Tensor, state: Tensor, *, differentiable: bool) -> Tensor:
        code = state.new_zeros(len(state), self.code, requires_grad=True)
        for _ in range(self.config.fit_steps):
            error = self.misfit(point, state, code)
            (slope,) = torch.autograd.grad(error, [code], create_graph=differentiable)
            code = code - self.config.fit_rate * slope
            if not differentiable:
                code = code.detach().requires_grad_(True)
        return code
