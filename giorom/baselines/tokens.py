"""Particles as tokens: what the networks without a graph of the samples see.

Every particle is one token with the features and the type it has in all networks, and with its
coordinates in units of the domain, because such a network has no other way to tell who is near
whom. Scenes are padded to one length and masked.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.padding import ScenePadding


@dataclass(frozen=True, kw_only=True)
class Tokens:
    """The particles of a batch, scene by scene."""

    feature: Float[Tensor, "b t c"]
    """Embedded type, then ``Features.node``."""

    coordinate: Float[Tensor, "b t d"]
    """Position in units of the domain, 0 to 1."""

    padding: ScenePadding
    """How they were padded."""

    @property
    def placed(self) -> Float[Tensor, "b t e"]:
        """Coordinates, then features."""
        return torch.cat([self.coordinate, self.feature], dim=-1)

    @property
    def mask(self) -> Bool[Tensor, "b t"] | None:
        """False for tokens that do not exist; all exist where None."""
        return self.padding.mask


class ParticleTokens(nn.Module):
    """Embed the types of the particles and lay the scenes side by side.

    Args:
        shape: Ends of the network.
        embedding: Channels of the type embedding.
    """

    def __init__(self, shape: NetworkShape, *, embedding: int) -> None:
        super().__init__()
        self.width = embedding + shape.node_width
        self.type_embedding = nn.Embedding(shape.particle_types, embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        self.register_buffer("bounds", torch.tensor(shape.bounds), persistent=False)

    def forward(self, features: Features) -> Tokens:
        """Make the tokens of a batch.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            The tokens.
        """
        padding = ScenePadding.of(features.batch, features.batch_size)
        low, high = self.bounds.to(features.position.dtype).unbind(dim=1)
        embedded = self.type_embedding(features.particle_type)
        return Tokens(
            feature=padding.pack(torch.cat([embedded, features.node], dim=-1)),
            coordinate=padding.pack((features.position - low) / (high - low)),
            padding=padding,
        )


def check_settings(record: object, *, positive: str, shares: str = "") -> None:
    """Reject counts below one, and shares outside of [0, 1).

    Args:
        record: A record of settings.
        positive: Names of the counts, separated by spaces.
        shares: Names of the shares.

    Raises:
        ValueError: Says which setting, the rule and the value.
    """
    name = type(record).__name__
    for setting in positive.split():
        value = getattr(record, setting)
        if value < 1:
            raise ValueError(f"{name}.{setting} must be >= 1, got {value!r}.")
    for setting in shares.split():
        value = getattr(record, setting)
        if not 0.0 <= value < 1.0:
            raise ValueError(f"{name}.{setting} is a share and must be in [0, 1), got {value!r}.")


def check_heads(record: object, *, heads: str = "heads", width: str = "width") -> None:
    """Reject heads that do not divide the channels.

    Raises:
        ValueError: Says both numbers.
    """
    name, count, channels = type(record).__name__, getattr(record, heads), getattr(record, width)
    if channels % count:
        raise ValueError(f"{name}.{heads}={count} must divide {width}={channels}.")
