"""Make a data set: many scenes, simulated side by side, each finished one kept at once."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from giorom.config import Experiment
from giorom.data.trajectory_file import SPLITS
from giorom.data.work_folder import (
    assemble_dataset,
    finished_parts,
    open_work_folder,
    split_parts,
    write_part,
)
from giorom.graph import choose_radius
from giorom.mpm import SimulationError, draw_scene, simulate
from giorom.records import one_line
from giorom.sampling import sample
from giorom.state import Trajectory

SCENES_PER_SEED = 1_000_000
"""Scenes of one data set; sets of different seeds share none below this size."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One trajectory to make."""

    index: int
    """Number of the trajectory."""

    seed: int
    """Seed of its scene."""

    shape: str | None
    """Shape or mesh file in place of a drawn one."""


def generate(
    experiment: Experiment,
    *,
    folder: Path,
    trajectories: int,
    seed: int,
    jobs: int,
    shape: str | None,
    device: str,
    report: Callable[[int, int], None],
) -> dict[str, Any]:
    """Simulate what is missing of a data set and assemble it.

    A scene whose simulation breaks a guard is left out and counted; the others go on.

    Args:
        experiment: Scenes and solver.
        folder: The data set; one begun earlier is continued.
        trajectories: Number of trajectories the data set shall hold.
        seed: Seed of the set; trajectory i uses scene ``seed * SCENES_PER_SEED + i``.
        jobs: Processes (one trajectory each).
        shape: Shape or mesh file in place of the drawn ones.
        device: ``cpu`` or ``cuda``.
        report: Called with (finished, wanted).

    Returns:
        The keys of ``giorom simulate --json``.

    Raises:
        ValueError: If the folder holds another data set, or no scene can be simulated.
    """
    start = time.perf_counter()
    identity = {
        "system": experiment.system,
        "seed": seed,
        "shape": shape,
        "scene": asdict(experiment.scene),
        "solver": asdict(experiment.solver),
    }
    # The first scene is drawn here, so that a scene that cannot be drawn leaves nothing behind.
    body = draw_scene(experiment.scene, seed=seed * SCENES_PER_SEED, shape=shape).position
    open_work_folder(folder, identity=identity)
    done = set(finished_parts(folder))
    todo = [
        Job(index=index, seed=seed * SCENES_PER_SEED + index, shape=shape)
        for index in range(trajectories)
        if index not in done
    ]
    failed, work = [], 0.0
    for count, (index, problem, amount) in enumerate(
        _run(todo, experiment, folder=folder, jobs=jobs, device=device), start=1
    ):
        report(trajectories - len(todo) + count, trajectories)
        work += amount
        if problem is not None:
            failed.append({"index": index, "reason": problem})
    parts = [part for part in finished_parts(folder) if part < trajectories]
    if not parts:
        raise SimulationError(f"no trajectory could be simulated; the first: {failed[0]['reason']}")
    seconds = time.perf_counter() - start
    metadata = assemble_dataset(
        folder, radius=_default_radius(experiment, body), splits=split_parts(parts)
    )
    return {
        "trajectories": len(parts),
        "points": metadata["num_particles_max"],
        "frames": metadata["sequence_length_train"],
        "frame_dt": metadata["dt"],
        "particle_substeps_per_second": work / seconds if work else None,
        "seconds": seconds,
        "failed": len(failed),
        "failures": failed,
        "splits": {name: metadata[f"num_trajs_{name}"] for name in SPLITS},
    }


def make_trajectory(experiment: Experiment, job: Job, *, device: str) -> Trajectory:
    """Draw and simulate one scene."""
    scene = draw_scene(experiment.scene, seed=job.seed, shape=job.shape)
    return simulate(scene, experiment.solver, device=device)


def _run(
    todo: list[Job], experiment: Experiment, *, folder: Path, jobs: int, device: str
) -> Iterator[tuple[int, str | None, float]]:
    """Work the jobs off: (number, what went wrong, particle-substeps) of each."""
    if jobs == 1 or len(todo) <= 1:
        for job in todo:
            yield _finish(experiment, job, folder, device)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=min(jobs, len(todo)), mp_context=context) as pool:
        waiting = {pool.submit(_finish, experiment, job, folder, device): job for job in todo}
        for future in as_completed(waiting):
            try:
                yield future.result()
            except BrokenProcessPool:
                yield waiting[future].index, "its process was ended from outside", 0.0


def _finish(
    experiment: Experiment, job: Job, folder: Path, device: str
) -> tuple[int, str | None, float]:
    """Make one trajectory and keep it, or say why not."""
    try:
        trajectory = make_trajectory(experiment, job, device=device)
    except (SimulationError, ValueError) as error:
        return job.index, one_line(error), 0.0
    write_part(folder, job.index, trajectory)
    steps = trajectory.attributes["substeps"] * (trajectory.frame_count - 1)
    return job.index, None, float(trajectory.position.shape[1] * steps)


def _default_radius(experiment: Experiment, start: Tensor) -> float:
    """Graph radius for the metadata: what the body ``start`` asks for [m]."""
    if experiment.graph.radius is not None:
        return experiment.graph.radius
    samples = start[sample(start, experiment.sampling)]
    return choose_radius(samples, start, margin=experiment.graph.margin).radius
