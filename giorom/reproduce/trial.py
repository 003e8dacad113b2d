"""One training of the comparison and its score: what is asked for, and the work itself."""

import math
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from giorom.config import Experiment
from giorom.data.atomic import write_json
from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.evaluate import evaluate_trajectory, summarize
from giorom.evaluation.machine import describe_machine
from giorom.experiment import train
from giorom.pipeline import start_from_trajectory
from giorom.simulator import Simulator
from giorom.state import Trajectory
from giorom.training.checkpoint import CheckpointError
from giorom.training.training_config import Budget
from giorom.version import __version__


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A training that is asked for."""

    system: str
    """Physical system."""

    method: str
    """Name in ``METHODS``."""

    seed: int = 0
    """Seed of weights, batches and noise."""

    changes: dict[str, Any] = field(default_factory=dict)
    """Values of the experiment that differ from those of system and method."""

    budget: Budget | None = None
    """When to stop; none: as the scale says."""


def train_trial(
    experiment: Experiment, *, data: Path, folder: Path, budget: Budget, seed: int, device: str
) -> dict[str, Any]:
    """Train, or go on where an earlier process was stopped.

    Args:
        experiment: What to train.
        data: The data set.
        folder: Where the run and its record go.
        budget: When to stop.
        seed: Seed of the training.
        device: ``cpu`` or ``cuda``.

    Returns:
        What is kept of it in ``trained.json``; ``problem`` says why there is no model, if so.
    """
    run = folder / "run"
    options = {"data_folder": data, "out": run, "budget": budget, "seed": seed, "device": device}
    options["report"] = _silent
    try:
        try:
            result = train(experiment, resume=(run / "run.json").is_file(), **options)
        except CheckpointError:  # damaged, by a disk that was full: nothing of it is worth keeping
            shutil.rmtree(run)
            result = train(experiment, resume=False, **options)
        problem = None
    except FloatingPointError as error:
        result, problem = {}, str(error)
    kept = ("steps", "seconds", "parameters", "best_rollout_mse", "radius", "latent_coverage")
    record = {name: result.get(name) for name in kept} | {"problem": problem}
    record |= {"giorom": __version__, "machine": describe_machine(), "device": device}
    write_json(folder / "trained.json", record)
    shutil.rmtree(run / "checkpoints", ignore_errors=True)
    return record


def score_run(
    run: Path,
    data: Path,
    *,
    where: str,
    frames: int | None,
    sparse_points: int | None,
    full: bool,
    device: str,
) -> dict[str, Any]:
    """Scores of a trained model on one split of a data set, as JSON values.

    Args:
        run: Folder of the training run.
        data: The data set.
        where: Its split.
        frames: Frames to predict; none: all there are.
        sparse_points: Number of samples; none: as trained.
        full: Whether all particles are recovered and scored too.
        device: ``cpu`` or ``cuda``.
    """
    simulator = Simulator.from_pretrained(run).to(device)
    results, edges, samples = [], [], []
    for trajectory in iterate_trajectories(data, where):
        moved = trajectory.to(device)
        results.append(
            evaluate_trajectory(
                simulator, moved, frames=frames, sparse_points=sparse_points, full=full
            )
        )
        edges.append(edge_count(simulator, moved, sparse_points=sparse_points))
        samples.append(results[-1]["sparse_points"])
    summary = summarize(results, system=simulator.config.system)
    summary["edges"] = round(sum(edges) / len(edges))
    summary["edges_per_sample"] = sum(edges) / sum(samples)
    return finite(summary)


def edge_count(
    simulator: Simulator, trajectory: Trajectory, *, sparse_points: int | None = None
) -> int:
    """Edges of the graph a rollout starts with."""
    samples = simulator.sample(trajectory.position[0], count=sparse_points)
    history = simulator.config.features.history
    return len(
        simulator.connect(start_from_trajectory(trajectory, samples, history=history)).sender
    )


def unscored(record: dict[str, Any], trajectories: int) -> dict[str, Any]:
    """The scores of a training without a model: every rollout counts as diverged."""
    return {
        "trajectories": trajectories,
        "diverged": trajectories,
        "sparse": None,
        "full": None,
        "per_trajectory": [],
        "edges": None,
        "edges_per_sample": None,
        "problem": record["problem"],
    }


def finite(value: Any) -> Any:
    """JSON values with none in place of every number that is not finite."""
    if isinstance(value, dict):
        return {name: finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def identity_of(
    experiment: Experiment, *, data_key: str, budget: Budget, seed: int, device: str
) -> dict[str, Any]:
    """Everything a trained model depends on."""
    return {
        "experiment": asdict(experiment),
        "data": data_key,
        "budget": asdict(budget),
        "seed": seed,
        "device": device,
        "giorom": __version__,
    }


def _silent(stage: str, numbers: dict[str, Any]) -> None:
    """No progress: the study counts trainings."""
    del stage, numbers
