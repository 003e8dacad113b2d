"""Transolver on the particles: slices of the set play the part of a latent grid."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.baselines.tokens import ParticleTokens, check_heads, check_settings
from giorom.features import Features
from giorom.layers.physics_attention import PhysicsTransformer


@dataclass(frozen=True, kw_only=True)
class TransolverConfig:
    """Size of Transolver; the defaults have about as many parameters as the other networks."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    width: int = 192
    """Channels of the tokens."""

    layers: int = 8
    """Blocks."""

    heads: int = 8
    """Attention heads."""

    slices: int = 64
    """Slices per head."""

    ratio: int = 1
    """Hidden channels of the pointwise networks in units of the width."""

    dropout: float = 0.0
    """Share of what the attention gives that is set to zero in training."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        names = "embedding width layers heads slices ratio"
        check_settings(self, positive=names, shares="dropout")
        check_heads(self)

    @classmethod
    def published(cls) -> "TransolverConfig":
        """The size its authors use for a deforming body: 128 channels.

        Source:
            Wu et al., "Transolver", ICML 2024 (arXiv:2402.02366), the elasticity benchmark.
        """
        return cls(width=128)


class Transolver(Baseline):
    """Physics attention among all particles of a scene (``layers.physics_attention``).

    A token is a particle with its coordinates, features and type.

    Source:
        Wu et al., "Transolver: A Fast Transformer Solver for PDEs on General Geometries", ICML
        2024 (arXiv:2402.02366). The official code has one more vector that is added to every
        token; it would do what the bias of the embedding does, and is left out.
    """

    def __init__(self, config: TransolverConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        self.tokens = ParticleTokens(shape, embedding=config.embedding)
        self.transformer = PhysicsTransformer(
            self.tokens.width,
            config.width,
            shape.dimension,
            dimension=shape.dimension,
            layers=config.layers,
            heads=config.heads,
            slices=config.slices,
            ratio=config.ratio,
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
        out = self.transformer(tokens.feature, tokens.coordinate, tokens.mask)
        return tokens.padding.unpack(out)
