"""A small convolutional network, an alternative to the transformer on the latent grid.

Every layer sees a few nodes around each, at distances that double from layer to layer, so that a
handful of layers sees the whole domain. The weights are the same at every node: away from the
boundary a field moved by a cell gives the result moved by a cell. It needs every node of the
grid: tokens come in a dense array (b t c), the last axis fastest. Dimensionless.
"""

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.mlp import MLP

__all__ = ["CONVOLUTIONS", "ConvolutionLayer", "GridConvolution"]

CONVOLUTIONS: dict[int, type[nn.Module]] = {2: nn.Conv2d, 3: nn.Conv3d}
"""Convolution on a grid of so many axes."""

DILATIONS = (1, 2, 4)
"""Distances, in nodes, between what successive layers see; then again from the first."""


class ConvolutionLayer(nn.Module):
    r"""A residual layer, :math:`v \leftarrow v + W\, \mathrm{GELU}(K * \mathrm{GELU}(v))`.

    :math:`K` is a kernel of three nodes along each axis and :math:`W` a matrix at every node.
    Beyond the boundary the field is zero.
    """

    def __init__(self, width: int, *, dimension: int, dilation: int) -> None:
        """Make the kernel and the matrix.

        Args:
            width: Channels.
            dimension: Axes of the grid.
            dilation: Distance between the nodes that the kernel sees.
        """
        super().__init__()
        convolution = CONVOLUTIONS[dimension]
        self.kernel = convolution(width, width, 3, padding=dilation, dilation=dilation)
        self.matrix = convolution(width, width, 1)

    def forward(self, value: Float[Tensor, "b c *grid"]) -> Float[Tensor, "b c *grid"]:
        """Update a field on the nodes of a regular grid, channels first."""
        return value + self.matrix(functional.gelu(self.kernel(functional.gelu(value))))


class GridConvolution(nn.Module):
    """Lift the tokens, run the convolutions on the grid, project.

    Source:
        Ji et al., "CoRGI" (arXiv:2511.22938), who add a convolutional network of several scales
        on a grid to message passing on particles. Several scales are had here by dilation, not by
        coarser grids, which would not move with the particles cell by cell.
    """

    def __init__(
        self, width_in: int, width: int, width_out: int, *, dimension: int, layers: int
    ) -> None:
        """Make the networks.

        Args:
            width_in: Channels of the incoming tokens.
            width: Channels inside.
            width_out: Channels of the outgoing tokens.
            dimension: Axes of the grid.
            layers: Number of convolutional layers.
        """
        super().__init__()
        self.dimension = dimension
        self.lifting = nn.Linear(width_in, width)
        self.layers = nn.ModuleList(
            ConvolutionLayer(
                width, dimension=dimension, dilation=DILATIONS[number % len(DILATIONS)]
            )
            for number in range(layers)
        )
        self.projection = MLP([width, width, width_out], activation=functional.gelu)

    def forward(self, token: Float[Tensor, "b t c"]) -> Float[Tensor, "b t o"]:
        """Process the tokens of all nodes of a grid with equal sides.

        Args:
            token: Features on the grid.

        Returns:
            New features on the grid.
        """
        side = round(token.shape[1] ** (1.0 / self.dimension))
        field = self.lifting(token).transpose(1, 2).unflatten(2, [side] * self.dimension)
        for layer in self.layers:
            field = layer(field)
        return self.projection(field.flatten(2).transpose(1, 2))
