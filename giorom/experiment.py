"""A training run from data set to stored simulator: field first, then time-stepper."""

import json
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from giorom.config import Experiment
from giorom.data.atomic import replacing, replacing_folder
from giorom.data.statistics import Statistics
from giorom.data.trajectory_file import iterate_trajectories, read_metadata
from giorom.data.windows import (
    SampledTrajectory,
    Windows,
    concatenate_windows,
    sample_trajectories,
    window_at,
)
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import hold_still
from giorom.graph import RadiusChoice, choose_radius
from giorom.normalization import Normalization
from giorom.pipeline import Connect, Dynamics
from giorom.sampling import sample
from giorom.simulator import Simulator, SimulatorConfig
from giorom.state import SparseState, Trajectory
from giorom.training.checkpoint import CHECKPOINT_PREFIX
from giorom.training.coverage import check_coverage
from giorom.training.field_loop import thin, train_field
from giorom.training.goals import seconds_of_stage, time_to
from giorom.training.loop import (
    Budget,
    StepperTraining,
    append_log,
    train_stepper,
)
from giorom.training.search import StepperSearch, searched_entries
from giorom.training.skip import fit_skip
from giorom.version import __version__

PRELUDE = 0.1
"""Largest share of the budget of minutes that the field, and again the skip, may use."""

FALLING_FRAMES = 4
"""Frames at the start of each trajectory that say what gravity is."""

RADIUS_BODIES = 16
"""Training bodies whose connectivity decides the graph radius."""

Report = Callable[[str, dict[str, Any]], None]
"""Called with a stage and numbers, for a progress bar."""


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """What a run reads of a data set."""

    metadata: dict[str, Any]
    """Metadata of the data set."""

    choice: RadiusChoice
    """Graph radius and its reason."""

    windows: Windows
    """Training windows."""

    thinned: list[Trajectory]
    """Training trajectories for the field."""

    validation: list[SampledTrajectory]
    """Held-out trajectories, sampled as in use."""

    latent_bounds: list[list[float]]
    """Padded bounds of the training positions [m]."""


def load_training_data(experiment: Experiment, folder: Path) -> TrainingData:
    """Read, sample and thin a data set.

    Raises:
        ValueError: If the data set is unfinished, damaged, of another dimension or frame time.
    """
    metadata = read_metadata(folder)
    _check_match(experiment, metadata, folder)
    training = experiment.training
    full = list(iterate_trajectories(folder, "train"))
    choice = choose_common_radius(full, experiment)
    reference = choice.radius if experiment.graph.configuration == "reference" else None
    past = experiment.features.velocities if training.straight_past else 0
    sampled = sample_trajectories(
        full,
        experiment.sampling,
        subsets=training.subsets,
        reference_radius=reference,
        kind=experiment.graph.kind,
        past=past,
    )
    validation = sample_trajectories(
        iterate_trajectories(folder, "valid"),
        experiment.sampling,
        subsets=1,
        reference_radius=reference,
        kind=experiment.graph.kind,
        past=past,
    )
    return TrainingData(
        metadata=metadata,
        choice=choice,
        windows=Windows(
            sampled,
            history=experiment.features.history,
            future=training.longest_unroll,
            starts=training.objective == "motion",
        ),
        thinned=[thin(t, experiment.field_training, seed=i) for i, t in enumerate(full)],
        validation=validation[: training.validation_trajectories],
        latent_bounds=padded_bounds(full, turned=training.turn),
    )


def choose_common_radius(trajectories: list[Trajectory], experiment: Experiment) -> RadiusChoice:
    """The largest of the radii that some training bodies ask for, or the configured one."""
    config = experiment.graph
    choices = []
    for trajectory in trajectories[:RADIUS_BODIES]:
        start = trajectory.position[0]
        samples = start[sample(start, experiment.sampling)]
        choices.append(choose_radius(samples, start, margin=config.margin))
    largest = max(choices, key=lambda choice: choice.radius)
    if config.radius is None:
        return largest
    margin = config.radius / max(largest.smallest, largest.full_radius)
    return replace(largest, radius=config.radius, margin=margin, mean_degree=math.nan)


