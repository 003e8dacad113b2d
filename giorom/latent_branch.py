"""The part of the time-stepper that works on the latent grid: to it, on it and back.

Stage 4 of the pipeline. A kernel integral takes the particles to the grid, a processor works on
the nodes, and a second kernel integral brings the result back. Only this part reads positions,
which are metres.
"""

import warnings

from jaxtyping import Float
from torch import Tensor, nn

from giorom.features import Features
from giorom.layers.aggregation import Grouping
from giorom.layers.kernel_integral import KernelIntegral, PointPairs
from giorom.layers.latent_grid import LatentGrid
from giorom.layers.mlp import MLP
from giorom.layers.operator_attention import OperatorTransformer
from giorom.time_stepper_config import TimeStepperConfig


class LatentBranch(nn.Module):
    """Particles to grid, transformer, grid to particles, projection (GNO . NOT . GNO)."""

    def __init__(self, config: TimeStepperConfig) -> None:
        """Make the networks.

        Args:
            config: Size and variant.
        """
        super().__init__()
        self.grid = LatentGrid(
            bounds=config.latent_bounds, side=config.latent_side, radius=config.latent_radius
        )
        self.occupied = config.occupied_tokens
        common = {"dimension": config.dimension, "kernel": config.gno_kernel}
        self.encode = KernelIntegral(
            config.gno_in_hidden,
            width_in=config.hidden,
            width_out=config.latent_width,
            transform="nonlinear_kernelonly",
            **common,
        )
        self.transformer = OperatorTransformer(
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
        self.decode = KernelIntegral(
            config.gno_out_hidden,
            width_in=config.hidden,
            width_out=config.hidden,
            transform="linear",
            **common,
        )
        inner = [config.projection_width] * (config.projection_layers - 1)
        self.projection = MLP([config.hidden, *inner, config.hidden], activation=nn.GELU())
        self._warn_if_blind()

    def forward(self, node: Float[Tensor, "q h"], features: Features) -> Float[Tensor, "q h"]:
        """Exchange information through the grid of each scene.

        Args:
            node: Node features.
            features: Positions and batch.

        Returns:
            What the grid adds to the node features.
        """
        pairs = self.grid.pairs(features.position)
        tokens = self.grid.tokens(
            pairs, features.batch, features.batch_size, occupied=self.occupied
        )
        coordinate = self.grid.node_unit(tokens.node, features.position)
        dense = coordinate.expand(features.batch_size, -1, -1)
        inward = PointPairs(
            query=Grouping.by(tokens.slot, dense.shape[0] * dense.shape[1]),
            source=Grouping.by(pairs.particle, len(node)),
            relative=pairs.relative,
            query_position=dense.flatten(0, 1),
            source_position=self.grid.unit(features.position),
        )
        token = self.encode(node, inward).unflatten(0, dense.shape[:2])
        token = self.transformer(token, coordinate, tokens.mask)
        return self.projection(self.decode(token.flatten(0, 1), inward.reversed()))

    def _warn_if_blind(self) -> None:
        """Say so when the grid cannot reach every particle."""
        if self.grid.reach < self.grid.covering_radius:
            warnings.warn(
                f"latent_radius={self.grid.reach:g} m is below half the diagonal of a grid cell, "
                f"{self.grid.covering_radius:g} m: particles far from every node get nothing from "
                f"the grid. Raise latent_radius, raise latent_side, or set latent_radius=None.",
                stacklevel=4,
            )
