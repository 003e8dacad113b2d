"""Pointwise multilayer perceptrons: the kernels and encoders every layer is built from.

Used by stage 4 only. A pointwise network acts on the last axis alone, so it never depends on
how many points a body is sampled with. Everything here is dimensionless.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["MLP", "ResidualMLP", "relu"]


def relu(value: Tensor) -> Tensor:
    """Rectify in place; for the outputs of linear layers, which nothing else reads."""
    return functional.relu(value, inplace=True)


class MLP(nn.Module):
    """Linear layers with an activation between them and, if wanted, a LayerNorm at the end."""

    def __init__(
        self,
        widths: Sequence[int],
        *,
        activation: Callable[[Tensor], Tensor],
        layer_norm: bool = False,
        unit_variance: bool = False,
    ) -> None:
        """Make the layers.

        Args:
            widths: Input width, hidden widths, output width.
            activation: Applied after every linear layer but the last.
            layer_norm: Normalise the output.
            unit_variance: Draw the weights from N(0, 1 / fan_in) and start from zero biases
                (the networks of the interaction operators) rather than PyTorch's default.

        Raises:
            ValueError: If fewer than two widths are given.
        """
        super().__init__()
        if len(widths) < 2:
            raise ValueError(
                f"an MLP needs an input and an output width, got widths={list(widths)!r}. "
                f"Give at least two."
            )
        self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(widths))
        self.norm = nn.LayerNorm(widths[-1]) if layer_norm else None
        self.activation = activation
        if unit_variance:
            for layer in self.layers:
                nn.init.normal_(layer.weight, std=1.0 / math.sqrt(layer.in_features))
                nn.init.zeros_(layer.bias)

    def forward(self, value: Float[Tensor, "... i"]) -> Float[Tensor, "... o"]:
        """Map each point on its own."""
        return self.finish(self.layers[0](value))

    def finish(self, value: Float[Tensor, "... h"]) -> Float[Tensor, "... o"]:
        """Do everything that follows the first linear layer.

        Callers that know structure in the input (a sum over parts that repeat) evaluate the
        first layer themselves from slices of its weight and hand its output over here.

        Args:
            value: Output of the first linear layer; may be overwritten.

        Returns:
            Output of the network.
        """
        for layer in self.layers[1:]:
            value = layer(self.activation(value))
        return value if self.norm is None else self.norm(value)


class ResidualMLP(nn.Module):
    """Linear, GELU, residual layers ``h + GELU(Linear(h))``, Linear (GNOT's pointwise net)."""

    def __init__(self, width_in: int, hidden: int, width_out: int, *, depth: int = 1) -> None:
        """Make the layers.

        Args:
            width_in: Input channels.
            hidden: Channels of every hidden layer.
            width_out: Output channels.
            depth: Number of residual layers.
        """
        super().__init__()
        self.first = nn.Linear(width_in, hidden)
        self.residuals = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(depth))
        self.last = nn.Linear(hidden, width_out)

    def forward(self, value: Float[Tensor, "... i"]) -> Float[Tensor, "... o"]:
        """Map each point on its own."""
        value = functional.gelu(self.first(value))
        for residual in self.residuals:
            value = value + functional.gelu(residual(value))
        return self.last(value)
