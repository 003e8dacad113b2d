"""IPOT: a few latent vectors read all particles, think, and are read at the particles.

The published decoder knows of a particle where it is and nothing else: two particles at nearly
one place get nearly one acceleration, whatever their history. With ``query_features`` the
particle brings its own features to the decoder, too, which is a deviation from the paper.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.baselines.tokens import ParticleTokens, check_heads, check_settings
from giorom.features import Features

DECODER_RATIO = 2
"""Hidden channels of the last pointwise network in units of the dimension."""

LATENT_STD = 0.02
"""Spread of the latent vectors where training starts."""

OUTPUT_SCALE = 0.1
"""Factor at the end of the published network."""


@dataclass(frozen=True, kw_only=True)
class IPOTConfig:
    """Size of IPOT; the defaults have about as many parameters as the other networks."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    bands: int = 12
    """Pairs of sine and cosine per axis."""

    resolution: float = 64.0
    """Points per axis that the shortest wave resolves."""

    latents: int = 256
    """Latent vectors."""

    width: int = 320
    """Channels of the latent vectors."""

    repeats: int = 4
    """Times the processor is applied, with the same weights."""

    cross_heads: int = 5
    """Attention heads where the latents read the particles and are read."""

    heads: int = 8
    """Attention heads among the latents."""

    ratio: int = 2
    """Hidden channels of the processor's pointwise network in units of the width."""

    query_features: bool = False
    """Let the decoder's query see the particle's own features beside its place."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        check_settings(
            self, positive="embedding bands latents width repeats cross_heads heads ratio"
        )
        check_heads(self)
        check_heads(self, heads="cross_heads")
        if not 2.0 <= self.resolution < math.inf:
            raise ValueError(
                f"IPOTConfig.resolution must be >= 2 points and finite, got {self.resolution!r}."
            )

    @classmethod
    def published(cls) -> "IPOTConfig":
        """The size its authors start from: 128 latents of 64 channels, 64 bands.

        Source:
            Lee and Oh, "Inducing Point Operator Transformer", AAAI 2024 (arXiv:2312.10975),
            defaults of the official code.
        """
        return cls(bands=64, latents=128, width=64, cross_heads=1, heads=4, ratio=4)


class FourierFeatures(nn.Module):
    r"""Coordinates as waves, :math:`\gamma(u) = [\sin(\pi f_k u), \cos(\pi f_k u), u]` per axis.

    The coordinates u run from -1 to 1 and the frequencies f in equal steps from 1 to half the
    resolution.

    Source:
        Jaegle et al., "Perceiver", ICML 2021 (arXiv:2103.03206), section 3.2.
    """

    def __init__(self, dimension: int, *, bands: int, resolution: float) -> None:
        """Choose the frequencies.

        Args:
            dimension: Space dimension.
            bands: Frequencies per axis.
            resolution: Points per axis that the shortest wave resolves.
        """
        super().__init__()
        self.width = dimension * (2 * bands + 1)
        frequency = torch.linspace(1.0, resolution / 2.0, bands, dtype=torch.float64)
        self.register_buffer("frequency", math.pi * frequency, persistent=False)

    def forward(self, unit: Float[Tensor, "b t d"]) -> Float[Tensor, "b t w"]:
        """Encode places.

        Args:
            unit: Coordinates in units of the domain, 0 to 1.

        Returns:
            The waves.
        """
        place = 2.0 * unit - 1.0
        phase = (place[..., None] * self.frequency.to(place.dtype)).flatten(-2)
        return torch.cat([phase.sin(), phase.cos(), place], dim=-1)


class Attention(nn.Module):
    r"""Softmax attention of queries x to a context y.

    .. math::
        z_t = \Big[\sum_s \mathrm{softmax}_s\!\left(\frac{q_t \cdot k_s}{\sqrt{c}}\right) v_s
              \Big] W_o + b, \qquad q = x\, W_q,\; k = y\, W_k,\; v = y\, W_v

    in each head of c channels.

    Source:
        Vaswani et al., "Attention Is All You Need", NeurIPS 2017 (arXiv:1706.03762), section 3.2.
    """

    def __init__(
        self,
        query_width: int,
        context_width: int,
        width_out: int,
        *,
        heads: int,
        width: int,
    ) -> None:
        """Make the maps.

        Args:
            query_width: Channels of what asks.
            context_width: Channels of what answers.
            width_out: Channels of the result.
            heads: Number of heads.
            width: Channels of all heads together.
        """
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(query_width, width, bias=False)
        self.key = nn.Linear(context_width, width, bias=False)
        self.value = nn.Linear(context_width, width, bias=False)
        self.out = nn.Linear(width, width_out)

    def forward(
        self,
        query: Float[Tensor, "b t p"],
        context: Float[Tensor, "b s r"],
        mask: Bool[Tensor, "b s"] | None = None,
    ) -> Float[Tensor, "b t o"]:
        """Read the context.

        Args:
            query: What asks.
            context: What answers.
            mask: False for parts of the context that do not exist.

        Returns:
            What was read.
        """
        asked, key = self._split(self.query(query)), self._split(self.key(context))
        value, bias = self._split(self.value(context)), None
        if mask is not None:  # finite, so that a scene without particles is not 0 / 0
            lowest = torch.finfo(asked.dtype).min
            bias = torch.zeros_like(mask, dtype=asked.dtype).masked_fill(~mask, lowest)
            bias = bias[:, None, None, :]
        mixed = functional.scaled_dot_product_attention(asked, key, value, attn_mask=bias)
        return self.out(mixed.transpose(1, 2).flatten(2))

    def _split(self, value: Tensor) -> Tensor:
        """Put the heads in front of the tokens: (b t c) to (b heads t c/heads)."""
        return value.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class GatedPointwise(nn.Module):
    r"""Pointwise network with a gate.

    .. math::
        z = [a \odot \mathrm{GELU}(g)]\, W_2 + b_2, \qquad [a, g] = x\, W_1 + b_1.

    Source:
        Shazeer, "GLU Variants Improve Transformer" (arXiv:2002.05202), GEGLU.
    """

    def __init__(self, width: int, *, ratio: int) -> None:
        """Make the maps.

        Args:
            width: Channels.
            ratio: Hidden channels in units of the width.
        """
        super().__init__()
        self.first = nn.Linear(width, 2 * ratio * width)
        self.last = nn.Linear(ratio * width, width)

    def forward(self, value: Float[Tensor, "b t c"]) -> Float[Tensor, "b t c"]:
        """Map each token on its own."""
        content, gate = self.first(value).chunk(2, dim=-1)
        return self.last(content * functional.gelu(gate))


class IPOT(Baseline):
    r"""Inducing-point operator transformer.

    With context :math:`y = [f, \gamma(r)]` of the particles (features and place), learned latent
    vectors L, a processor applied several times and queries :math:`q = \gamma(r)`,

    .. math::
        L &\leftarrow L + \mathrm{Att}(\mathrm{LN}\, L, \mathrm{LN}\, y), \\
        L &\leftarrow L + \mathrm{Att}(\mathrm{LN}\, L, \mathrm{LN}\, L), \quad
        L \leftarrow L + \mathrm{FFN}(\mathrm{LN}\, L), \\
        z &= \mathrm{Att}(\mathrm{LN}\, q, \mathrm{LN}\, L), \quad
        a = 0.1\, [z + \mathrm{FFN}(\mathrm{LN}\, z)].

    Source:
        Lee and Oh, "Inducing Point Operator Transformer: A Flexible and Scalable Architecture for
        Solving PDEs", AAAI 2024 (arXiv:2312.10975), sizes and order as in the official code. That
        one also makes a pointwise network for the encoder that it never calls; there is none here.
    """

    def __init__(self, config: IPOTConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size and variant.
            shape: Its ends.
        """
        super().__init__()
        self.query_features, self.repeats = config.query_features, config.repeats
        self.tokens = ParticleTokens(shape, embedding=config.embedding)
        self.waves = FourierFeatures(
            shape.dimension, bands=config.bands, resolution=config.resolution
        )
        width, axes = config.width, shape.dimension
        context = self.tokens.width + self.waves.width
        query = context if config.query_features else self.waves.width
        self.latents = nn.Parameter(LATENT_STD * torch.randn(config.latents, width))
        common = {"width": width, "heads": config.cross_heads}
        self.encode = Attention(width, context, width, **common)
        self.attend = Attention(width, width, width, width=width, heads=config.heads)
        self.think = GatedPointwise(width, ratio=config.ratio)
        self.decode = Attention(query, width, axes, **common)
        self.finish = GatedPointwise(axes, ratio=DECODER_RATIO)
        self.norms = nn.ModuleDict(
            {
                "latents": nn.LayerNorm(width),
                "context": nn.LayerNorm(context),
                "attend": nn.LayerNorm(width),
                "think": nn.LayerNorm(width),
                "query": nn.LayerNorm(query),
                "read": nn.LayerNorm(width),
                "finish": nn.LayerNorm(axes),
            }
        )

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        tokens = self.tokens(features)
        place = self.waves(tokens.coordinate)
        context = torch.cat([tokens.feature, place], dim=-1)
        latent = self._processed(context, tokens.mask)
        norms, query = self.norms, context if self.query_features else place
        read = self.decode(norms["query"](query), norms["read"](latent))
        read = read + self.finish(norms["finish"](read))
        return tokens.padding.unpack(OUTPUT_SCALE * read)

    def _processed(self, context: Tensor, mask: Tensor | None) -> Tensor:
        """The latent vectors of each scene after they have read it and exchanged what they know."""
        norms = self.norms
        latent = self.latents.expand(len(context), -1, -1)
        latent = latent + self.encode(norms["latents"](latent), norms["context"](context), mask)
        for _ in range(self.repeats):
            calm = norms["attend"](latent)
            latent = latent + self.attend(calm, calm)
            latent = latent + self.think(norms["think"](latent))
        return latent
