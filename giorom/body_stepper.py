r"""The body time-stepper: a soft body on a coarse grid that is fixed to its undeformed shape.

Stages 4 and 5 of the pipeline in one, the alternative for what never flows: clamped and free
elastic bodies. The displacement of the body is a spline on the nodes of the grid
(``layers/body_grid.py``), and the nodes move as the stress says, integrated over the whole
undeformed body. Nothing is handed back and forth between samples and grid, so nothing is smeared;
the samples only say how the motion starts and read it. With the deformation gradient :math:`F`,

.. math::
    M \dot v = -\int P \nabla N \, dV + M g , \qquad
    P = \tau F^{-T} + \eta\, F (F^T \dot F + \dot F^T F) , \qquad
    \tau = G\, \mathrm{dev}\, \bar b + K J (J - 1)\, I ,

the elastic part of the law of ``layers/learned_law.py`` but for the bulk, which stiffens like that
law with an exponent near three, stepped by the leapfrog rule a few times per frame. The shortest
waves, which the frames do not resolve, are given more inertia, so that they stay stable; the long
ones keep their frequency.

What is learned: the elastic constants and the viscosity, each divided by the density. Gravity is
measured on the first frames of the training data, where these show it.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from giorom.graph import Edges
from giorom.layers.body_grid import BodyGrid, BodyGridConfig, Reading, body_grid
from giorom.layers.learned_law import determinant, deviator
from giorom.state import PARTICLE_TYPE_COUNT, SparseState

START_BULK, START_SHEAR = 100.0, 50.0
"""Moduli over density that training starts from [m^2/s^2]."""

START_VISCOSITY = 0.01
"""Viscosity over density that training starts from [m^2/s]."""

LARGEST_PHASE = 1.6
"""Largest phase of a wave in one substep; the leapfrog rule is unstable from 2 on."""

STIFFENING = 1.5
"""How much stiffer a deformed body is taken to be than an undeformed one at most."""

MOST_SUBSTEPS = 1000
"""Largest number of steps per frame: more would never end."""

MOST_CELLS = 100
"""Largest number of cells per node distance; a body has fewer particles than that."""

SMALLEST_VOLUME = 0.05
"""Volume ratio at which the pressure stops rising."""


@dataclass(frozen=True, kw_only=True)
class BodyStepperConfig:
    """Size of the grid of a body."""

    spacing: float
    """Distance between grid nodes [m]; about a fifth of the body."""

    height_spacing: float | None = None
    """Distance of their rows along the vertical axis [m]; half the other where a body is held from
    below, as it bends most there; null: the same."""

    substeps: int = 2
    """Steps per frame."""

    cells: int = 3
    """Cells per node distance and axis over which the body is integrated."""

    lumped: float = 0.25
    """Share of the mass that sits on the nodes; the rest is spread as the splines are."""

    held_rows: float | None = None
    """Where a body is held [m]: up to the multiple of this height next to its highest held
    particle, as in data of a grid solver whose rows of nodes stick; null: up to that particle."""

    def __post_init__(self) -> None:
        """Reject what no grid can be built from."""
        if not 0.0 < self.spacing < math.inf:
            raise ValueError(
                f"BodyStepperConfig.spacing must be > 0 m and finite, got {self.spacing!r}. Take "
                f"about a fifth of the size of the body."
            )
        for name, most in (("substeps", MOST_SUBSTEPS), ("cells", MOST_CELLS)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(
                    f"BodyStepperConfig.{name} must lie between 1 and {most}, got "
                    f"{getattr(self, name)!r}. A few are enough."
                )
        if not 0.0 <= self.lumped <= 1.0:
            raise ValueError(
                f"BodyStepperConfig.lumped is a share and must lie in [0, 1], got {self.lumped!r}."
            )
        for name in ("held_rows", "height_spacing"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(
                    f"BodyStepperConfig.{name} must be > 0 m and finite, got {value!r}. Leave it "
                    f"out for its default."
                )

    def grid(self, dimension: int) -> BodyGridConfig:
        """What the operators of a body depend on."""
        spacing = [self.spacing] * dimension
        spacing[1] = self.height_spacing or self.spacing
        return BodyGridConfig(
            spacing=tuple(spacing),
            cells=self.cells,
            lumped=self.lumped,
            held_rows=self.held_rows,
        )


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """One body of a batch at one frame: its operators and its samples."""

    grid: BodyGrid
    reading: Reading
    reference: Float[Tensor, "q d"]
    position: Float[Tensor, "q d"]
    velocity: Float[Tensor, "q d"]
    target: Float[Tensor, "q d"]
    kinematic: Bool[Tensor, " q"]
    frame_dt: float


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """Displacement [m] of the nodes, and their velocity half a substep ago [m/s]."""

    displacement: Float[Tensor, "m d"]
    velocity: Float[Tensor, "m d"]


class BodyStepper(nn.Module):
    """Move the samples of soft bodies by one frame.

    Args:
        config: Size of the grid.
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, config: BodyStepperConfig, *, dimension: int) -> None:
        super().__init__()
        self.config, self.dimension = config, dimension
        self.register_buffer("gravity", torch.zeros(dimension))
        every = torch.ones(PARTICLE_TYPE_COUNT)
        self.log_bulk = nn.Parameter((START_BULK * every).log())
        self.log_shear = nn.Parameter((START_SHEAR * every).log())
        self.log_viscosity = nn.Parameter(torch.tensor(START_VISCOSITY).log())

    def step(
        self,
        state: SparseState,
        edges: Edges,
        prescribed: Float[Tensor, "q d"] | None = None,
    ) -> SparseState:
        """The state one frame later; kinematic samples go where ``prescribed`` says [m].

        Raises:
            ValueError: If the state does not know the full-order bodies.
        """
        del edges
        target = state.position if prescribed is None else prescribed
        scenes = self._scenes(state, target)
        tables = state.memory if isinstance(state.memory, tuple) else (None,) * len(scenes)
        positions, memory = [], []
        for scene, table in zip(scenes, tables, strict=True):
            motion = self._begin(scene) if table is None else _recall(scene, table)
            seen = scene.position - scene.reading(motion.displacement)
            motion = self._frame(scene, motion)
            # What the nodes cannot show of the samples stays as it is.
            position = seen + scene.reading(motion.displacement)
            positions.append(torch.where(scene.kinematic[:, None], scene.target, position))
            memory.append(_remember(motion, positions[-1]))
        history = torch.cat([state.history[:, 1:], torch.cat(positions)[:, None]], dim=1)
        return replace(state, history=history, memory=tuple(memory))

    def start(self, state: SparseState, velocity: Float[Tensor, "q d"]) -> SparseState:
        """The state of undeformed samples with a known velocity [m/s]."""
        memory = []
        for scene, given in zip(
            self._scenes(state, state.position), _split(velocity, state), strict=True
        ):
            motion = _Motion(
                displacement=_nodes(scene, scene.position - scene.reference),
                velocity=_nodes(scene, given),
            )
            back = -0.5 * scene.frame_dt / self.config.substeps
            memory.append(_remember(self._pushed(scene, motion, back), scene.position))
        return replace(state, memory=tuple(memory))

    def _scenes(self, state: SparseState, target: Float[Tensor, "q d"]) -> list[_Scene]:
        """The bodies of a batch, one after the other."""
        if state.bodies is None:
            raise ValueError(
                "the body stepper integrates over the whole body, but this state does not say "
                "which (SparseState.bodies is None). Start it with Simulator.start, "
                "start_from_trajectory or windows of sampled trajectories that are not turned."
            )
        values = (state.reference, state.position, state.velocity, target, state.kinematic)
        scenes = []
        for body, *parts in zip(state.bodies, *(_split(v, state) for v in values), strict=True):
            grid = body_grid(body, self.config.grid(self.dimension))
            names = ("reference", "position", "velocity", "target", "kinematic")
            scenes.append(
                _Scene(
                    grid=grid,
                    reading=grid.reading(parts[0], parts[-1]),
                    frame_dt=state.frame_dt,
                    **dict(zip(names, parts, strict=True)),
                )
            )
        return scenes

    def _begin(self, scene: _Scene) -> _Motion:
        """Nodes that explain the samples and the difference of their last two frames."""
        motion = _Motion(
            displacement=_nodes(scene, scene.position - scene.reference),
            velocity=_nodes(scene, scene.velocity),
        )
        # The difference is the velocity half a frame ago, the rule needs half a substep.
        return self._pushed(
            scene, motion, 0.5 * scene.frame_dt * (1.0 - 1.0 / self.config.substeps)
        )

    def _frame(self, scene: _Scene, motion: _Motion) -> _Motion:
        """One frame: leapfrog substeps; held nodes follow the held samples."""
        free = scene.grid.free_count
        dt = scene.frame_dt / self.config.substeps
        moved = (scene.target - scene.position)[scene.kinematic] / scene.frame_dt
        dragged = scene.reading.drag @ moved
        motion = replace(motion, velocity=torch.cat([motion.velocity[:free], dragged]))
        for _ in range(self.config.substeps):
            motion = self._pushed(scene, motion, dt)
            motion = replace(motion, displacement=motion.displacement + dt * motion.velocity)
        return motion

    def _pushed(self, scene: _Scene, motion: _Motion, time: float) -> _Motion:
        """The same nodes after their acceleration has acted for a while [s]."""
        grid, free = scene.grid, scene.grid.free_count
        slope = grid.slope
        identity = torch.eye(self.dimension, device=slope.device)
        both = torch.cat([motion.displacement, motion.velocity], dim=1)
        gradient, rate = (both[grid.node].mT @ slope).split(self.dimension, dim=1)
        stress = self._stress(identity + gradient, rate, grid.particle_type)
        load = -slope @ (grid.volume[:, None, None] * stress).mT
        force = load.new_zeros(grid.node_count, self.dimension)
        force = force.index_add(0, grid.node.flatten(), load.flatten(0, 1))[:free]
        force = force + grid.mass[:, None] * self.gravity
        inverse = grid.inverse_mass(self._inertia(grid, scene.frame_dt))
        change = time * inverse @ force
        velocity = torch.cat([motion.velocity[:free] + change, motion.velocity[free:]])
        return replace(motion, velocity=velocity)

    def _stress(
        self,
        gradient: Float[Tensor, "n d d"],
        rate: Float[Tensor, "n d d"],
        particle_type: Int[Tensor, " n"],
    ) -> Float[Tensor, "n d d"]:
        """First Piola stress over density [m^2/s^2], elastic and viscous."""
        cofactor, volume = cofactors(gradient)
        volume = volume.clamp_min(SMALLEST_VOLUME)
        bulk, shear = self.log_bulk.exp()[particle_type], self.log_shear.exp()[particle_type]
        # tau F^-T, and F^-T is the cofactor matrix over the volume ratio.
        change = (shear * volume.pow(-2.0 / self.dimension - 1.0))[:, None, None]
        pressed = (bulk * (volume - 1.0))[:, None, None]
        elastic = change * deviator(gradient @ gradient.mT) @ cofactor + pressed * cofactor
        turned = gradient.mT @ rate
        return elastic + self.log_viscosity.exp() * gradient @ (turned + turned.mT)

    def _inertia(self, grid: BodyGrid, frame_dt: float) -> float:
        r"""The factor of ``BodyGrid.inverse_mass`` [m^2]; not differentiated.

        :math:`\beta = S \Delta t^2 / (2 \phi^2) + \eta \Delta t` with the stiffness S of waves over
        the density: the phase of a wave in a substep is then at most :math:`\phi`.
        """
        dt = frame_dt / self.config.substeps
        kinds = grid.particle_type.unique()
        bulk, shear = (log.detach().exp()[kinds] for log in (self.log_bulk, self.log_shear))
        stiffness = STIFFENING * float((bulk + 4.0 / 3.0 * shear).max())
        viscosity = float(self.log_viscosity.detach().exp())
        return 0.5 * stiffness * (dt / LARGEST_PHASE) ** 2 + viscosity * dt


