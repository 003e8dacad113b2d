"""Physics attention: tokens exchange information through a few learned slices of their set.

The processor of Transolver, an alternative to the operator transformer with the same interface:
on the latent grid, or on the particles themselves. Every token spreads a weight of one over the
slices, a slice is the mean of its tokens, the slices attend to each other, and every token reads
its slices back; the cost is linear in the number of tokens. Tokens come in a dense array (b t c);
a mask marks the ones that exist. Dimensionless.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.mlp import MLP

__all__ = ["PhysicsAttention", "PhysicsBlock", "PhysicsTransformer"]

EMPTY_SLICE = 1e-5
"""Added to the weight of a slice: one that no token belongs to is zero, not 0/0."""

FIRST_TEMPERATURE = 0.5
"""Temperature of the slicing where training starts."""

TEMPERATURES = (0.1, 5.0)
"""Range the temperature is kept in; below it slices are hard and above it all alike."""

WEIGHT_STD = 0.02
"""Spread of the truncated normal distribution that weights are drawn from."""


class PhysicsAttention(nn.Module):
    r"""Attention among slices of the token set, one set of slices per head.

    With values :math:`f = x W_f`, in every head of ``width / heads`` channels,

    .. math::
        w_{ng} = \mathrm{softmax}_g\!\left(\frac{(x_n W_x) W_s}{\tau}\right), \quad
        z_g = \frac{\sum_n w_{ng} f_n}{\sum_n w_{ng} + \epsilon}, \quad
        z'_g = \sum_h \mathrm{softmax}_h\!\left(\frac{q_g \cdot k_h}{\sqrt{c}}\right) v_h, \quad
        x'_n = \sum_g w_{ng} z'_g,

    where q, k and v are linear maps of z shared by the heads, and a linear layer joins the heads.

    Source:
        Wu et al., "Transolver", ICML 2024 (arXiv:2402.02366), physics attention for irregular
        meshes.
    """

    def __init__(self, width: int, *, heads: int, slices: int, dropout: float = 0.0) -> None:
        """Make the maps.

        Args:
            width: Channels of the tokens; a multiple of ``heads``.
            heads: Number of heads.
            slices: Slices per head.
            dropout: Share of what is given back that is set to zero in training.

        Raises:
            ValueError: If the heads do not divide the width.
        """
        super().__init__()
        if width % heads:
            raise ValueError(
                f"physics attention gives every head the same number of channels, but heads="
                f"{heads} does not divide width={width}. Choose a multiple of the heads."
            )
        channels = width // heads
        self.heads = heads
        self.place = nn.Linear(width, width)
        self.content = nn.Linear(width, width)
        self.slice = nn.Linear(channels, slices)
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.out = nn.Linear(width, width)
        self.temperature = nn.Parameter(torch.full((heads, 1, 1), FIRST_TEMPERATURE))
        self.dropout = nn.Dropout(dropout)
        _draw_weights(self)
        nn.init.orthogonal_(self.slice.weight)

    def forward(
        self, token: Float[Tensor, "b t c"], mask: Bool[Tensor, "b t"] | None = None
    ) -> Float[Tensor, "b t c"]:
        """Let the tokens of each sample exchange information.

        Args:
            token: Tokens.
            mask: False for tokens that do not exist; what is returned for them means nothing.

        Returns:
            New features of the tokens.
        """
        temperature = self.temperature.clamp(*TEMPERATURES)
        weight = (self.slice(self._split(self.place(token))) / temperature).softmax(dim=-1)
        if mask is not None:
            weight = weight * mask[:, None, :, None]
        total = weight.sum(dim=2)[..., None] + EMPTY_SLICE
        mean = weight.transpose(-1, -2) @ self._split(self.content(token)) / total
        mixed = functional.scaled_dot_product_attention(
            self.query(mean), self.key(mean), self.value(mean)
        )
        read = weight.to(mixed.dtype) @ mixed
        return self.dropout(self.out(read.transpose(1, 2).flatten(2)))

    def _split(self, value: Tensor) -> Tensor:
        """Put the heads in front of the tokens: (b t c) to (b heads t c/heads)."""
        return value.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class PhysicsBlock(nn.Module):
    r"""Attention, then a pointwise network, each beside a residual connection.

    .. math::
        x \leftarrow x + \mathrm{PA}(\mathrm{LN}(x)), \quad
        x \leftarrow x + \mathrm{MLP}(\mathrm{LN}(x)).

    Source:
        Wu et al., "Transolver", ICML 2024 (arXiv:2402.02366), section 3.
    """

    def __init__(
        self, width: int, *, heads: int, slices: int, ratio: int, dropout: float = 0.0
    ) -> None:
        """Make the sub-layers.

        Args:
            width: Channels of the tokens.
            heads: Attention heads.
            slices: Slices per head.
            ratio: Hidden channels of the pointwise network in units of the width.
            dropout: Share of what the attention gives that is set to zero in training.
        """
        super().__init__()
        self.attention = PhysicsAttention(width, heads=heads, slices=slices, dropout=dropout)
        self.pointwise = MLP([width, ratio * width, width], activation=functional.gelu)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        _draw_weights(self.pointwise)

    def forward(
        self, token: Float[Tensor, "b t c"], mask: Bool[Tensor, "b t"] | None = None
    ) -> Float[Tensor, "b t c"]:
        """Update the tokens.

        Args:
            token: Tokens.
            mask: False for tokens that do not exist.

        Returns:
            The new tokens.
        """
        of_attention, of_pointwise = self.norms
        token = token + self.attention(of_attention(token), mask)
        return token + self.pointwise(of_pointwise(token))


class PhysicsTransformer(nn.Module):
    """Embed the tokens with their coordinates, run the blocks, normalise, project."""

    def __init__(
        self,
        width_in: int,
        width: int,
        width_out: int,
        *,
        dimension: int,
        layers: int,
        heads: int = 8,
        slices: int = 64,
        ratio: int = 1,
        dropout: float = 0.0,
    ) -> None:
        """Make the networks.

        Args:
            width_in: Channels of the incoming tokens.
            width: Channels inside.
            width_out: Channels of the outgoing tokens.
            dimension: Space dimension of the coordinates.
            layers: Number of blocks.
            heads: Attention heads.
            slices: Slices per head.
            ratio: Hidden channels of the pointwise networks in units of the width.
            dropout: Share of what the attention gives that is set to zero in training.
        """
        super().__init__()
        self.embed = MLP([width_in + dimension, 2 * width, width], activation=functional.gelu)
        self.blocks = nn.ModuleList(
            PhysicsBlock(width, heads=heads, slices=slices, ratio=ratio, dropout=dropout)
            for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, width_out)
        _draw_weights(self.embed)
        _draw_weights(self.out)

    def forward(
        self,
        token: Float[Tensor, "b t c"],
        coordinate: Float[Tensor, "#b t d"],
        mask: Bool[Tensor, "b t"] | None = None,
    ) -> Float[Tensor, "b t o"]:
        """Process the tokens of each sample.

        Args:
            token: Features of the tokens.
            coordinate: Their coordinates in units of the domain, 0 to 1.
            mask: False for tokens that do not exist; what is returned for them means nothing.

        Returns:
            New features of the tokens.
        """
        place = coordinate.to(token.dtype).expand(len(token), -1, -1)
        state = self.embed(torch.cat([place, token], dim=-1))
        for block in self.blocks:
            state = block(state, mask)
        return self.out(self.norm(state))


def _draw_weights(network: nn.Module) -> None:
    """Draw the weights of the linear layers from a narrow normal distribution; no biases."""
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            nn.init.trunc_normal_(layer.weight, std=WEIGHT_STD)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
