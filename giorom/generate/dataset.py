"""Make a data set: what is missing is simulated, what is there is put together."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from giorom.config import Experiment
from giorom.data.atomic import disk_is_full
from giorom.data.lock import only_writer
from giorom.data.trajectory_file import SPLITS
from giorom.data.work_folder import (
    assemble_dataset,
    finished_parts,
    open_work_folder,
    split_parts,
)
from giorom.data.work_log import append_entry, keep_failures, remove_leftovers
from giorom.generate.cluster import Cluster, require_cluster, run_on_cluster
from giorom.generate.pool import run_jobs
from giorom.generate.room import require_room
from giorom.generate.trajectory import SCENES_PER_SEED, Outcome, Tick, jobs_of
from giorom.graph import choose_radius
from giorom.mpm import Scene, SimulationError, draw_scene, require_runnable
from giorom.sampling import sample

Report = Callable[[int, int], None]
"""Called with the frames done and the frames wanted, of all trajectories together."""

Runner = Callable[[list[int], Tick], Iterable[Outcome]]
"""Works off the trajectories of some numbers."""


def generate(
    experiment: Experiment,
    *,
    folder: Path,
    trajectories: int,
    seed: int,
    jobs: int,
    shape: str | None,
    device: str,
    report: Report,
    cluster: Cluster | None = None,
    announce: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Simulate what is missing of a data set and assemble it.

    A scene whose simulation breaks a guard, with more substeps too, is left out and listed in
    ``failures.json``; the others go on. An interrupted call leaves finished trajectories, and
    the next one makes the rest: the files are the same, byte for byte, as without interruption.

    Args:
        experiment: Scenes and solver.
        folder: The data set; one begun earlier is continued.
        trajectories: Number of trajectories the data set shall hold.
        seed: Seed of the set; trajectory i uses scene ``seed * SCENES_PER_SEED + i``.
        jobs: Processes (one trajectory each).
        shape: Shape or mesh file in place of the drawn ones.
        device: ``cpu`` or ``cuda``.
        report: Progress.
        cluster: Where to send the work; processes of this machine by default.
        announce: Called with a line about what is sent there.

    Returns:
        The keys of ``giorom simulate --json``.

    Raises:
        ValueError: If the folder holds another data set or is being written by another process,
            the set would not fit, or no scene can be simulated.
        OSError: If the disk is full; what is finished is kept.
        KeyboardInterrupt: With a line that says what is kept and how to go on.
    """
    start = time.perf_counter()
    _require_frames(experiment)
    if cluster is not None:
        require_cluster(cluster)
    # The first scene is drawn here: what cannot be drawn, run or stored leaves nothing behind.
    scene = draw_scene(experiment.scene, seed=seed * SCENES_PER_SEED, shape=shape)
    radius = _default_radius(experiment, scene.position)
    if not finished_parts(folder):
        require_runnable(scene, experiment.solver)
    _require_room(
        scene, experiment, folder=folder, trajectories=trajectories, jobs=0 if cluster else jobs
    )

    def run(indices: list[int], tick: Tick) -> Iterable[Outcome]:
        todo = jobs_of(indices, seed=seed, shape=shape)
        common = {"folder": folder, "device": device, "tick": tick}
        if cluster is None:
            return run_jobs(todo, experiment, jobs=jobs, **common)
        return run_on_cluster(todo, experiment, cluster=cluster, announce=announce, **common)

    with only_writer(folder), _explained(folder, trajectories):
        open_work_folder(folder, identity=_identity(experiment, seed=seed, shape=shape))
        with _tidied(folder) if cluster is None else nullcontext():
            made = _make_missing(run, experiment, folder, trajectories=trajectories, report=report)
        seconds, ended = time.perf_counter() - start, len(made.parts) + len(made.failures)
        if cluster is not None and not cluster.wait and ended < trajectories:
            return _sent(len(made.parts), seconds=seconds)
        return _assembled(folder, made, radius=radius, seconds=seconds)


@dataclass(frozen=True, kw_only=True)
class _Made:
    """What there is of a data set when all work has ended."""

    parts: list[int]
    """Trajectories, those of earlier calls too."""

    failures: dict[int, str]
    """Reasons of the trajectories that could not be made."""

    work: float
    """Particle-substeps of this call."""


