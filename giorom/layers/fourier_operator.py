"""The Fourier neural operator (FNO), an alternative to the transformer on the latent grid.

A Fourier layer multiplies the lowest frequencies of a field by learned matrices: a convolution
with a learned kernel as wide as the domain, taken as periodic. Coefficients are means over the
nodes, so that a finer grid of the same domain sees the same operator. It needs every node of the
grid: tokens come in a dense array (b t c), the last axis fastest. Dimensionless.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.mlp import MLP

__all__ = ["FourierLayer", "FourierOperator", "SpectralConvolution"]


class SpectralConvolution(nn.Module):
    r"""Multiply each low frequency by a matrix, :math:`u = F^{-1}(R \cdot F v) + b`.

    Frequencies :math:`-m/2, \dots, m/2 - 1` of every axis are kept, of the last one only
    :math:`0, \dots, m/2` (the field is real). Those that the grid cannot hold are not used.

    Source:
        Li et al., "Fourier Neural Operator for Parametric Partial Differential Equations", ICLR
        2021 (arXiv:2010.08895), equations 4 and 5.
    """

    def __init__(self, width: int, *, dimension: int, modes: int) -> None:
        """Make the matrices.

        Args:
            width: Channels.
            dimension: Axes of the grid.
            modes: Frequencies kept along each axis.
        """
        super().__init__()
        self.modes = modes
        shape = [width, width, *[modes] * (dimension - 1), modes // 2 + 1, 2]
        # Real and imaginary part last. White noise keeps its variance where all modes are kept.
        self.weight = nn.Parameter(torch.randn(shape) * math.sqrt(0.5 / width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, value: Float[Tensor, "b *grid c"]) -> Float[Tensor, "b *grid c"]:
        """Convolve a field.

        Args:
            value: Field on the nodes of a regular grid.

        Returns:
            The new field, never in less than single precision.
        """
        sides = value.shape[1:-1]
        axes = tuple(range(2, 2 + len(sides)))
        with torch.autocast(value.device.type, enabled=False):
            value = value.to(self.weight.dtype).movedim(-1, 1)
            spectrum = torch.fft.rfftn(value, dim=axes, norm="forward")
            nodes, entries = self._kept(sides, value.device)
            weight = torch.view_as_complex(self.weight)[:, :, *entries]
            product = torch.einsum("bi...,io...->bo...", spectrum[:, :, *nodes], weight)
            result = torch.zeros_like(spectrum)
            result[:, :, *nodes] = product
            convolved = torch.fft.irfftn(result, s=sides, dim=axes, norm="forward")
            return convolved.movedim(1, -1) + self.bias

    def _kept(
        self, sides: tuple[int, ...], device: torch.device
    ) -> tuple[list[Int[Tensor, "..."]], list[Int[Tensor, "..."]]]:
        """Places of the kept frequencies in the spectrum and in the weight, to be broadcast."""
        nodes, entries = [], []
        for axis, side in enumerate(sides):
            if axis == len(sides) - 1:
                frequency = torch.arange(min(self.modes, side) // 2 + 1, device=device)
                node, entry = frequency, frequency
            else:
                kept = min(self.modes, side)
                frequency = torch.arange(kept, device=device) - kept // 2
                node, entry = frequency % side, frequency + self.modes // 2
            shape = [1] * len(sides)
            shape[axis] = -1
            nodes.append(node.view(shape))
            entries.append(entry.view(shape))
        return nodes, entries


class FourierLayer(nn.Module):
    r"""One block, activation first.

    .. math::
        g = \mathrm{GELU}(v), \quad h = \mathcal{K}(\tanh g) + W g, \quad
        v \leftarrow \mathrm{MLP}(\sigma(h)) + s \odot g,

    with the spectral convolution :math:`\mathcal{K}`, a matrix W, a scale s for each channel
    and for :math:`\sigma` GELU, in the last block the identity.

    Source:
        Li et al. (arXiv:2010.08895), equation 2, in the variant that the first version of
        arXiv:2407.03925 takes from the neuraloperator library (pre-activation, tanh, channel
        MLP with a scaled skip).
    """

    def __init__(self, width: int, *, dimension: int, modes: int, last: bool) -> None:
        """Make the parts.

        Args:
            width: Channels.
            dimension: Axes of the grid.
            modes: Frequencies kept along each axis.
            last: Whether this is the last block.
        """
        super().__init__()
        self.convolution = SpectralConvolution(width, dimension=dimension, modes=modes)
        self.skip = nn.Linear(width, width, bias=False)
        self.channels = MLP([width, max(1, width // 2), width], activation=functional.gelu)
        self.scale = nn.Parameter(torch.ones(width))
        self.last = last

    def forward(self, value: Float[Tensor, "b *grid c"]) -> Float[Tensor, "b *grid c"]:
        """Update a field on the nodes of a regular grid."""
        value = functional.gelu(value)
        hidden = self.convolution(torch.tanh(value)) + self.skip(value)
        if not self.last:
            hidden = functional.gelu(hidden)
        return self.channels(hidden) + self.scale * value


class FourierOperator(nn.Module):
    """Lift the tokens, run the Fourier layers on the grid, project."""

    def __init__(
        self,
        width_in: int,
        width: int,
        width_out: int,
        *,
        dimension: int,
        layers: int,
        modes: int,
        hidden: int,
    ) -> None:
        """Make the networks.

        Args:
            width_in: Channels of the incoming tokens.
            width: Channels inside.
            width_out: Channels of the outgoing tokens.
            dimension: Axes of the grid.
            layers: Number of Fourier layers.
            modes: Frequencies kept along each axis.
            hidden: Hidden channels of lifting and projection.
        """
        super().__init__()
        self.dimension = dimension
        self.lifting = MLP([width_in, hidden, width], activation=functional.gelu)
        self.layers = nn.ModuleList(
            FourierLayer(width, dimension=dimension, modes=modes, last=number == layers - 1)
            for number in range(layers)
        )
        self.projection = MLP([width, hidden, width_out], activation=functional.gelu)

    def forward(self, token: Float[Tensor, "b t c"]) -> Float[Tensor, "b t o"]:
        """Process the tokens of all nodes of a grid with equal sides.

        Args:
            token: Features on the grid.

        Returns:
            New features on the grid.
        """
        side = round(token.shape[1] ** (1.0 / self.dimension))
        field = self.lifting(token).unflatten(1, [side] * self.dimension)
        for layer in self.layers:
            field = layer(field)
        return self.projection(field.flatten(1, self.dimension))
