"""The network of the paper: velocities of the samples in, their accelerations out.

Stage 4 of the pipeline, section 4 of the paper; ``grid_stepper.py`` and ``body_stepper.py`` are the
other two time-steppers. An interaction operator takes the particles to a latent grid (message
passing, then a kernel integral), the neural operator transformer works on the grid, and a second
interaction operator brings the result back to the particles (kernel integral, then message passing
with the edge features of the first). The acceleration returned is normalised;
``normalization.py`` gives it its units. Only the position is in metres, and the latent grid alone
reads it.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.features import Features
from giorom.latent_branch import LatentBranch
from giorom.layers.message_passing import MessagePassing, Neighborhood
from giorom.layers.mlp import MLP, relu
from giorom.layers.pointwise_skip import PointwiseSkip
from giorom.time_stepper_config import TimeStepperConfig

__all__ = ["TimeStepper", "TimeStepperConfig"]


class TimeStepper(nn.Module):
    """Predict the normalised acceleration of every sample (IO_dec . NOT . IO_enc)."""

    def __init__(self, config: TimeStepperConfig) -> None:
        """Make the networks.

        Args:
            config: Size and variant.
        """
        super().__init__()
        self.config = config
        hidden = [config.hidden] * config.mlp_depth
        options = {"activation": relu, "unit_variance": True}
        self.type_embedding = nn.Embedding(config.particle_types, config.embedding)
        nn.init.xavier_uniform_(self.type_embedding.weight)
        self.node_in = MLP(
            [config.embedding + config.node_width, *hidden], layer_norm=True, **options
        )
        self.edge_in = None
        if config.layers_before + config.layers_after > 0:
            self.edge_in = MLP([config.edge_width, *hidden], layer_norm=True, **options)
        self.before, self.after = (
            nn.ModuleList(
                MessagePassing(config.hidden, depth=config.mlp_depth, node_skip=config.node_skip)
                for _ in range(count)
            )
            for count in (config.layers_before, config.layers_after)
        )
        self.latent = LatentBranch(config) if config.latent else None
        self.node_out = MLP([*hidden, config.dimension], **options)
        self.input_skip = None
        if config.input_skip != "none":
            self.input_skip = PointwiseSkip(
                config.node_width,
                config.dimension,
                gate_width=config.gate_width if config.input_skip == "gated" else 0,
            )
            nn.init.zeros_(self.node_out.layers[-1].weight)  # start as the skip alone

    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """
        config = self.config
        neighborhood = Neighborhood.of(
            features.edges,
            distance=features.edge[:, config.dimension],
            distance_weight=config.distance_weight,
        )
        embedded = self.type_embedding(features.particle_type)
        node = self.node_in(torch.cat([embedded, features.node], dim=-1))
        edge = features.edge if self.edge_in is None else self.edge_in(features.edge)
        for layer in self.before:
            node, edge = layer(node, edge, neighborhood)
        if self.latent is not None:
            node = self._through_grid(node, features)
        for layer in self.after:
            node, edge = layer(node, edge, neighborhood)
        acceleration = self.node_out(node)
        if self.input_skip is None:
            return acceleration
        return acceleration.to(features.node.dtype) + self.input_skip(features.node)

    def _through_grid(self, node: Tensor, features: Features) -> Tensor:
        """Node features after the latent grid."""
        sent = node if self.config.gno_input == "features" else self.node_out(node)
        received = self.latent(sent, features)
        return node + received if self.config.latent_skip else received

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles the latent grid reaches; one without a grid.

        Args:
            position: Positions of a batch [m].

        Returns:
            A share between 0 and 1.
        """
        if self.latent is None:
            return torch.ones((), device=position.device)
        return self.latent.coverage(position)