def _assembled(folder: Path, made: _Made, *, radius: float, seconds: float) -> dict[str, Any]:
    """Put the parts together; the result of the call.

    Raises:
        SimulationError: If there is no part.
    """
    failures = made.failures
    if not made.parts:
        raise SimulationError(
            f"no trajectory could be simulated; the first: {failures[min(failures)]}"
        )
    metadata = assemble_dataset(folder, radius=radius, splits=split_parts(made.parts))
    return {
        "trajectories": len(made.parts),
        "points": metadata["num_particles_max"],
        "frames": metadata["sequence_length_train"],
        "frame_dt": metadata["dt"],
        "particle_substeps_per_second": made.work / seconds if made.work else None,
        "seconds": seconds,
        "failed": len(failures),
        "failures": [{"index": i, "reason": failures[i]} for i in sorted(failures)],
        "splits": {name: metadata[f"num_trajs_{name}"] for name in SPLITS},
    }


@contextmanager
def _tidied(folder: Path) -> Iterator[None]:
    """Clear away what workers left that were killed earlier, and at the end those of meanwhile."""
    remove_leftovers(folder)
    yield
    remove_leftovers(folder)


def _require_frames(experiment: Experiment) -> None:
    """Refuse trajectories of which no data set can be made."""
    frames = experiment.solver.frames
    if frames < 3:
        raise ValueError(
            f"a data set needs the accelerations of its trajectories, and so three frames or more "
            f"of each, got SolverConfig.frames = {frames}. Raise it."
        )


def _identity(experiment: Experiment, *, seed: int, shape: str | None) -> dict[str, Any]:
    """What decides which trajectories a set holds."""
    return {
        "system": experiment.system,
        "seed": seed,
        "shape": shape,
        "scene": asdict(experiment.scene),
        "solver": asdict(experiment.solver),
    }


def _require_room(
    scene: Scene, experiment: Experiment, *, folder: Path, trajectories: int, jobs: int
) -> None:
    present = sum(1 for part in finished_parts(folder) if part < trajectories)
    require_room(
        scene,
        experiment.solver,
        folder=folder,
        trajectories=trajectories,
        missing=trajectories - present,
        jobs=jobs,
    )


def _make_missing(
    run: Runner, experiment: Experiment, folder: Path, *, trajectories: int, report: Report
) -> _Made:
    """Make the trajectories that are not there, and say what became of them."""
    frames = experiment.solver.frames
    present = set(finished_parts(folder))
    missing = [index for index in range(trajectories) if index not in present]
    ended, total = trajectories - len(missing), trajectories * frames
    failures: dict[int, str] = {}
    work = 0.0

    def tick(in_work: int) -> None:
        report(min(ended * frames + in_work, total), total)

    keep_failures(folder, failures)
    tick(0)
    for outcome in run(missing, tick):
        ended += 1
        work += outcome.particle_substeps
        append_entry(folder, "simulate", asdict(outcome))
        if outcome.problem is not None:
            failures[outcome.index] = outcome.problem
            keep_failures(folder, failures)
    tick(0)
    parts = [part for part in finished_parts(folder) if part < trajectories]
    return _Made(parts=parts, failures=failures, work=work)


@contextmanager
def _explained(folder: Path, trajectories: int) -> Iterator[None]:
    """Say what is kept, and how to go on, when the work is interrupted or the disk is full."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {_kept(folder, trajectories)}") from None
    except (OSError, RuntimeError) as error:
        if not disk_is_full(error):
            raise
        raise OSError(
            f"no space is left on the disk of {folder}. Free some; {_kept(folder, trajectories)}"
        ) from None


def _kept(folder: Path, trajectories: int) -> str:
    count = sum(1 for part in finished_parts(folder) if part < trajectories)
    return (
        f"{count} of {trajectories} trajectories are kept in {folder}. Run the same command "
        f"again to go on."
    )


def _sent(present: int, *, seconds: float) -> dict[str, Any]:
    """Result of a call that does not wait for what it has sent."""
    unknown = ("points", "frames", "frame_dt", "particle_substeps_per_second", "splits")
    return {
        "trajectories": present,
        **dict.fromkeys(unknown),
        "seconds": seconds,
        "failed": 0,
        "failures": [],
    }


def _default_radius(experiment: Experiment, start: Tensor) -> float:
    """Graph radius for the metadata: what the body ``start`` asks for [m]."""
    if experiment.graph.radius is not None:
        return experiment.graph.radius
    samples = start[sample(start, experiment.sampling)]
    return choose_radius(samples, start, margin=experiment.graph.margin).radius
