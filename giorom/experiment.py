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
from giorom.data.windows import concatenate_windows, window_at
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import hold_still
from giorom.pipeline import Connect, Dynamics
from giorom.simulator import Simulator, SimulatorConfig
from giorom.state import SparseState
from giorom.training.checkpoint import CHECKPOINT_PREFIX
from giorom.training.coverage import check_coverage
from giorom.training.field_loop import train_field
from giorom.training.goals import seconds_of_stage, time_to
from giorom.training.loop import RunState, StepperTraining, append_log, train_stepper
from giorom.training.search import StepperSearch, searched_entries
from giorom.training.skip import fit_skip
from giorom.training.training_config import Budget
from giorom.training_data import (
    TrainingData,
    all_held,
    first_acceleration,
    fit_normalization,
    load_training_data,
)
from giorom.version import __version__

PRELUDE = 0.1
"""Largest share of the budget of minutes that the field, and again the skip, may use."""

Report = Callable[[str, dict[str, Any]], None]
"""Called with a stage and numbers, for a progress bar."""

Validate = Callable[[nn.Module], dict[str, float]]
"""Scores of a model on the held-out trajectories."""


@dataclass(frozen=True, kw_only=True)
class _Run:
    """What every stage of a training run works with."""

    experiment: Experiment
    data: TrainingData
    simulator: Simulator
    out: Path
    budget: Budget
    seed: int
    report: Report


def build_simulator(experiment: Experiment, data: TrainingData) -> Simulator:
    """An untrained simulator for a data set."""
    dimension = int(data.metadata["dim"])
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
            grid_stepper=experiment.grid_stepper,
            body_stepper=experiment.body_stepper,
            **experiment.network(data.latent_bounds),
            field=experiment.field,
            scene=experiment.scene,
            solver=experiment.solver,
        )
    )
    if not experiment.uses_network and not all_held(data.windows.trajectories):
        simulator.dynamics.gravity.copy_(first_acceleration(data.windows.trajectories))
    return simulator


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
    run = _Run(
        experiment=experiment,
        data=data,
        simulator=build_simulator(experiment, data),
        out=out,
        budget=budget,
        seed=seed,
        report=report,
    )
    simulator = run.simulator
    if experiment.training.optimizer == "cma":
        searched_entries(simulator.dynamics, data.windows)  # refuses too many before any work
    coverage = _coverage(run)
    validate = _validation(experiment, data, connect=simulator.connect, device=device)
    if not experiment.uses_network:
        _try_step(simulator, data)
    _prepare_folder(out, _identity(experiment, simulator.config, seed=seed), resume=resume)
    if not resume and coverage is not None:
        append_log(out / "log.jsonl", {"stage": "coverage", "share": coverage})
    _train_field(run)
    interrupted = resume and any((out / "checkpoints").glob(f"{CHECKPOINT_PREFIX}*"))
    if _has_skip(simulator) and not interrupted:
        _fit_skip(run)
    simulator.to(device)
    counters = _train_stepper(run, validate, interrupted=interrupted)
    return _summary(run, counters, coverage=coverage, seconds=time.perf_counter() - start)


def _coverage(run: _Run) -> float | None:
    """Share of the samples that the latent grid reaches; none where no network is trained."""
    dynamics = run.simulator.dynamics
    if not isinstance(dynamics, Dynamics):
        return None
    share = check_coverage(dynamics.time_stepper, run.data.windows, run.experiment.training)
    run.report("note", {"text": f"the latent grid reaches {100.0 * share:.1f} % of the samples"})
    return share


def _train_stepper(run: _Run, validate: Validate, *, interrupted: bool) -> RunState:
    """Train what moves the samples and keep the best simulator.

    Raises:
        FloatingPointError: If every validation rollout diverged.
    """
    simulator, config, budget = run.simulator, run.experiment.training, run.budget
    training = (StepperSearch if config.optimizer == "cma" else StepperTraining)(
        simulator.dynamics,
        config,
        windows=run.data.windows,
        connect=simulator.connect,
        seed=run.seed,
        folder=run.out,
    )
    if interrupted:
        training.resume()
    preludes = 1 + simulator.field.learns
    minutes = None if budget.minutes is None else (1.0 - preludes * PRELUDE) * budget.minutes
    counters = train_stepper(
        training,
        replace(budget, minutes=minutes),
        validate=validate,
        keep=lambda best: _keep(simulator, best, run.out),
        report=lambda numbers: run.report("time_stepper", numbers),
    )
    if not math.isfinite(counters.best):
        raise FloatingPointError(
            f"every validation rollout diverged, so {run.out} holds no simulator. Continue it with "
            f"--resume and a larger budget, or lower TrainingConfig.learning_rate."
        )
    return counters


def _summary(
    run: _Run, counters: RunState, *, coverage: float | None, seconds: float
) -> dict[str, Any]:
    """The keys of ``giorom train --json``."""
    config = run.experiment.training
    return {
        "steps": counters.step,
        "seconds": seconds,
        "steps_per_second": counters.step / max(counters.seconds, 1e-9),
        "best_rollout_mse": counters.best,
        "time_to": time_to(
            counters.history or [],
            config.goals,
            unit=config.goal_unit,
            earlier=seconds_of_stage(run.out / "log.jsonl", "skip"),
        ),
        "latent_coverage": coverage,
        "parameters": sum(p.numel() for p in run.simulator.dynamics.parameters()),
        "field_parameters": sum(p.numel() for p in run.simulator.field.parameters()),
        "radius": run.data.choice.radius,
        "seed": run.seed,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "giorom": __version__,
        "history": counters.history,
    }


@torch.no_grad()
def _try_step(simulator: Simulator, data: TrainingData) -> None:
    """One step of the first scene: a grid that cannot be laid is refused before a folder is."""
    history = simulator.config.features.history
    state = window_at(data.validation[0], 0, history=history, future=1).state
    simulator.dynamics.step(state, simulator.connect(state))


def _has_skip(simulator: Simulator) -> bool:
    """Whether the network has a part that is fitted before it is trained."""
    network = simulator.config.time_stepper
    return network is not None and network.input_skip != "none"


def _fit_skip(run: _Run) -> None:
    """Fit the pointwise skip and log how long it took."""
    begin, minutes = time.perf_counter(), run.budget.minutes
    explained = fit_skip(
        run.simulator.dynamics,
        run.data.windows,
        run.experiment.training,
        seed=run.seed,
        minutes=math.inf if minutes is None else PRELUDE * minutes,
        report=lambda numbers: run.report("skip", numbers),
    )
    entry = {"seconds": time.perf_counter() - begin, "explained": explained}
    append_log(run.out / "log.jsonl", {"stage": "skip", **entry})


def _train_field(run: _Run) -> None:
    """Train the field if it learns, or load the one the run has already finished."""
    from safetensors.torch import load_file, save_file

    field, config = run.simulator.field, run.experiment.field_training
    if not field.state_dict():
        return
    done = run.out / "field.safetensors"
    if done.is_file():
        field.load_state_dict(load_file(done))
        return
    minutes = config.minutes
    if run.budget.minutes is not None:
        minutes = min(minutes, PRELUDE * run.budget.minutes)
    result = train_field(
        field,
        run.data.thinned,
        config,
        seed=run.seed,
        minutes=minutes,
        turn=run.experiment.training.turn,
        report=lambda numbers: run.report("field", numbers),
    )
    with replacing(done) as temporary:
        save_file(field.state_dict(), temporary)
    append_log(run.out / "log.jsonl", {"stage": "field", **result})


def _validation(
    experiment: Experiment, data: TrainingData, *, connect: Connect, device: str
) -> Validate:
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