def _nodes(scene: _Scene, value: Float[Tensor, "q d"]) -> Float[Tensor, "m d"]:
    """Values at the nodes that explain those at the samples."""
    reading, free = scene.reading, scene.grid.free_count
    held = reading.drag @ value[scene.kinematic]
    known = torch.cat([held.new_zeros(free, value.shape[1]), held])
    return torch.cat([reading.fit @ (value - reading(known))[reading.moving], held])


def _remember(motion: _Motion, position: Float[Tensor, "q d"]) -> Tensor:
    """The motion as one table: nodes, then where the samples were left."""
    nodes = torch.cat([motion.displacement, motion.velocity], dim=1)
    return torch.cat([nodes, torch.cat([position, torch.zeros_like(position)], dim=1)])


def _recall(scene: _Scene, table: Tensor) -> _Motion:
    """The inverse of ``_remember``; samples that were moved since take the nodes along."""
    count, d = scene.grid.node_count, scene.reference.shape[1]
    displacement, velocity = table[:count].split(d, dim=1)
    moved = scene.position - table[count:, :d]
    if bool((moved != 0.0).any()):
        change = _nodes(scene, moved)
        displacement, velocity = displacement + change, velocity + change / scene.frame_dt
    return _Motion(displacement=displacement, velocity=velocity)


def _split(value: Tensor, state: SparseState) -> tuple[Tensor, ...]:
    """Rows of each scene."""
    counts = torch.bincount(state.batch, minlength=state.batch_size)
    return value.split(counts.tolist())


def cofactors(
    matrix: Float[Tensor, "n d d"],
) -> tuple[Float[Tensor, "n d d"], Float[Tensor, " n"]]:
    """Cofactor matrices and determinants of small matrices."""
    if matrix.shape[1] == 2:
        turn = matrix.new_tensor([[0.0, 1.0], [-1.0, 0.0]])
        return turn @ matrix @ turn.T, determinant(matrix)
    a, b, c = matrix.unbind(dim=1)
    rows = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    cofactor = torch.stack(rows, dim=1)
    return cofactor, (a * cofactor[:, 0]).sum(dim=1)
