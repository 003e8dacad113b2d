"""The grid time-stepper: samples exchange momentum through a coarse grid, by a learned law.

Stages 4 and 5 of the pipeline in one, the alternative to the network of ``time_stepper.py`` for
what flows, piles up and breaks. Samples carry mass, velocity and strain; a few times per frame
their momentum goes to a grid about as coarse as they are, the stress of a learned law
(``layers/learned_law.py``) and gravity act on the nodes, the walls stop them, and the samples
take the motion back. Mass and momentum are kept by construction, walls cannot be passed, and as
the samples weigh what they stand for, their number can change without training again.

What is learned: the constants of the law per particle type, and how much of the sample's own
velocity survives a transfer. Gravity is measured on the first frames of the training data.
"""

import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from giorom.graph import Edges
from giorom.layers.learned_law import LearnedLaw, Strain
from giorom.layers.spline_grid import SplineGrid, Stencil
from giorom.state import SparseState

HELD_MASS = 1e3
"""How much heavier a prescribed sample is made: the others cannot move it."""

BEYOND = 0.25
"""How far a sample may be pressed beyond a wall [grid cells]."""

GRADIENT_STEPS = 4
"""Passes that find the velocity gradient at the start."""

MOST_SUBSTEPS = 1000
"""Largest number of steps per frame: more would never end."""

LIGHTEST = 1e-9
"""Mass below which a node is empty, in particles."""


@dataclass(frozen=True, kw_only=True)
class GridStepperConfig:
    """Size of the grid, steps per frame and contact with walls."""

    spacing: float
    """Distance between grid nodes [m]; 1 to 1.5 times that between samples."""

    substeps: int = 6
    """Steps per frame; a wave should cross less than a cell in each."""

    wall_contact: Literal["slip", "stick"] = "slip"
    """Whether samples slide along walls."""

    own_share: float = 0.8
    """Share of its own velocity that a sample keeps in a transfer, where training starts; much
    where there are few samples per cell, as coarse grids damp, little where there are many."""

    def __post_init__(self) -> None:
        """Reject what no grid can be built from."""
        if not 0.0 < self.spacing < math.inf:
            raise ValueError(
                f"GridStepperConfig.spacing must be > 0 m and finite, got {self.spacing!r}. Take 1 "
                f"to 1.5 times the distance between samples."
            )
        if not 1 <= self.substeps <= MOST_SUBSTEPS:
            raise ValueError(
                f"GridStepperConfig.substeps must lie between 1 and {MOST_SUBSTEPS}, got "
                f"{self.substeps!r}. A few are enough: a wave should cross less than a cell in "
                f"each."
            )
        if not 0.0 < self.own_share < 1.0:
            raise ValueError(
                f"GridStepperConfig.own_share must lie between 0 and 1, got {self.own_share!r}."
            )


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """What the samples carry from one substep to the next."""

    position: Float[Tensor, "q d"]
    velocity: Float[Tensor, "q d"]
    gradient: Float[Tensor, "q d d"]
    strain: Strain


