"""Run a scene: from initial particles to a trajectory of the full-order body.

The last step before the trajectory file. The domain is the unit box, axis 1 points up;
its grid has ``grid_cells`` cells per axis. Between two stored frames the kernels of
``transfer.py`` run ``substeps`` times, recorded once and replayed. A run either ends with
every position finite and inside the walls, or raises: nothing is clipped in silence.

SI units. Warp is imported only when a simulation starts.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.boundary import WALL_TOLERANCE, Walls, walls_of
from giorom.mpm.materials import material_attributes
from giorom.mpm.scene import Scene
from giorom.state import Trajectory

SPEED_LIMIT = 0.3
"""Largest way of a particle in one substep [cells]."""

MOST_GRID_CELLS = 1024
"""Nodes are counted in 32 bits."""

MOST_SUBSTEPS = 1_000_000
"""Most substeps of one frame; more is a wrong unit, not a simulation."""

HEADROOM = 2.0
"""How much faster than the scene's own estimate a particle may become."""


class SimulationError(RuntimeError):
    """A run that broke a guard: which frame, which guard, by how much, and what to change."""


@dataclass(frozen=True, kw_only=True)
class SolverConfig:
    """Resolution of the simulation in space and time."""

    grid_cells: int
    """Grid cells per axis of the unit box; a cell is about two particle spacings wide [-]."""

    frame_dt: float
    """Time between stored frames [s]."""

    frames: int
    """Stored frames, the initial one included."""

    substeps: int | None = None
    """Substeps per frame; ``None`` takes the fewest that the time-step rules allow."""

    def __post_init__(self) -> None:
        """Reject what cannot run."""
        if self.grid_cells < 8:
            raise ValueError(
                f"SolverConfig.grid_cells must be at least 8 (walls and stencils take 3 cells "
                f"on each side), got {self.grid_cells!r}."
            )
        if self.grid_cells > MOST_GRID_CELLS:
            raise ValueError(
                f"SolverConfig.grid_cells must be at most {MOST_GRID_CELLS} per axis, got "
                f"{self.grid_cells!r}; the grid would not fit into memory."
            )
        if not (self.frame_dt > 0.0 and math.isfinite(self.frame_dt)):
            raise ValueError(f"SolverConfig.frame_dt must be > 0 s, got {self.frame_dt!r}.")
        if self.frames < 1:
            raise ValueError(f"SolverConfig.frames must be at least 1, got {self.frames!r}.")
        if self.substeps is not None and self.substeps < 1:
            raise ValueError(
                f"SolverConfig.substeps must be at least 1, got {self.substeps!r}. Leave it "
                f"out to have it chosen."
            )