def padded_bounds(trajectories: list[Trajectory], *, turned: bool) -> list[list[float]]:
    """Bounds of all training positions, a tenth of their extent wider on every side.

    Args:
        trajectories: Training trajectories.
        turned: Whether training turns them about the vertical axis.
    """
    low = torch.stack([t.position.amin(dim=(0, 1)) for t in trajectories]).amin(dim=0)
    high = torch.stack([t.position.amax(dim=(0, 1)) for t in trajectories]).amax(dim=0)
    if turned:
        center = trajectories[0].bounds.mean(dim=1)
        level = [axis for axis in range(len(center)) if axis != 1]
        distances = [(t.position - center)[..., level].norm(dim=2).max() for t in trajectories]
        reach = torch.stack(distances).max()
        low[level], high[level] = center[level] - reach, center[level] + reach
    pad = 0.1 * (high - low)
    return torch.stack([low - pad, high + pad], dim=1).tolist()


def fit_normalization(experiment: Experiment, metadata: dict[str, Any]) -> Normalization:
    """Scales of the training split and the training noise, in SI units."""
    frame_dt = float(metadata["dt"])
    statistics = Statistics.from_metadata(metadata).in_si(frame_dt=frame_dt)
    dimension = len(statistics.velocity_mean)
    gravity = tuple(-experiment.scene.gravity * (axis == 1) for axis in range(dimension))
    return Normalization.fit(
        velocity_mean=tuple(statistics.velocity_mean.tolist()),
        velocity_std=tuple(statistics.velocity_std.tolist()),
        acceleration_mean=tuple(statistics.acceleration_mean.tolist()),
        acceleration_std=tuple(statistics.acceleration_std.tolist()),
        noise_std=experiment.training.noise_std,
        frame_dt=frame_dt,
        isotropic=experiment.training.isotropic,
        gravity=gravity if experiment.training.explicit_gravity else None,
    )


def build_simulator(experiment: Experiment, data: TrainingData) -> Simulator:
    """An untrained simulator for a data set."""
    dimension = int(data.metadata["dim"])
    network = None
    if experiment.uses_network:
        network = experiment.time_stepper.build(
            dimension=dimension,
            features=experiment.features,
            latent_bounds=data.latent_bounds,
        )
    simulator = Simulator(
        SimulatorConfig(
            system=experiment.system,
            dimension=dimension,
            frame_dt=float(data.metadata["dt"]),
            bounds=[list(map(float, pair)) for pair in data.metadata["bounds"]],
            sampling=experiment.sampling,
            graph=replace(experiment.graph, radius=data.choice.radius),
            features=experiment.features,
            normalization=fit_normalization(experiment, data.metadata),
            time_stepper=network,
            grid_stepper=experiment.grid_stepper,
            body_stepper=experiment.body_stepper,
            field=experiment.field,
            scene=experiment.scene,
            solver=experiment.solver,
        )
    )
    if network is None and not _all_held(data.windows.trajectories):
        simulator.dynamics.gravity.copy_(first_acceleration(data.windows.trajectories))
    return simulator


def _all_held(trajectories: list[SampledTrajectory]) -> bool:
    """Whether every body is held, so that its first acceleration says nothing about gravity."""
    return all(t.body is not None and bool(t.body.kinematic.any()) for t in trajectories)


def first_acceleration(trajectories: list[SampledTrajectory]) -> Tensor:
    """Mean acceleration of the first frames, before anything touches anything: gravity [m/s^2]."""
    found = [
        t.motion.position[: FALLING_FRAMES + 2].double().diff(n=2, dim=0).mean(dim=(0, 1))
        / t.motion.frame_dt**2
        for t in trajectories
    ]
    return torch.stack(found).median(dim=0).values.float()


