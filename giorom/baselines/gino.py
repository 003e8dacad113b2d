"""GINO: kernel integrals between the particles and a grid on which Fourier blocks work.

The blocks are those of the neuraloperator library, which the extra ``baselines`` installs; the
kernel integrals are our own, because the library's, without a compiled package, loop over the
points in Python. No edge is read, and a particle keeps nothing of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as default

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape
from giorom.features import Features
from giorom.layers.fourier_operator import SpectralConvolution
from giorom.layers.kernel_integral import KernelIntegral, PointPairs
from giorom.layers.latent_grid import LatentGrid, widened
from giorom.layers.mlp import MLP

MATCHED = {2: (32, 16, 36), 3: (16, 8, 24)}
"""Nodes along each axis, frequencies and channels of about 1.5 million parameters in so many
dimensions."""


@dataclass(frozen=True, kw_only=True)
class GINOConfig:
    """Size of GINO; the defaults have about as many parameters as the other networks."""

    side: int | None = None
    """Grid nodes along each axis; null: 32 in the plane, 16 in space."""

    padding: float = 0.125
    """How far the grid goes beyond the bounds on each side, as a share of their width: the Fourier
    blocks take the grid for periodic."""

    radius: float | None = None
    """Reach of a grid node [m]; null: 1.5 times half the diagonal of a cell."""

    modes: int | None = None
    """Frequencies kept along each axis, at most half the nodes; null: 16 in the plane, 8 in
    space."""

    width: int | None = None
    """Channels of the Fourier blocks; null: 36 in the plane, 24 in space."""

    layers: int = 4
    """Fourier blocks."""

    in_hidden: list[int] = default(default_factory=lambda: [128, 64])
    """Hidden widths of the kernel from the particles to the grid."""

    out_hidden: list[int] = default(default_factory=lambda: [128, 64])
    """Hidden widths of the kernel from the grid to the particles."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        for dimension in (2, 3):
            side, modes, width = self.size(dimension)
            if side < 2 or not 1 <= modes <= side // 2:
                raise ValueError(
                    f"GINOConfig.modes must be between 1 and half of side={side}, the highest "
                    f"frequency a grid holds: others would never be used. Got {modes!r}."
                )
            if min(width, self.layers, self.embedding, *self.in_hidden, *self.out_hidden) < 1:
                raise ValueError(
                    f"GINOConfig.width, layers, embedding and the hidden widths must be >= 1, got "
                    f"{width!r}, {self.layers!r}, {self.embedding!r}, {self.in_hidden!r} and "
                    f"{self.out_hidden!r}."
                )
        if not 0.0 <= self.padding <= 1.0:
            raise ValueError(
                f"GINOConfig.padding is a share of the width of the bounds and must be in [0, 1], "
                f"got {self.padding!r}."
            )
        if self.radius is not None and not self.radius > 0.0:
            raise ValueError(
                f"GINOConfig.radius must be > 0 m, got {self.radius!r}. Null chooses one that "
                f"reaches every particle."
            )

    def size(self, dimension: int) -> tuple[int, int, int]:
        """Nodes along each axis, frequencies and channels in so many dimensions."""
        given = (self.side, self.modes, self.width)
        pairs = zip(given, MATCHED[dimension], strict=True)
        side, modes, width = (usual if value is None else value for value, usual in pairs)
        return side, modes, width

    @classmethod
    def published(cls) -> "GINOConfig":
        """The size the library builds by default: 64 channels, 16 frequencies, 32 nodes a side.

        Source:
            ``neuralop.models.GINO`` of neuraloperator 2.0: four blocks, kernels of three times 80
            and of 512 and 256 hidden channels. The grid's side is the caller's there; this is the
            smallest that holds the frequencies.
        """
        return cls(side=32, modes=16, width=64, in_hidden=[80, 80, 80], out_hidden=[512, 256])