def simulate(
    scene: Scene,
    solver: SolverConfig,
    *,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Simulate a scene with the material point method.

    Args:
        scene: Initial particles, material, walls and gravity.
        solver: Grid and time steps.
        device: ``"cpu"`` (one thread, bit-reproducible) or ``"cuda"``.
        progress: Called with (frames done, frames) after each frame.

    Returns:
        Exactly ``solver.frames`` frames on the CPU; frame 0 is the scene itself. ``bounds``
        are the effective wall planes; ``attributes`` hold what made it and how long it took.

    Raises:
        ValueError: If a position is not finite or outside the walls, a time-step rule is
            broken before the run, or the run ends before its change of material.
        SimulationError: If a guard is broken during the run.

    Source:
        Hu et al., "A Moving Least Squares Material Point Method", SIGGRAPH 2018.
    """
    run = Run(scene, solver, device=device)
    start = time.perf_counter()
    position = torch.empty(solver.frames, *scene.position.shape)
    for frame, current in enumerate(run.frames()):
        position[frame] = current
        if progress is not None and frame > 0:
            progress(frame + 1, solver.frames)
    return run.trajectory(position, seconds=time.perf_counter() - start)


class Run:
    """A simulation that is ready to start: its frames come one by one, in constant memory.

    Args:
        scene: Initial particles, material, walls and gravity.
        solver: Grid and time steps.
        device: ``"cpu"`` or ``"cuda"``.
        obey_rules: Whether the substeps asked for must be those that the time-step rules allow;
            the rules keep a margin, and without them only the guards of every frame are left.
    """

    def __init__(
        self,
        scene: Scene,
        solver: SolverConfig,
        *,
        device: str = "cpu",
        obey_rules: bool = True,
    ) -> None:
        self.scene = scene
        self.solver = solver
        self.walls, self.substeps = require_runnable(scene, solver, obey_rules=obey_rules)

        from giorom.mpm.engine import Engine

        self._engine = Engine(
            scene, self.walls, substep_dt=solver.frame_dt / self.substeps, device=device
        )

    def frames(self) -> Iterator[Float[Tensor, "p d"]]:
        """Simulate and give the positions of each frame, the initial one first [m].

        Raises:
            SimulationError: If a frame breaks a guard.
        """
        engine, switch = self._engine, self.scene.switch
        yield engine.position()
        for frame in range(1, self.solver.frames):
            if switch is not None and frame == switch.frame + 1:
                engine.switch(switch.material_index, switch.material)
            engine.advance(self.substeps)
            position = engine.position()
            _require_sound(position, engine.velocity(), self.walls, engine.substep_dt, frame)
            yield position

    @property
    def bounds(self) -> Float[Tensor, "d 2"]:
        """Effective wall planes [m]."""
        return self.walls.planes.to(torch.float32)

    @property
    def attributes(self) -> dict[str, Any]:
        """What makes the trajectory; the same in every repetition."""
        return (
            self.scene.attributes
            | _material_attributes(self.scene)
            | {
                "solver": "MLS-MPM, APIC, quadratic B-splines",
                "grid_cells": self.solver.grid_cells,
                "substeps": self.substeps,
                "substep_dt": self.solver.frame_dt / self.substeps,
                "effective_clamp_plane": self.walls.clamp_plane,
            }
            | self._engine.attributes
        )

    def work(self, frames: int) -> float:
        """Particle-substeps behind a number of frames after the initial one."""
        return float(len(self.scene.position)) * self.substeps * frames

    def trajectory(self, position: Float[Tensor, "t p d"], *, seconds: float) -> Trajectory:
        """The frames as a trajectory that says how long they took."""
        measured = {
            "seconds": seconds,
            "particle_substeps_per_second": self.work(len(position) - 1) / seconds,
        }
        return Trajectory(
            position=position,
            particle_type=self.scene.particle_type.clone(),
            frame_dt=self.solver.frame_dt,
            bounds=self.bounds,
            attributes=self.attributes | measured,
        )


def require_runnable(
    scene: Scene, solver: SolverConfig, *, obey_rules: bool = True
) -> tuple[Walls, int]:
    """Check a scene against a grid and its time steps, before anything is started.

    Args:
        scene: Initial particles, material, walls and gravity.
        solver: Grid and time steps.
        obey_rules: Whether substeps asked for are checked against the time-step rules.

    Returns:
        The walls on the grid and the substeps of a frame.

    Raises:
        ValueError: If the scene does not lie inside its walls, a wall is too near the side of the
            box, a time-step rule is broken, or the run ends before its change of material.
    """
    _require_switch_in_run(scene, solver)
    walls = walls_of(scene, solver.grid_cells)
    walls.require_inside(scene.position)
    if solver.substeps is not None and not obey_rules:
        return walls, solver.substeps
    return walls, chosen_substeps(scene, solver)


def _require_switch_in_run(scene: Scene, solver: SolverConfig) -> None:
    """Refuse a change of material that no stored frame would show."""
    if scene.switch is not None and scene.switch.frame > solver.frames - 2:
        raise ValueError(
            f"MaterialSwitch.frame is {scene.switch.frame}, but the run has {solver.frames} frames "
            f"(0 to {solver.frames - 1}), so that none would be of the new material. Raise "
            f"SolverConfig.frames (--solver.frames) to {scene.switch.frame + 2} or more, or lower "
            f"scene.switch.frame."
        )


def fastest_speed(scene: Scene) -> float:
    """Upper estimate of the particle speed of a scene, headroom included [m/s].

    The start speed plus what gravity adds over the height of the box, times ``HEADROOM``
    (waves focus at tips, splashes outrun the body that makes them).
    """
    start = float(scene.velocity.norm(dim=1).max())
    height = float(scene.bounds[1, 1] - scene.bounds[1, 0])
    return HEADROOM * math.sqrt(start**2 + 2.0 * scene.gravity * height)


def largest_substep(scene: Scene, grid_cells: int) -> tuple[float, str]:
    """Largest time step the rules allow, and the rule that sets it.

    Two rules: a pressure wave crosses at most ``cfl_limit`` cells per substep in every material
    of the scene, and the fastest particle at most ``SPEED_LIMIT``.

    Returns:
        The step [s] and the rule in words.
    """
    cell = 1.0 / grid_cells
    speed = fastest_speed(scene)
    rules = [
        (
            law.cfl_limit * cell / law.sound_speed,
            f"sound speed {law.sound_speed:.4g} m/s of {law.name} * substep_dt <= "
            f"{law.cfl_limit} dx",
        )
        for law in scene.laws
    ]
    if speed > 0.0:
        rules.append(
            (
                SPEED_LIMIT * cell / speed,
                f"particle speed {speed:.4g} m/s * substep_dt <= {SPEED_LIMIT} dx",
            )
        )
    return min(rules)


def chosen_substeps(scene: Scene, solver: SolverConfig) -> int:
    """Substeps of a frame: those asked for, or the fewest that the time-step rules allow.

    Raises:
        ValueError: If those asked for are too few, or more than ``MOST_SUBSTEPS`` are needed.
    """
    limit, rule = largest_substep(scene, solver.grid_cells)
    asked = solver.frame_dt / limit if limit > 0.0 else math.inf
    if not max(asked, solver.substeps or 0) <= MOST_SUBSTEPS:
        raise ValueError(
            f"a frame of {solver.frame_dt:g} s would take {max(asked, solver.substeps or 0):.3g} "
            f"substeps ({rule}), more than {MOST_SUBSTEPS}. Lower SolverConfig.frame_dt or "
            f"substeps, or check stiffness, density and speed."
        )
    needed = math.ceil(asked * (1.0 - 1e-9))
    if solver.substeps is None:
        return needed
    if solver.substeps < needed:
        raise ValueError(
            f"substep_dt = {solver.frame_dt / solver.substeps:.4g} s breaks the time-step rule "
            f"{rule}, dx = {1.0 / solver.grid_cells:.4g} m (at most {limit:.4g} s). Set "
            f"SolverConfig.substeps to {needed} or more, or leave it out."
        )
    return solver.substeps


def _require_sound(
    position: Float[Tensor, "p d"],
    velocity: Float[Tensor, "p d"],
    walls: Walls,
    substep_dt: float,
    frame: int,
) -> None:
    """Raise ``SimulationError`` if the state of a frame breaks a guard."""
    lost = ~(torch.isfinite(position).all(dim=1) & torch.isfinite(velocity).all(dim=1))
    if bool(lost.any()):
        raise SimulationError(
            f"frame {frame}: guard 'finite' broken by {int(lost.sum())} particles, the first is "
            f"{int(lost.nonzero()[0])}. Raise SolverConfig.substeps or soften the material."
        )
    way = float(velocity.norm(dim=1).max()) * substep_dt * walls.grid_cells
    if way > SPEED_LIMIT:
        raise SimulationError(
            f"frame {frame}: guard 'speed' broken: a particle moves {way:.3g} cells in one "
            f"substep, at most {SPEED_LIMIT} are allowed. Raise SolverConfig.substeps by the "
            f"factor {math.ceil(10.0 * way / SPEED_LIMIT) / 10.0:g} or lower the initial speed."
        )
    outside = walls.outside(position)
    if outside > WALL_TOLERANCE / walls.grid_cells:
        raise SimulationError(
            f"frame {frame}: guard 'box' broken: a particle is {outside:.3g} m beyond a wall, at "
            f"most {WALL_TOLERANCE / walls.grid_cells:.3g} m is allowed. Raise "
            f"SolverConfig.substeps or lower the initial speed."
        )


def _material_attributes(scene: Scene) -> dict[str, Any]:
    """Every material of a scene as JSON values, and its change during the run, if there is one."""
    materials = {"materials": [material_attributes(material) for material in scene.materials]}
    if scene.switch is None:
        return materials
    return materials | {
        "material_switch": {
            "frame": scene.switch.frame,
            "material_index": scene.switch.material_index,
            **material_attributes(scene.switch.material),
        }
    }
