"""The operator transformer of the paper on the particles themselves, without a latent grid.

What is left of the paper's network without its interaction operators: no message passing takes
the particles to the grid and back, and every particle is a token.
"""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.baselines.tokens import ParticleTokens, check_heads, check_settings
from giorom.features import Features
from giorom.layers.operator_attention import OperatorTransformer


@dataclass(frozen=True, kw_only=True)
class OperatorConfig:
    """Size of the operator transformer; the defaults are those it has on the latent grid."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    width: int = 256
    """Channels of the tokens."""

    layers: int = 1
    """Blocks."""

    heads: int = 4
    """Attention heads."""

    experts: int = 2
    """Networks of each mixture."""

    inner: int = 1
    """Hidden channels of the experts in units of the width."""

    depth: int = 1
    """Residual layers of the networks that embed and project."""

    gate_input: Literal["coords", "features"] = "coords"
    """What gates the experts: the place, or all a token comes with (official code)."""

    dropout: float = 0.0
    """Share of what the attention mixes, and again of what it gives, set to zero in training."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        names = "embedding width layers heads experts inner depth"
        check_settings(self, positive=names, shares="dropout")
        check_heads(self)

    @classmethod
    def published(cls) -> "OperatorConfig":
        """The same size as on the grid of the published model, gated and thinned as there.

        Source:
            arXiv:2407.03925v2, section 4.3; gate and dropout as in the official code.
        """
        return cls(gate_input="features", dropout=0.3)


class OperatorStepper(Baseline):
    """The neural operator transformer from particles to particles.

    Tokens are particles with coordinates, features and type; the cross-attention of every block
    asks the coordinates of all particles, as on the grid (``layers.operator_attention``).

    Source:
        arXiv:2407.03925v2, section 4.3 without the interaction operators of section 4.2.
    """

    def __init__(self, config: OperatorConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        self.tokens = ParticleTokens(shape, embedding=config.embedding)
        self.transformer = OperatorTransformer(
            self.tokens.width + shape.dimension,
            config.width,
            shape.dimension,
            dimension=shape.dimension,
            layers=config.layers,
            depth=config.depth,
            heads=config.heads,
            experts=config.experts,
            expert_hidden=config.inner * config.width,
            gate_input=config.gate_input,
            dropout=config.dropout,
        )

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        tokens = self.tokens(features)
        out = self.transformer(tokens.placed, tokens.coordinate, tokens.mask)
        return tokens.padding.unpack(out)
