r"""The part of the network that works on the latent grid: to it, on it and back.

Stage 4 of the pipeline. A kernel integral takes the particles to the grid, a processor works on
the nodes, and a second kernel integral brings the result back. With ``gno_layers=2`` there are two
on each way: the additional one integrates over the particles joined to a particle by an edge,

.. math::
    v \leftarrow v + \mathcal{K}_{particles} v, \quad
    w = \mathcal{K}_{back} P\, \mathcal{K}_{to} v, \quad
    w \leftarrow w + \mathcal{K}'_{particles} w,

with the processor :math:`P`. Only this part reads positions, which are metres.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.features import Features
from giorom.layers.aggregation import Grouping
from giorom.layers.fourier_operator import FourierOperator
from giorom.layers.grid_convolution import GridConvolution
from giorom.layers.kernel_integral import KernelIntegral, PointPairs
from giorom.layers.latent_grid import LatentGrid, widened
from giorom.layers.mlp import MLP
from giorom.layers.operator_attention import OperatorTransformer
from giorom.layers.physics_attention import PhysicsTransformer
from giorom.time_stepper_config import TimeStepperConfig


class LatentBranch(nn.Module):
    """Particles to grid, processor, grid to particles, projection (GNO . NOT . GNO)."""

    def __init__(self, config: TimeStepperConfig) -> None:
        """Make the networks.

        Args:
            config: Size and variant.
        """
        super().__init__()
        self.occupied, self.domain = config.occupied_tokens, config.latent_bounds
        self.to_plane = nn.Linear(3, 2) if config.processor == "fourier_plane" else None
        axes = config.dimension if self.to_plane is None else 2
        self.grid = LatentGrid(
            bounds=widened(
                config.latent_bounds if self.to_plane is None else [[-1.0, 1.0]] * 2,
                config.latent_padding,
            ),
            side=config.latent_side,
            radius=config.latent_radius,
        )
        common = {"dimension": axes, "kernel": config.gno_kernel}
        from_features = config.gno_input == "features"
        self.encode = KernelIntegral(
            config.gno_in_hidden,
            width_in=config.hidden if from_features else config.dimension,
            width_out=config.latent_width,
            transform="nonlinear_kernelonly",
            **common,
        )
        self.transformer = self.fourier = self.convolution = self.pointwise = None
        if config.processor == "transformer":
            self.transformer = _transformer(config)
        elif config.processor == "transolver":
            self.transformer = _transolver(config)
        elif config.processor == "convolution":
            self.convolution = _convolution(config)
        elif config.processor == "none":
            self.pointwise = nn.Linear(config.latent_width, config.hidden)
        else:
            self.fourier = _fourier(config, axes)
        self.decode = KernelIntegral(
            config.gno_out_hidden,
            width_in=config.hidden,
            width_out=config.hidden,
            transform="linear",
            **common,
        )
        self.encode_near = self.decode_near = None
        if config.gno_layers == 2:
            self.encode_near, self.decode_near = _near(config)
        inner = [config.projection_width] * (config.projection_layers - 1)
        self.projection = MLP([config.hidden, *inner, config.hidden], activation=nn.GELU())

    def forward(self, value: Float[Tensor, "q c"], features: Features) -> Float[Tensor, "q h"]:
        """Exchange information through the grid of each scene.

        Args:
            value: What the particles bring to the grid.
            features: Positions and batch, and the graph for a second pair of kernel integrals.

        Returns:
            What the particles take from it.
        """
        position = self._place(features.position)
        near = None if self.encode_near is None else self._neighbors(features)
        if near is not None:
            value = value + self.encode_near(value, near)
        pairs = self.grid.pairs(position)
        tokens = self.grid.tokens(
            pairs, features.batch, features.batch_size, occupied=self.occupied
        )
        coordinate = self.grid.node_unit(tokens.node, position)
        dense = coordinate.expand(features.batch_size, -1, -1)
        inward = self.grid.inward(position, pairs, tokens, coordinate=dense)
        token = self.encode(value, inward).unflatten(0, dense.shape[:2])
        if self.transformer is not None:
            token = self.transformer(token, coordinate, tokens.mask)
        else:
            token = (self.fourier or self.convolution or self.pointwise)(token)
        received = self.decode(token.flatten(0, 1), inward.reversed())
        if near is not None:
            received = received + self.decode_near(received, near)
        return self.projection(received)

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles that have a grid node within reach."""
        with torch.no_grad():
            return self.grid.coverage(self._place(position))

    def _place(self, position: Tensor) -> Tensor:
        """Where particles are in the space of the grid: [m], or on the plane."""
        if self.to_plane is None:
            return position
        low, high = position.new_tensor(self.domain).unbind(dim=1)
        with torch.autocast(position.device.type, enabled=False):
            return torch.tanh(self.to_plane((position - low) / (high - low)))

    def _neighbors(self, features: Features) -> PointPairs:
        """Particles joined by an edge of the interaction graph."""
        edges = features.edges
        order = torch.arange(len(edges.receiver), device=edges.receiver.device)
        place = self.grid.unit(features.position)
        return PointPairs(
            query=Grouping(point=edges.receiver, order=order, offset=edges.offset),
            source=Grouping.by(edges.sender, len(place)),
            relative=features.edge[:, : place.shape[1]],
            query_position=place,
            source_position=place,
        )


def _near(config: TimeStepperConfig) -> tuple[KernelIntegral, KernelIntegral]:
    """The kernel integrals over neighbouring particles, before the grid and after it."""
    common = {
        "dimension": config.dimension,
        "width_in": config.hidden,
        "width_out": config.hidden,
        "kernel": config.gno_kernel,
    }
    before = KernelIntegral(config.gno_in_hidden, transform="nonlinear_kernelonly", **common)
    return before, KernelIntegral(config.gno_out_hidden, transform="linear", **common)


def _transformer(config: TimeStepperConfig) -> OperatorTransformer:
    """The operator transformer of a configuration."""
    return OperatorTransformer(
        config.latent_width,
        config.transformer_width,
        config.hidden,
        dimension=config.dimension,
        layers=config.transformer_layers,
        depth=config.transformer_mlp_depth,
        heads=config.heads,
        experts=config.experts,
        expert_hidden=config.expert_hidden or config.transformer_width,
        gate_input=config.gate_input,
        dropout=config.dropout,
    )


def _fourier(config: TimeStepperConfig, axes: int) -> FourierOperator:
    """The Fourier operator of a configuration on a grid of so many axes."""
    return FourierOperator(
        config.latent_width,
        config.fourier_width,
        config.hidden,
        dimension=axes,
        layers=config.fourier_layers,
        modes=config.fourier_modes,
        hidden=config.fourier_hidden,
    )


def _transolver(config: TimeStepperConfig) -> PhysicsTransformer:
    """The transformer of slices of a configuration."""
    return PhysicsTransformer(
        config.latent_width,
        config.transformer_width,
        config.hidden,
        dimension=config.dimension,
        layers=config.transformer_layers,
        heads=config.heads,
        slices=config.slices,
        dropout=config.dropout,
    )


def _convolution(config: TimeStepperConfig) -> GridConvolution:
    """The convolutions of a configuration."""
    return GridConvolution(
        config.latent_width,
        config.convolution_width,
        config.hidden,
        dimension=config.dimension,
        layers=config.convolution_layers,
    )