class GINO(Baseline):
    r"""Kernel integral to a grid, lifting, Fourier blocks, kernel integral back, projection.

    .. math::
        u_g = \frac{1}{|B(g)|} \sum_{p \in B(g)} \kappa(x_p - x_g, x_g, f_p), \qquad
        v = F_L \circ \dots \circ F_1(\mathrm{lift}(u)), \qquad
        a_p = \mathrm{project}\Big(\sum_{g \in B(p)} \kappa'(x_g - x_p, x_p) \odot v_g\Big)

    with the features f of the particles and their types, the balls B of one radius and the Fourier
    blocks :math:`F v = \mathrm{GELU}(W v + K v)`, a channel network and a scaled skip each. The
    integral to the grid is a mean and the one back a sum, as in neuraloperator 2.0; the grid is
    regular, so that a particle has about as many nodes in reach wherever it is.

    Source:
        Li et al., "Geometry-Informed Neural Operator for Large-Scale 3D PDEs", NeurIPS 2023
        (arXiv:2309.00583), in the variant of ``neuralop.models.GINO`` 2.0. Its kernels see
        sinusoids of both places, ours the offset over the radius and the query's place. Theirs
        maps a geometry to a steady field; here it makes one step of a motion.
    """

    def __init__(self, config: GINOConfig, shape: NetworkShape) -> None:
        """Make the networks.

        Args:
            config: Size.
            shape: Its ends.
        """
        super().__init__()
        side, modes, width = config.size(shape.dimension)
        self.type_embedding = nn.Embedding(shape.particle_types, config.embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        seen = config.embedding + shape.node_width
        self.grid = LatentGrid(
            bounds=widened(shape.bounds, config.padding), side=side, radius=config.radius
        )
        self.encode = KernelIntegral(
            config.in_hidden,
            dimension=shape.dimension,
            width_in=seen,
            width_out=seen,
            transform="nonlinear_kernelonly",
        )
        self.lifting = MLP([seen, 2 * width, width], activation=functional.gelu)
        self.blocks = _fourier_blocks(
            width, dimension=shape.dimension, modes=modes, layers=config.layers
        )
        self.decode = KernelIntegral(
            config.out_hidden,
            dimension=shape.dimension,
            width_in=width,
            width_out=width,
            transform="linear",
            reduction="sum",
        )
        self.projection = MLP([width, 4 * width, shape.dimension], activation=functional.gelu)

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        embedded = self.type_embedding(features.particle_type)
        value = torch.cat([embedded, features.node], dim=1)
        inward = self._pairs(features)
        token = self.lifting(self.encode(value, inward)).unflatten(0, (features.batch_size, -1))
        sides = [self.grid.side] * features.position.shape[1]
        field = token.transpose(1, 2).unflatten(2, sides).contiguous()
        for number in range(len(self.blocks.convs)):
            field = self.blocks(field, number)
        token = field.flatten(2).transpose(1, 2).flatten(0, 1)
        return self.projection(self.decode(token, inward.reversed()))

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles that have a grid node within reach.

        Args:
            position: Positions of a batch [m].
        """
        with torch.no_grad():
            return self.grid.coverage(position)

    def _pairs(self, features: Features) -> PointPairs:
        """Grid nodes as queries, particles as sources; the grids of the scenes in a row."""
        position, scenes = features.position, features.batch_size
        near = self.grid.pairs(position)
        tokens = self.grid.tokens(near, features.batch, scenes, occupied=False)
        coordinate = self.grid.node_unit(tokens.node, position).expand(scenes, -1, -1)
        return self.grid.inward(position, near, tokens, coordinate=coordinate)


class LibraryConvolution(nn.Module):
    """Our spectral convolution as the library's blocks want it: channels first.

    The library's own keeps complex weights and single precision. With equal weights both give the
    same.
    """

    def __init__(
        self, width_in: int, width_out: int, modes: Sequence[int], **options: object
    ) -> None:
        """Make the convolution.

        Args:
            width_in: Channels.
            width_out: The same number.
            modes: Frequencies kept along each axis, all the same number.
            **options: What the library offers besides; not used.
        """
        super().__init__()
        del width_out, options
        self.inner = SpectralConvolution(width_in, dimension=len(modes), modes=modes[0])

    def forward(
        self, value: Float[Tensor, "b c *grid"], output_shape: None = None
    ) -> Float[Tensor, "b c *grid"]:
        """Convolve a field."""
        del output_shape
        return self.inner(value.movedim(1, -1)).movedim(-1, 1).contiguous()

    def transform(
        self, value: Float[Tensor, "b c *grid"], output_shape: None = None
    ) -> Float[Tensor, "b c *grid"]:
        """Bring a field to the grid of the result, which is the same."""
        del output_shape
        return value


def _fourier_blocks(width: int, *, dimension: int, modes: int, layers: int) -> nn.Module:
    """Fourier blocks of the library."""
    from neuralop.layers.fno_block import FNOBlocks

    return FNOBlocks(
        width, width, [modes] * dimension, n_layers=layers, conv_module=LibraryConvolution
    )
