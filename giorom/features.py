"""What the network sees: dimensionless features of the samples and of their edges.

Stage 3b of the pipeline. Node features are velocities (newest last) and clipped distances to the
walls; edge features are relative positions. For solids two more groups can be switched on: the
edge in the undeformed body, and how far it has been displaced, because elastic forces depend on
the rest shape, which neither velocities nor current positions contain.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.graph import Edges
from giorom.normalization import Normalization
from giorom.state import SparseState

DISPLACEMENT_GAIN = 10.0
"""Brings the displacement of an edge, about a tenth of its length, to order one."""

REST_POSITION_GAIN = 0.2
"""Brings places in a body, some radii from its base, to order one."""


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """Which features are computed."""

    velocities: int = 5
    """Velocities given to the model; the history holds one frame more."""

    velocity_form: Literal["standardized", "differences"] = "standardized"
    """All velocities divided by the velocity scale (the paper), or the newest one so and the
    differences between successive ones divided by the acceleration scale."""

    walls: bool = True
    """Distances to the walls in units of the graph radius, clipped to [-1, 1]."""

    displacement: bool = False
    """Add the displacement of each particle from the undeformed body (for clamped solids)."""

    rest_shape: bool = False
    """Add the place of each particle in the undeformed body, seen from the middle of the clamped
    region (of the body, where nothing is clamped), and the second moments of the body about it:
    how stiff a body is as a whole depends on its proportions."""

    rest_edges: bool = False
    """Add each edge in the undeformed body, its displacement and its stretch (for solids)."""

    def __post_init__(self) -> None:
        """Reject an empty history."""
        if self.velocities < 1:
            raise ValueError(f"FeatureConfig.velocities must be >= 1, got {self.velocities!r}.")

    @property
    def history(self) -> int:
        """Frames a state must hold."""
        return self.velocities + 1

    def node_width(self, dimension: int) -> int:
        """Channels per node."""
        width = dimension * (self.velocities + 2 * self.walls + self.displacement)
        return width + self.shape_width(dimension)

    def shape_width(self, dimension: int) -> int:
        """Channels per node, the last ones, that describe the undeformed body."""
        if not self.rest_shape:
            return 0
        return dimension + dimension * (dimension + 1) // 2

    def edge_width(self, dimension: int) -> int:
        """Channels per edge."""
        return (dimension + 1) * (3 if self.rest_edges else 1)


@dataclass(frozen=True, kw_only=True)
class Features:
    """Everything the network sees of a batch, dimensionless except the position."""

    node: Float[Tensor, "q c"]
    """Velocities, newest last with axes fastest; then the lower and upper wall distances and the
    displacement, where they are switched on."""

    particle_type: Int[Tensor, " q"]
    """GNS particle types."""

    edge: Float[Tensor, "e k"]
    """(x_sender - x_receiver) / radius and its length; then the rest features, if any."""

    edges: Edges
    """The graph."""

    position: Float[Tensor, "q d"]
    """Positions, for the latent grid [m]."""

    batch: Int[Tensor, " q"]
    """Scene of each particle, ascending."""

    batch_size: int = 1
    """Number of scenes."""


def compute_features(
    state: SparseState,
    edges: Edges,
    config: FeatureConfig,
    *,
    normalization: Normalization,
    radius: float,
) -> Features:
    """Features of a batch of sparse states.

    Args:
        state: Sparse state with ``config.history`` frames.
        edges: Its graph.
        config: Which features.
        normalization: Scales of velocity and acceleration.
        radius: Graph radius [m].

    Raises:
        ValueError: If the history of the state has another length.

    Source:
        arXiv:2407.03925v2, section 5.2 (node and edge features), with velocities standardised and
        wall distances clipped.
    """
    if state.history.shape[1] != config.history:
        raise ValueError(
            f"the state holds {state.history.shape[1]} frames, the features need {config.history} "
            f"(FeatureConfig.velocities={config.velocities})."
        )
    node = [_velocity_features(state, config, normalization)]
    if config.walls:
        low = (state.position - state.bounds[:, 0]) / radius
        high = (state.bounds[:, 1] - state.position) / radius
        node.append(torch.cat([low, high], dim=1).clamp(-1.0, 1.0))
    if config.displacement:
        node.append((state.position - state.reference) / radius * DISPLACEMENT_GAIN)
    if config.rest_shape:
        node += _shape_features(state, radius)
    edge = [_relative(state.position, edges, radius)]
    if config.rest_edges:
        edge += _rest_features(state, edges, radius, edge[0])
    return Features(
        node=torch.cat(node, dim=1),
        particle_type=state.particle_type,
        edge=torch.cat(edge, dim=1),
        edges=edges,
        position=state.position,
        batch=state.batch,
        batch_size=state.batch_size,
    )


def _velocity_features(
    state: SparseState, config: FeatureConfig, normalization: Normalization
) -> Tensor:
    velocity = state.history.diff(dim=1) / state.frame_dt
    if config.velocity_form == "standardized":
        return normalization.velocity(velocity).flatten(1)
    newest = normalization.velocity(velocity[:, -1:])
    change = normalization.acceleration(velocity.diff(dim=1) / state.frame_dt)
    return torch.cat([change, newest], dim=1).flatten(1)


def _shape_features(state: SparseState, radius: float) -> list[Tensor]:
    """Rest position from the base, and the second moments of the body about it, on each node."""
    position = (state.reference - _base(state)) / radius * REST_POSITION_GAIN
    rows, columns = torch.triu_indices(position.shape[1], position.shape[1])
    products = position[:, rows] * position[:, columns]
    count = torch.bincount(state.batch, minlength=state.batch_size).to(position.dtype)
    moments = position.new_zeros(state.batch_size, products.shape[1])
    moments = moments.index_add(0, state.batch, products) / count[:, None]
    return [position, moments[state.batch]]


def _base(state: SparseState) -> Tensor:
    """Middle of the clamped region of each particle's scene, or of its body without one [m]."""
    weight = state.kinematic.to(state.reference.dtype)
    clamped = weight.new_zeros(state.batch_size).index_add(0, state.batch, weight)
    weight = torch.where(clamped[state.batch] > 0.0, weight, torch.ones_like(weight))
    total = weight.new_zeros(state.batch_size).index_add(0, state.batch, weight)
    moment = state.reference.new_zeros(state.batch_size, state.reference.shape[1])
    moment = moment.index_add(0, state.batch, weight[:, None] * state.reference)
    return (moment / total[:, None])[state.batch]


def _relative(position: Tensor, edges: Edges, radius: float) -> Tensor:
    """Relative vector sender minus receiver and its length, in units of the radius."""
    vector = (position[edges.sender] - position[edges.receiver]) / radius
    return torch.cat([vector, _length(vector)], dim=1)


def _rest_features(
    state: SparseState, edges: Edges, radius: float, current: Tensor
) -> list[Tensor]:
    """Rest edge and its displacement, the latter magnified: strains are small."""
    rest = _relative(state.reference, edges, radius)
    return [rest, (current - rest) * DISPLACEMENT_GAIN]


def _length(vector: Tensor) -> Tensor:
    """Euclidean length with a finite gradient at zero."""
    square = vector.square().sum(dim=1, keepdim=True)
    return torch.where(square > 0.0, square.clamp_min(1e-30).sqrt(), torch.zeros_like(square))
