"""A U-Net on a grid that the particles are spread on: NeuralMPM, one frame at a time.

The particles are spread on a regular grid with multilinear weights, a convolutional U-Net turns
the density and the mean features of the grid's nodes into accelerations, and the particles read
them back with the same weights. No edge is read, and a particle keeps nothing of its own.
"""

from dataclasses import dataclass
from dataclasses import field as default
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.grid_convolution import CONVOLUTIONS
from giorom.layers.linear_grid import LinearGrid, LinearStencil

UPSAMPLING: dict[int, type[nn.Module]] = {2: nn.ConvTranspose2d, 3: nn.ConvTranspose3d}
"""Convolution to a finer grid of so many axes."""

MATCHED = {2: (32, [64, 120, 232]), 3: (16, [32, 64, 144])}
"""Nodes along each axis and channels of about 1.6 million parameters in so many dimensions."""

LEAST_WEIGHT = 1e-12
"""A node with less is empty."""


@dataclass(frozen=True, kw_only=True)
class UNetConfig:
    """Size of the U-Net; the defaults have about as many parameters as the other networks."""

    side: int | None = None
    """Nodes along each axis; null: 32 in the plane, 16 in space."""

    channels: list[int] | None = None
    """Channels on the grid and on each grid that is coarser by a factor of two; null: 64, 120, 232
    in the plane, 32, 64, 144 in space."""

    types: list[int] = default(default_factory=list)
    """Particle types with a density and mean features of their own, besides those of all particles
    together; only types of the data, for others learn nothing."""

    embedding: int = 16
    """Channels of the particle-type embedding, whose mean tells how a node's particles mix."""

    groups: int = 8
    """Groups of channels that are normalised together."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        for dimension in (2, 3):
            side, channels = self.size(dimension)
            if not channels or min(channels) < 1 or any(c % self.groups for c in channels):
                raise ValueError(
                    f"UNetConfig.channels must be multiples of groups={self.groups}, one for each "
                    f"level, got {channels!r}."
                )
            coarsest = 2 ** (len(channels) - 1)
            if side < 2 or side % coarsest:
                raise ValueError(
                    f"UNetConfig.side={side} must be >= 2 and divisible by {coarsest}: each of the "
                    f"{len(channels)} levels but the first halves it."
                )
        if self.embedding < 1 or self.groups < 1:
            raise ValueError(
                f"UNetConfig.embedding and groups must be >= 1, got {self.embedding!r} and "
                f"{self.groups!r}."
            )

    def size(self, dimension: int) -> tuple[int, list[int]]:
        """Nodes along each axis and channels in so many dimensions."""
        side, channels = MATCHED[dimension]
        return (
            side if self.side is None else self.side,
            channels if self.channels is None else self.channels,
        )

    @classmethod
    def published(cls) -> "UNetConfig":
        """The size of the authors in the plane: 64 nodes a side, four levels of 64 channels.

        Source:
            The default configuration of the code of NeuralMPM (arXiv:2408.15753).
        """
        return cls(side=64, channels=[64] * 4)


class UNet(Baseline):
    r"""Particles to grid, U-Net, grid to particles.

    With multilinear weights :math:`w_{pg}` of particle p and node g,

    .. math::
        \rho_g = \sum_p w_{pg}, \qquad u_g = \frac{1}{\rho_g} \sum_p w_{pg} u_p, \qquad
        a_p = \sum_g w_{pg}\, \mathrm{UNet}(\rho / \bar\rho, u)_g,

    where u holds the particle's features and the embedding of its type, and :math:`\bar\rho =
    \sum_g \rho_g^2 / \sum_g \rho_g`, the density that the scene's particles see in the mean, makes
    the input independent of how many particles a body is sampled with. Where no particle is, u is
    zero.

    Source:
        Rochman-Sharabi, Lewin and Louppe, "A Neural Material Point Method for Particle-based
        Emulation", TMLR 2025 (arXiv:2408.15753). Theirs predicts the velocities of the next eight
        frames in one call, is trained on several such calls in a row, and its grid holds the
        density and velocity of each material alone. Here it predicts the acceleration of one
        frame from the features all networks get, and is trained like all others.
    """

    def __init__(self, config: UNetConfig, shape: NetworkShape) -> None:
        """Make the network.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        side, channels = config.size(shape.dimension)
        self.types = tuple(config.types)
        self.grid = LinearGrid(bounds=shape.bounds, side=side)
        self.type_embedding = nn.Embedding(shape.particle_types, config.embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        seen = (1 + shape.node_width) * (1 + len(self.types)) + config.embedding
        self.network = GridUNet(
            seen, channels, shape.dimension, dimension=shape.dimension, groups=config.groups
        )

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        scenes, axes = features.batch_size, features.position.shape[1]
        stencil = self.grid.stencil(features.position, features.batch, scenes=scenes)
        seen = self._fields(features, stencil).unflatten(0, (scenes, -1)).transpose(1, 2)
        field = self.network(seen.unflatten(2, [self.grid.side] * axes))
        field = field.flatten(2).transpose(1, 2).flatten(0, 1)
        return stencil.to_points(field.to(features.node.dtype))

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles between the outermost nodes.

        Args:
            position: Positions of a batch [m].
        """
        return self.grid.coverage(position)

    def _fields(self, features: Features, stencil: LinearStencil) -> Float[Tensor, "n c"]:
        """Density and mean features at the nodes: of all particles, then of some types."""
        embedded = self.type_embedding(features.particle_type)
        every = torch.ones_like(features.node[:, :1])
        density = stencil.to_nodes(every)
        unit = _mean_density(density, scenes=features.batch_size)
        content = torch.cat([features.node, embedded], dim=1)
        fields = [density / unit, _means(content, stencil, density)]
        for kind in self.types:
            own = _indicator(features.particle_type, kind, like=every)
            density = stencil.to_nodes(own)
            fields += [density / unit, _means(own * features.node, stencil, density)]
        return torch.cat(fields, dim=1)


class GridUNet(nn.Module):
    """Convolutions on a grid and on coarser ones, and back with what the finer ones knew."""

    def __init__(
        self, width_in: int, channels: list[int], width_out: int, *, dimension: int, groups: int
    ) -> None:
        """Make the levels.

        Args:
            width_in: Channels of the field.
            channels: Channels of the levels, the finest first.
            width_out: Channels of the result.
            dimension: Axes of the grid.
            groups: Groups of channels that are normalised together.
        """
        super().__init__()
        kind = {"dimension": dimension, "groups": groups}
        pairs = list(zip([width_in, *channels], channels, strict=False))
        self.down = nn.ModuleList(_stage(before, after, **kind) for before, after in pairs)
        levels = list(zip(channels[-2::-1], channels[:0:-1], strict=True))
        self.lift = nn.ModuleList(
            UPSAMPLING[dimension](coarse, fine, 2, stride=2) for fine, coarse in levels
        )
        self.up = nn.ModuleList(_stage(2 * fine, fine, **kind) for fine, _ in levels)
        self.out = CONVOLUTIONS[dimension](channels[0], width_out, 1)
        self.pool = functional.avg_pool2d if dimension == 2 else functional.avg_pool3d

    def forward(self, field: Float[Tensor, "b c *grid"]) -> Float[Tensor, "b o *grid"]:
        """Process a field, channels first; the sides must be divisible by 2^(levels - 1)."""
        kept = []
        for number, stage in enumerate(self.down):
            field = stage(field if number == 0 else self.pool(field, 2))
            kept.append(field)
        for finer, stage, fine in zip(self.lift, self.up, kept[-2::-1], strict=True):
            field = stage(torch.cat([fine, finer(field)], dim=1))
        return self.out(field)


def _stage(width_in: int, width_out: int, *, dimension: int, groups: int) -> nn.Sequential:
    """Two convolutions, each normalised and activated."""
    parts: list[Any] = []
    for before in (width_in, width_out):
        parts += [
            CONVOLUTIONS[dimension](before, width_out, 3, padding=1, bias=False),
            nn.GroupNorm(groups, width_out),
            nn.GELU(),
        ]
    return nn.Sequential(*parts)


def _mean_density(density: Float[Tensor, "n 1"], *, scenes: int) -> Float[Tensor, "n 1"]:
    """Density that the particles of a node's scene see in the mean."""
    per_scene = density.view(scenes, -1)
    square, total = per_scene.square().sum(dim=1), per_scene.sum(dim=1)
    mean = square / total.clamp_min(LEAST_WEIGHT)
    mean = mean.clamp_min(LEAST_WEIGHT)
    return mean.repeat_interleave(per_scene.shape[1])[:, None]


def _means(value: Tensor, stencil: LinearStencil, density: Tensor) -> Tensor:
    """Weighted means at the nodes; zero at those without a particle."""
    return stencil.to_nodes(value) / density.clamp_min(LEAST_WEIGHT)


def _indicator(particle_type: Int[Tensor, " q"], kind: int, *, like: Tensor) -> Tensor:
    """One for the particles of a type, zero for others (q 1)."""
    return (particle_type == kind).to(like.dtype)[:, None]
