"""Make one trajectory of a data set: draw its scene, simulate it, keep it as a part.

Frames are written as they come, so that memory does not grow with their number.
The part file depends on the experiment and the number of the trajectory alone, byte for byte:
what was measured (seconds, retries of a process) is in the ``Outcome`` and goes to a log.

A run that breaks a guard is repeated with twice, then four times the substeps; the trajectory
then says so in its attributes ``substep_factor`` and ``guard_broken``.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from giorom.config import Experiment
from giorom.data.trajectory_writer import open_trajectory_writer
from giorom.data.work_folder import part_path
from giorom.mpm import Scene, SimulationError, draw_scene
from giorom.mpm.simulate import MOST_SUBSTEPS, Run, chosen_substeps
from giorom.records import one_line

SCENES_PER_SEED = 1_000_000
"""Most trajectories of one data set; sets of different seeds share no scene."""

SUBSTEP_FACTORS = (1, 2, 4)
"""Substeps of the first run of a scene and of its repetitions, as multiples."""

Tick = Callable[[int], None]
"""Called with the number of frames of the present trajectory that are done."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One trajectory to make."""

    index: int
    """Number of the trajectory."""

    seed: int
    """Seed of its scene."""

    shape: str | None
    """Shape or mesh file in place of a drawn one."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a job."""

    index: int
    """Number of the trajectory."""

    problem: str | None = None
    """Why there is no trajectory; none if there is one."""

    particle_substeps: float = 0.0
    """Particles times substeps of the run that was kept."""

    seconds: float = 0.0
    """Wall time, repetitions and storing included [s]."""

    substep_factor: int = 1
    """Multiple of the chosen substeps that went through."""


def jobs_of(indices: list[int], *, seed: int, shape: str | None) -> list[Job]:
    """The jobs of some trajectories of a set; trajectory i uses scene ``seed * 10^6 + i``."""
    return [Job(index=i, seed=seed * SCENES_PER_SEED + i, shape=shape) for i in indices]


def make_part(
    experiment: Experiment, job: Job, *, folder: Path, device: str, tick: Tick
) -> Outcome:
    """Make one trajectory and keep it, or say why not.

    Args:
        experiment: Scenes and solver.
        job: Which trajectory.
        folder: The work folder.
        device: ``cpu`` or ``cuda``.
        tick: Progress; starts again when the run is repeated.

    Raises:
        OSError: If the part cannot be written.
    """
    start = time.perf_counter()
    broken = None
    try:
        scene = draw_scene(experiment.scene, seed=job.seed, shape=job.shape)
        for factor in SUBSTEP_FACTORS:
            try:
                run = _start(experiment, scene, factor, device=device)
                _write(run, part_path(folder, job.index), _repetition(factor, broken), tick=tick)
            except SimulationError as error:
                broken = broken or one_line(error)
                continue
            return Outcome(
                index=job.index,
                particle_substeps=run.work(run.solver.frames - 1),
                seconds=time.perf_counter() - start,
                substep_factor=factor,
            )
    except ValueError as error:
        return Outcome(
            index=job.index, problem=one_line(error), seconds=time.perf_counter() - start
        )
    return Outcome(
        index=job.index,
        problem=f"{broken} It broke a guard with {SUBSTEP_FACTORS[-1]} times the substeps too.",
        seconds=time.perf_counter() - start,
        substep_factor=SUBSTEP_FACTORS[-1],
    )


def _start(experiment: Experiment, scene: Scene, factor: int, *, device: str) -> Run:
    """A run with a multiple of the substeps that the rules or the user chose."""
    solver = experiment.solver
    if factor > 1:
        substeps = min(factor * chosen_substeps(scene, solver), MOST_SUBSTEPS)
        solver = replace(solver, substeps=substeps)
    return Run(scene, solver, device=device)


def _repetition(factor: int, broken: str | None) -> dict[str, Any]:
    """What a trajectory says about the runs before the one it holds."""
    return {} if factor == 1 else {"substep_factor": factor, "guard_broken": broken}


def _write(run: Run, path: Path, more: dict[str, Any], *, tick: Tick) -> None:
    """Write the frames of a run as they come, with what makes them and nothing measured."""
    with open_trajectory_writer(
        path,
        particle_type=run.scene.particle_type.numpy(),
        frame_dt=run.solver.frame_dt,
        bounds=run.bounds.numpy(),
        attributes=run.attributes | more,
    ) as writer:
        for frame, position in enumerate(run.frames(), start=1):
            writer.append(position.numpy())
            tick(frame)