def train(
    experiment: Experiment,
    *,
    data_folder: Path,
    out: Path,
    budget: Budget,
    seed: int,
    resume: bool,
    device: str,
    report: Report,
) -> dict[str, Any]:
    """Train field and time-stepper and store the best simulator in ``out/simulator``.

    Args:
        experiment: What to train.
        data_folder: A finished data set.
        out: Directory of the run.
        budget: When to stop.
        seed: Seed of weights, batches and noise.
        resume: Continue the run found in ``out``.
        device: ``cpu`` or ``cuda``.
        report: Progress.

    Returns:
        The keys of ``giorom train --json``.
    """
    start = time.perf_counter()
    torch.manual_seed(seed)
    data = load_training_data(experiment, data_folder)
    report("note", {"text": str(data.choice)})
    simulator = build_simulator(experiment, data)
    searches = experiment.training.optimizer == "cma"
    if searches:
        searched_entries(simulator.dynamics, data.windows)
    coverage = None
    if isinstance(simulator.dynamics, Dynamics):
        network = simulator.dynamics.time_stepper
        coverage = check_coverage(network, data.windows, experiment.training)
        text = f"the latent grid reaches {100.0 * coverage:.1f} % of the samples"
        report("note", {"text": text})
    validate = _validation(experiment, data, connect=simulator.connect, device=device)
    _prepare_folder(out, _identity(experiment, simulator.config, seed=seed), resume=resume)
    if not resume and coverage is not None:
        append_log(out / "log.jsonl", {"stage": "coverage", "share": coverage})
    _train_field(simulator, experiment, data, out=out, budget=budget, seed=seed, report=report)
    interrupted = resume and any((out / "checkpoints").glob(f"{CHECKPOINT_PREFIX}*"))
    if _has_skip(simulator) and not interrupted:
        _fit_skip(simulator, experiment, data, out=out, budget=budget, seed=seed, report=report)
    simulator.to(device)
    training = (StepperSearch if searches else StepperTraining)(
        simulator.dynamics,
        experiment.training,
        windows=data.windows,
        connect=simulator.connect,
        seed=seed,
        folder=out,
    )
    if interrupted:
        training.resume()
    preludes = 1 + simulator.field.learns
    minutes = None if budget.minutes is None else (1.0 - preludes * PRELUDE) * budget.minutes
    run = train_stepper(
        training,
        replace(budget, minutes=minutes),
        validate=validate,
        keep=lambda best: _keep(simulator, best, out),
        report=lambda numbers: report("time_stepper", numbers),
    )
    if not math.isfinite(run.best):
        raise FloatingPointError(
            f"every validation rollout diverged, so {out} holds no simulator. Continue it with "
            f"--resume and a larger budget, or lower TrainingConfig.learning_rate."
        )
    return {
        "steps": run.step,
        "seconds": time.perf_counter() - start,
        "steps_per_second": run.step / max(run.seconds, 1e-9),
        "best_rollout_mse": run.best,
        "time_to": time_to(
            run.history or [],
            experiment.training.goals,
            unit=experiment.training.goal_unit,
            earlier=seconds_of_stage(out / "log.jsonl", "skip"),
        ),
        "latent_coverage": coverage,
        "parameters": sum(p.numel() for p in simulator.dynamics.parameters()),
        "field_parameters": sum(p.numel() for p in simulator.field.parameters()),
        "radius": data.choice.radius,
        "seed": seed,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "giorom": __version__,
        "history": run.history,
    }


def _has_skip(simulator: Simulator) -> bool:
    """Whether the network has a part that is fitted before it is trained."""
    network = simulator.config.time_stepper
    return network is not None and network.input_skip != "none"


def _fit_skip(
    simulator: Simulator,
    experiment: Experiment,
    data: TrainingData,
    *,
    out: Path,
    budget: Budget,
    seed: int,
    report: Report,
) -> None:
    """Fit the pointwise skip and log how long it took."""
    begin = time.perf_counter()
    explained = fit_skip(
        simulator.dynamics,
        data.windows,
        experiment.training,
        seed=seed,
        minutes=math.inf if budget.minutes is None else PRELUDE * budget.minutes,
        report=lambda numbers: report("skip", numbers),
    )
    entry = {"seconds": time.perf_counter() - begin, "explained": explained}
    append_log(out / "log.jsonl", {"stage": "skip", **entry})


def _train_field(
    simulator: Simulator,
    experiment: Experiment,
    data: TrainingData,
    *,
    out: Path,
    budget: Budget,
    seed: int,
    report: Report,
) -> None:
    """Train the field if it learns, or load the one the run has already finished."""
    from safetensors.torch import load_file, save_file

    if not simulator.field.state_dict():
        return
    done = out / "field.safetensors"
    if done.is_file():
        simulator.field.load_state_dict(load_file(done))
        return
    config = experiment.field_training
    minutes = config.minutes
    if budget.minutes is not None:
        minutes = min(minutes, PRELUDE * budget.minutes)
    result = train_field(
        simulator.field,
        data.thinned,
        config,
        seed=seed,
        minutes=minutes,
        turn=experiment.training.turn,
        report=lambda numbers: report("field", numbers),
    )
    with replacing(done) as temporary:
        save_file(simulator.field.state_dict(), temporary)
    append_log(out / "log.jsonl", {"stage": "field", **result})


