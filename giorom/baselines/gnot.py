"""GNOT: cross-attention from the particles to the particles, with experts that know the place.

The particles ask as points of the trunk and answer as samples of the input function. Nothing in
the network is local, so that neighbours are told apart from strangers by the attention alone.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.baselines.tokens import ParticleTokens, check_heads, check_settings
from giorom.features import Features
from giorom.layers.mlp import ResidualMLP
from giorom.layers.operator_attention import OperatorBlock


@dataclass(frozen=True, kw_only=True)
class GNOTConfig:
    """Size of GNOT; the defaults have about as many parameters as the other networks."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    width: int = 96
    """Channels of the tokens."""

    layers: int = 3
    """Blocks."""

    heads: int = 1
    """Attention heads."""

    experts: int = 2
    """Networks of each mixture."""

    inner: int = 4
    """Hidden channels of experts and gate in units of the width."""

    depth: int = 3
    """Residual layers of the networks that embed and project."""

    dropout: float = 0.0
    """Share of what the attention mixes, and again of what it gives, set to zero in training."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        names = "embedding width layers heads experts inner depth"
        check_settings(self, positive=names, shares="dropout")
        check_heads(self)

    @classmethod
    def published(cls) -> "GNOTConfig":
        """The size its authors start from: 64 channels and one expert.

        Source:
            Hao et al., "GNOT", ICML 2023 (arXiv:2302.14376), defaults of the official code.
        """
        return cls(width=64, experts=1)


class GNOT(Baseline):
    r"""General neural operator transformer with one input function.

    With trunk tokens :math:`x = \mathrm{MLP}(r, f)` of the particles at places r with features f,
    branch tokens :math:`y = \mathrm{MLP}(r, f)` of the same particles, and gates
    :math:`g = \mathrm{softmax}(\mathrm{MLP}(r))`, every block does

    .. math::
        x &\leftarrow x + \mathrm{Cross}(\mathrm{LN}\, x, \mathrm{LN}\, y), \quad
        x \leftarrow x + \mathrm{LN} \sum_e g_e\, \mathrm{FFN}_e(x), \\
        x &\leftarrow x + \mathrm{Self}(\mathrm{LN}\, x), \quad
        x \leftarrow x + \mathrm{LN} \sum_e g_e\, \mathrm{FFN}'_e(x)

    with the normalised linear attention of ``layers.operator_attention``.

    Source:
        Hao et al., "GNOT: A General Neural Operator Transformer for Operator Learning", ICML 2023
        (arXiv:2302.14376). There the trunk sees coordinates; here, as every particle is a sample
        of the input and a query at once, it sees the features of the particle as well.
    """

    def __init__(self, config: GNOTConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        self.tokens = ParticleTokens(shape, embedding=config.embedding)
        width_in, width = self.tokens.width + shape.dimension, config.width
        self.trunk, self.branch = (
            ResidualMLP(width_in, width, width, depth=config.depth) for _ in range(2)
        )
        self.blocks = nn.ModuleList(
            OperatorBlock(
                width,
                shape.dimension,
                heads=config.heads,
                experts=config.experts,
                expert_hidden=config.inner * width,
                gate_hidden=config.inner * width,
                dropout=config.dropout,
            )
            for _ in range(config.layers)
        )
        self.out = ResidualMLP(width, width, shape.dimension, depth=config.depth)

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        tokens = self.tokens(features)
        state, branch = self.trunk(tokens.placed), self.branch(tokens.placed)
        for block in self.blocks:
            state = block(state, branch, tokens.coordinate, tokens.mask)
        return tokens.padding.unpack(self.out(state))
