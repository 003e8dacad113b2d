"""The part of the network that works on the latent grid: to it, on it and back.

Stage 4 of the pipeline. A kernel integral takes the particles to the grid, a processor works on
the nodes, and a second kernel integral brings the result back. Only this part reads positions,
which are metres.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.features import Features
from giorom.layers.aggregation import Grouping
from giorom.layers.fourier_operator import FourierOperator
from giorom.layers.kernel_integral import KernelIntegral, PointPairs
from giorom.layers.latent_grid import LatentGrid
from giorom.layers.mlp import MLP
from giorom.layers.operator_attention import OperatorTransformer
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
            bounds=config.latent_bounds if self.to_plane is None else [[-1.0, 1.0]] * 2,
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
        self.transformer = self.fourier = self.pointwise = None
        if config.processor == "transformer":
            self.transformer = _transformer(config)
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
        inner = [config.projection_width] * (config.projection_layers - 1)
        self.projection = MLP([config.hidden, *inner, config.hidden], activation=nn.GELU())

    def forward(self, value: Float[Tensor, "q c"], features: Features) -> Float[Tensor, "q h"]:
        """Exchange information through the grid of each scene.

        Args:
            value: What the particles bring to the grid.
            features: Positions and batch.

        Returns:
            What the particles take from it.
        """
        position = self._place(features.position)
        pairs = self.grid.pairs(position)
        tokens = self.grid.tokens(
            pairs, features.batch, features.batch_size, occupied=self.occupied
        )
        coordinate = self.grid.node_unit(tokens.node, position)
        dense = coordinate.expand(features.batch_size, -1, -1)
        inward = PointPairs(
            query=Grouping.by(tokens.slot, dense.shape[0] * dense.shape[1]),
            source=Grouping.by(pairs.particle, len(value)),
            relative=pairs.relative,
            query_position=dense.flatten(0, 1),
            source_position=self.grid.unit(position),
        )
        token = self.encode(value, inward).unflatten(0, dense.shape[:2])
        if self.transformer is not None:
            token = self.transformer(token, coordinate, tokens.mask)
        elif self.fourier is not None:
            token = self.fourier(token)
        else:
            token = self.pointwise(token)
        return self.projection(self.decode(token.flatten(0, 1), inward.reversed()))

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