class GridStepper(nn.Module):
    """Move the samples by one frame through a coarse grid.

    Args:
        config: Size of the grid.
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, config: GridStepperConfig, *, dimension: int) -> None:
        super().__init__()
        self.config, self.dimension = config, dimension
        self.law = LearnedLaw(dimension)
        self.register_buffer("gravity", torch.zeros(dimension))
        self.blend_logit = nn.Parameter(torch.tensor(config.own_share).logit())

    @property
    def own_share(self) -> Float[Tensor, ""]:
        """Share of its own velocity that a sample keeps in a transfer (FLIP); the rest is APIC."""
        return self.blend_logit.sigmoid()

    def searched(self, particle_type: Int[Tensor, " q"]) -> dict[str, Bool[Tensor, "..."]]:
        """Which entries of each parameter matter where some particle types occur."""
        law = {f"law.{name}": mask for name, mask in self.law.used(particle_type).items()}
        return law | {"blend_logit": torch.tensor(True)}

    def step(
        self,
        state: SparseState,
        edges: Edges,
        prescribed: Float[Tensor, "q d"] | None = None,
    ) -> SparseState:
        """The state one frame later; kinematic samples go where ``prescribed`` says [m]."""
        del edges
        grid = SplineGrid(state.bounds, spacing=self.config.spacing)
        motion = self._begin(state) if state.memory is None else self._recall(state)
        target = state.position if prescribed is None else prescribed
        pushed = (target - state.position) / state.frame_dt
        if not torch.is_grad_enabled() and _has_kernels(state.position):
            motion = self._advanced(motion, state, grid, pushed)
        else:
            dt = state.frame_dt / self.config.substeps
            for _ in range(self.config.substeps):
                motion = self._substep(motion, state, grid, pushed, dt=dt)
        position = torch.where(state.kinematic[:, None], target, motion.position)
        history = torch.cat([state.history[:, 1:], position[:, None]], dim=1)
        return replace(state, history=history, memory=self._remember(motion, position))

    def start(self, state: SparseState, velocity: Float[Tensor, "q d"]) -> SparseState:
        """The state of undeformed samples with a known velocity [m/s]."""
        motion = self._at_rest(state, velocity - self._half_kick(state))
        return replace(state, memory=self._remember(motion, state.position))

    def _advanced(
        self, motion: _Motion, state: SparseState, grid: SplineGrid, pushed: Float[Tensor, "q d"]
    ) -> _Motion:
        """All substeps of a frame by the kernels of ``grid_kernels.py``; no gradients."""
        from giorom.layers.grid_kernels import advance_samples

        held, volume = state.kinematic, _weight(state).contiguous()
        moved = _Motion(
            position=_copied(motion.position),
            velocity=torch.where(held[:, None], pushed, motion.velocity),
            gradient=_copied(motion.gradient),
            strain=Strain(
                isochoric=_copied(motion.strain.isochoric),
                volume_ratio=_copied(motion.strain.volume_ratio),
            ),
        )
        advance_samples(
            grid,
            position=moved.position,
            velocity=moved.velocity,
            gradient=moved.gradient,
            strain=moved.strain,
            particle_type=state.particle_type.long(),
            batch=state.batch,
            held=held,
            volume=volume,
            mass=torch.where(held, HELD_MASS * volume, volume),
            table=self.law.table().detach().contiguous(),
            gravity=self.gravity,
            bounds=state.bounds,
            own_share=float(self.own_share),
            sticks=self.config.wall_contact == "stick",
            beyond=BEYOND * grid.spacing,
            lightest=LIGHTEST,
            scenes=state.batch_size,
            substeps=self.config.substeps,
            dt=state.frame_dt / self.config.substeps,
        )
        return moved

    def _substep(
        self,
        motion: _Motion,
        state: SparseState,
        grid: SplineGrid,
        pushed: Float[Tensor, "q d"],
        *,
        dt: float,
    ) -> _Motion:
        """Samples to grid, forces and walls, grid to samples."""
        held = state.kinematic
        velocity = torch.where(held[:, None], pushed, motion.velocity)
        stencil = grid.stencil(motion.position, state.batch)
        before, after = self._node_velocities(motion, velocity, state, grid, stencil, dt=dt)
        after = self._stopped(after, grid, state)
        taken = after[stencil.node]
        weighted = stencil.weight[:, :, None] * taken
        smooth = weighted.sum(dim=1)
        change = smooth - (stencil.weight[:, :, None] * before[stencil.node]).sum(dim=1)
        gradient = grid.inverse_moment * weighted.mT @ stencil.offset
        smooth = torch.where(held[:, None], pushed, smooth)
        kept = velocity + change
        reach = BEYOND * grid.spacing
        position = (motion.position + dt * smooth).clamp(
            state.bounds[:, 0] - reach, state.bounds[:, 1] + reach
        )
        velocity = smooth + self.own_share * (kept - smooth)
        return _Motion(
            position=position,
            velocity=torch.where(held[:, None], pushed, velocity),
            gradient=gradient,
            strain=self.law.flow(motion.strain, gradient, state.particle_type, dt=dt),
        )

    def _node_velocities(
        self,
        motion: _Motion,
        velocity: Float[Tensor, "q d"],
        state: SparseState,
        grid: SplineGrid,
        stencil: Stencil,
        *,
        dt: float,
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Velocities of the nodes before and after the forces of a substep."""
        volume = _weight(state)
        mass = torch.where(state.kinematic, HELD_MASS * volume, volume)
        share = stencil.weight * mass[:, None]
        momentum = velocity[:, None] + stencil.offset @ motion.gradient.mT
        stress = self.law.stress(motion.strain, state.particle_type)
        force = -grid.inverse_moment * stencil.offset @ stress.mT
        load = stencil.weight * volume[:, None]
        given = torch.cat(
            [share[:, :, None] * momentum, load[:, :, None] * force, share[:, :, None]], dim=2
        )
        total = grid.gather(stencil, given, scenes=state.batch_size)
        d = grid.dimension
        density = total[:, -1:].clamp_min(LIGHTEST)
        before = total[:, :d] / density
        return before, before + dt * (total[:, d : 2 * d] / density + self.gravity)

    def _stopped(
        self, velocity: Float[Tensor, "n d"], grid: SplineGrid, state: SparseState
    ) -> Float[Tensor, "n d"]:
        """Node velocities without what points into a wall."""
        lower, upper = (
            walls.repeat(state.batch_size, 1) for walls in _wall_nodes(grid, state.bounds)
        )
        into = (lower & (velocity < 0.0)) | (upper & (velocity > 0.0))
        if self.config.wall_contact == "stick":
            into = into.any(dim=1, keepdim=True).expand_as(into)
        return velocity.masked_fill(into, 0.0)

    def _begin(self, state: SparseState) -> _Motion:
        """Undeformed samples that move as their last two frames say."""
        # The difference of two frames is the velocity half a frame ago.
        velocity = state.velocity + 0.5 * state.frame_dt * self.gravity - self._half_kick(state)
        return self._at_rest(state, velocity)

    def _at_rest(self, state: SparseState, velocity: Float[Tensor, "q d"]) -> _Motion:
        """Undeformed samples with a velocity [m/s] and the gradient of it.

        The gradient is found by passing the velocity through the grid with what is known of the
        gradient; a turn is lost without it.
        """
        d = self.dimension
        motion = _Motion(
            position=state.position,
            velocity=velocity,
            gradient=velocity.new_zeros(len(velocity), d, d),
            strain=self.law.rest(state.particle_type),
        )
        grid = SplineGrid(state.bounds, spacing=self.config.spacing)
        stencil = grid.stencil(state.position, state.batch)
        for _ in range(GRADIENT_STEPS):
            node, _ = self._node_velocities(motion, velocity, state, grid, stencil, dt=0.0)
            weighted = stencil.weight[:, :, None] * node[stencil.node]
            motion = replace(motion, gradient=grid.inverse_moment * weighted.mT @ stencil.offset)
        return motion

    def _half_kick(self, state: SparseState) -> Float[Tensor, " d"]:
        """What half a substep of gravity adds [m/s].

        Velocities lag by so much, as in leapfrog: free fall is a parabola whatever the step.
        """
        return 0.5 * state.frame_dt / self.config.substeps * self.gravity

    def _remember(self, motion: _Motion, position: Float[Tensor, "q d"]) -> Float[Tensor, "q m"]:
        """The motion as one row per sample."""
        strain = motion.strain
        return torch.cat(
            [
                position,
                motion.velocity,
                motion.gradient.flatten(1),
                strain.isochoric.flatten(1),
                strain.volume_ratio[:, None],
            ],
            dim=1,
        )

    def _recall(self, state: SparseState) -> _Motion:
        """The inverse of ``_remember``; samples that were moved since take the velocity of it."""
        d = self.dimension
        place, velocity, gradient, isochoric, ratio = state.memory.split(
            [d, d, d * d, d * d, 1], dim=1
        )
        moved = (state.position - place) / state.frame_dt
        return _Motion(
            position=state.position,
            velocity=velocity + moved,
            gradient=gradient.unflatten(1, (d, d)),
            strain=Strain(
                isochoric=isochoric.unflatten(1, (d, d)),
                volume_ratio=ratio[:, 0],
            ),
        )


def _weight(state: SparseState) -> Float[Tensor, " q"]:
    """Particles each sample stands for, without units: only ratios matter."""
    if state.weight is None:
        return torch.ones_like(state.position[:, 0])
    return state.weight


def _copied(value: Tensor) -> Tensor:
    """A contiguous copy, which kernels may write into."""
    return value.clone(memory_format=torch.contiguous_format)


def _wall_nodes(
    grid: SplineGrid, bounds: Float[Tensor, "d 2"]
) -> tuple[Bool[Tensor, "n d"], Bool[Tensor, "n d"]]:
    """Nodes at or beyond the lower and the upper wall of each axis."""
    tolerance = 1e-3 * grid.spacing
    lower = grid.node_position <= bounds[:, 0] + tolerance
    return lower, grid.node_position >= bounds[:, 1] - tolerance


def _has_kernels(position: Tensor) -> bool:
    """Whether the fast path is there: Warp, and single precision."""
    return position.dtype == torch.float32 and find_spec("warp") is not None