def _validation(
    experiment: Experiment, data: TrainingData, *, connect: Connect, device: str
) -> Callable[[nn.Module], dict[str, float]]:
    """A function that rolls the held-out trajectories out and scores them."""
    history = experiment.features.history
    if not data.validation:
        raise ValueError(
            "the data set has no validation trajectory; make at least three trajectories so that "
            "one can be held out."
        )
    shortest = min(sampled.motion.frame_count for sampled in data.validation)
    frames = min(experiment.training.validation_frames, shortest - history)
    if frames < 1:
        raise ValueError(
            f"a validation rollout needs {history} given frames and one more, but the shortest "
            f"validation trajectory has {frames + history}. Simulate more frames."
        )
    batch = concatenate_windows(
        [window_at(sampled, 0, history=history, future=frames) for sampled in data.validation]
    )
    state: SparseState = batch.state.to(device)
    truth: Tensor = batch.target.transpose(0, 1)
    known = truth.to(device)

    def validate(model: nn.Module) -> dict[str, float]:
        result = roll_out(state, frames, connect=connect, step=model.step, prescribed=known)
        error = squared_error_per_frame(result.position.cpu(), truth)
        still = squared_error_per_frame(hold_still(state, frames, prescribed=known).cpu(), truth)
        mse = float(error.mean()) if result.diverged_at is None else float("inf")
        return {"rollout_mse": mse, "static_mse": float(still.mean())}

    return validate


def _keep(simulator: Simulator, best: nn.Module, out: Path) -> None:
    """Store the simulator with the weights of ``best``."""
    current = {k: v.clone() for k, v in simulator.dynamics.state_dict().items()}
    simulator.dynamics.load_state_dict(best.state_dict())
    with replacing_folder(out / "simulator") as directory:
        simulator.save_pretrained(directory)
    simulator.dynamics.load_state_dict(current)


def _prepare_folder(out: Path, identity: dict[str, Any], *, resume: bool) -> None:
    """Begin a run in an empty folder, or continue the same run in its own."""
    record = json.dumps(identity, sort_keys=True)
    known = out / "run.json"
    if known.is_file():
        if not resume:
            raise ValueError(
                f"{out} already holds a training run. Continue it with --resume, or choose another "
                f"--out."
            )
        if known.read_text() != record:
            raise ValueError(
                f"{out} holds a run of another configuration or data set; --resume continues only "
                f"the same one. Choose another --out."
            )
        return
    if resume:
        raise ValueError(f"{out} holds no training run to resume. Train without --resume.")
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(out / "checkpoints", ignore_errors=True)
    with replacing(known) as temporary:
        temporary.write_text(record)


def _identity(experiment: Experiment, config: SimulatorConfig, *, seed: int) -> dict[str, Any]:
    """What has to stay the same when a run is resumed."""
    return {
        "simulator": asdict(config),
        "training": asdict(experiment.training),
        "field_training": asdict(experiment.field_training),
        "seed": seed,
    }


def _check_match(experiment: Experiment, metadata: dict[str, Any], folder: Path) -> None:
    """Reject data that the experiment was not made for."""
    found, wanted = int(metadata["dim"]), experiment.scene.dimension
    if found != wanted:
        raise ValueError(
            f"{folder} has dim={found}, the experiment {experiment.system} expects {wanted}. Use "
            f"the preset the data were made with; for imported data, one of {found} dimensions, or "
            f"change it with --scene.dimension {found}."
        )
    frame_dt, expected = float(metadata["dt"]), experiment.solver.frame_dt
    if abs(frame_dt - expected) > 1e-6 * expected:
        raise ValueError(
            f"{folder} has dt={frame_dt:g}, the experiment {experiment.system} expects "
            f"{expected:g}. Use the preset the data were made with; for imported data, change it "
            f"with --solver.frame_dt {frame_dt!r}."
        )
