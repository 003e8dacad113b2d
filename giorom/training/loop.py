"""The plain loop that trains the time-stepper; ``field_loop.py`` trains the neural field.

What makes a run reproducible is kept in one place: every random number of a step comes from the
seed and the number of the step, so that a resumed run draws what an uninterrupted one would.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from giorom.data.windows import (
    StepSampler,
    WindowBatch,
    Windows,
    concatenate_windows,
    step_generator,
    turn,
)
from giorom.pipeline import Connect, Dynamics
from giorom.records import one_line
from giorom.training.checkpoint import (
    CheckpointError,
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
    save_checkpoint,
)
from giorom.training.loss import WeakFormConfig, unrolled_loss, weak_loss
from giorom.training.noise import add_random_walk


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How the time-stepper is trained."""

    batch_size: int = 4
    """Windows per optimiser step."""

    optimizer: Literal["adamax", "adamw"] = "adamax"
    """Optimiser (Adamax in the paper)."""

    learning_rate: float = 1e-4
    """Learning rate at the start."""

    final_learning_rate: float = 1e-6
    """Learning rate that the decay approaches."""

    decades: float = 2.0
    """Powers of ten by which the learning rate above the final one decays over the budget; the
    paper's 5e6 steps make one."""

    warmup: int = 100
    """Steps over which the learning rate rises from zero."""

    weight_decay: float = 1e-6
    """Weight decay."""

    gradient_clip: float = 1.0
    """Largest norm of the gradient."""

    noise_std: float = 0.0
    """Spread of the training noise on the newest velocity, as displacement per frame [m]."""

    position_weight: float = 1e5
    """Weight beta of the position error in equation 10 [1/m^2]."""

    unroll: list[list[float]] | None = None
    """Stages [share of the budget at which it begins, frames per window]; null: one frame (the
    paper)."""

    weak: WeakFormConfig | None = None
    """Train on the equation of motion averaged in time at first; null: never."""

    gate_steps: int = 4000
    """Steps that fit the gate of a gated skip before the whole network is trained."""

    subsets: int = 8
    """Different samples of each trajectory."""

    turn: bool = False
    """Turn and mirror scenes at random; sound where the side walls are out of reach."""

    straight_past: bool = False
    """Let windows begin at the first frame, their past extrapolated straight; a model that is
    started from a shape and a velocity has to know such beginnings."""

    isotropic: bool = False
    """One velocity and one acceleration scale for all axes, no offset."""

    average_decay: float = 0.998
    """Decay of the running average of the weights that is validated and kept."""

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    """Precision of the matrix products; ``auto`` takes bfloat16 where the machine computes it."""

    validations: int = 12
    """Validation rollouts over the budget, evenly spaced."""

    validation_frames: int = 100
    """Frames of a validation rollout, as far as the trajectories reach."""

    validation_trajectories: int = 8
    """Held-out trajectories rolled out, at most."""

    def __post_init__(self) -> None:
        """Reject values no training can use."""
        positive = "batch_size learning_rate decades gradient_clip subsets validations".split()
        natural = "final_learning_rate warmup weight_decay noise_std position_weight".split()
        for name in [*positive, "validation_frames", "validation_trajectories"]:
            if not getattr(self, name) > 0:
                raise ValueError(f"TrainingConfig.{name} must be > 0, got {getattr(self, name)!r}.")
        for name in natural:
            if not getattr(self, name) >= 0:
                raise ValueError(
                    f"TrainingConfig.{name} must be >= 0, got {getattr(self, name)!r}."
                )
        if not 0.0 <= self.average_decay < 1.0:
            raise ValueError(
                f"TrainingConfig.average_decay must lie in [0, 1), got {self.average_decay!r}."
            )
        for stage in self.unroll or []:
            if len(stage) != 2 or not 0.0 <= stage[0] < 1.0 or not stage[1] >= 1:
                raise ValueError(
                    f"TrainingConfig.unroll must be pairs [share in [0, 1), frames >= 1], got "
                    f"{stage!r}."
                )

    def unrolled_frames(self, progress: float) -> int:
        """Frames per window after the share ``progress`` of the budget."""
        begun = [frames for share, frames in self.unroll or [] if share <= progress]
        return int(begun[-1]) if begun else 1

    @property
    def longest_unroll(self) -> int:
        """Frames after the current one that a window must hold."""
        weak = 0 if self.weak is None else 2 * self.weak.half_width
        return max([1, weak, *(int(frames) for _, frames in self.unroll or [])])


@dataclass(frozen=True, kw_only=True)
class Budget:
    """When to stop: after some steps or some minutes, whichever comes first."""

    steps: int | None = None
    """Optimiser steps."""

    minutes: float | None = None
    """Minutes, those before an interruption included."""

    def __post_init__(self) -> None:
        """Reject an endless training."""
        if self.steps is None and self.minutes is None:
            raise ValueError("give a budget: --max-steps, --max-minutes, or both.")
        for name in ("steps", "minutes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"the budget of {name} must be > 0, got {value!r}.")

    def progress(self, step: int, seconds: float) -> float:
        """Share of the budget that is used, 1 at the end."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(step / self.steps)
        if self.minutes is not None:
            shares.append(seconds / (60.0 * self.minutes))
        return min(1.0, max(shares))


def learning_rate(config: TrainingConfig, *, step: int, progress: float) -> float:
    """The GNS rule with a horizon that fits the budget.

    Source:
        arXiv:2002.09405: lr = lr_end + (lr_start - lr_end) 0.1^(t / 5e6).
    """
    span = config.learning_rate - config.final_learning_rate
    rate = config.final_learning_rate + span * 0.1 ** (config.decades * progress)
    return rate * min(1.0, (step + 1) / max(1, config.warmup))


@dataclass
class RunState:
    """Counters of a run that a checkpoint keeps."""

    step: int = 0
    seconds: float = 0.0
    next_validation: float = 0.0
    best: float = math.inf
    loss: float = math.nan
    history: list[dict[str, Any]] | None = None


class StepperTraining:
    """Training of a time-stepper: model, average, optimiser, counters.

    Args:
        dynamics: Model to train.
        config: How.
        windows: Training windows.
        connect: Graph of a state, where windows bring none.
        seed: Seed of batches, noise and turns.
        folder: Directory of the run.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        config: TrainingConfig,
        *,
        windows: Windows,
        connect: Connect,
        seed: int,
        folder: Path,
    ) -> None:
        from accelerate import Accelerator

        self.config, self.windows, self.connect = config, windows, connect
        self.seed, self.folder = seed, folder
        on_cpu = next(dynamics.parameters()).device.type == "cpu"
        wanted = config.precision
        half = has_bfloat16(on_cpu=on_cpu) if wanted == "auto" else wanted == "bfloat16"
        self.accelerator = Accelerator(mixed_precision="bf16" if half else "no", cpu=on_cpu)
        self.names = [name for name, _ in dynamics.named_parameters()]
        optimizer = {"adamax": torch.optim.Adamax, "adamw": torch.optim.AdamW}[config.optimizer]
        self.model, self.optimizer = self.accelerator.prepare(
            dynamics, optimizer(dynamics.parameters(), weight_decay=config.weight_decay)
        )
        self.average = AveragedModel(
            dynamics, multi_avg_fn=get_ema_multi_avg_fn(config.average_decay)
        )
        self.run = RunState(history=[])

    def resume(self) -> None:
        """Continue from the newest checkpoint of the run.

        Raises:
            CheckpointError: If there is none, or it is damaged or of another model.
        """
        tensors, record = load_checkpoint(self.folder / "checkpoints")
        plain = self.accelerator.unwrap_model(self.model)
        try:
            plain.load_state_dict(_below("model.", tensors))
            self.average.load_state_dict(_below("average.", tensors))
            load_optimizer_tensors(self.optimizer.optimizer, self.names, tensors)
            torch.set_rng_state(tensors["random"])
            self.run = RunState(**record["run"])
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"the checkpoint in {self.folder} does not fit this training "
                f"({one_line(error)[:200]}). Train into another folder."
            ) from None

    def save(self) -> None:
        """Write a checkpoint."""
        plain = self.accelerator.unwrap_model(self.model)
        tensors = {f"model.{k}": v for k, v in plain.state_dict().items()}
        tensors |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        tensors |= optimizer_tensors(self.optimizer.optimizer, self.names)
        tensors["random"] = torch.get_rng_state()
        save_checkpoint(
            self.folder / "checkpoints",
            step=self.run.step,
            tensors=tensors,
            record={"run": asdict(self.run)},
        )

    def train_step(self, numbers: list[int], *, progress: float) -> float:
        """One optimiser step on the windows ``numbers``; returns the loss."""
        config = self.config
        generator = step_generator(self.seed + 1, self.run.step)
        batch = concatenate_windows([self.windows[number] for number in numbers])
        if config.turn:
            batch = turn(batch, generator=generator)
        with self.accelerator.autocast():
            loss = self._loss(batch, generator, progress=progress)
        rate = learning_rate(config, step=self.run.step, progress=progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        self.accelerator.backward(loss)
        self.accelerator.clip_grad_norm_(self.model.parameters(), config.gradient_clip)
        self.optimizer.step()
        self.average.update_parameters(self.accelerator.unwrap_model(self.model))
        return float(loss.detach())

    def _loss(self, batch: WindowBatch, generator: torch.Generator, *, progress: float) -> Tensor:
        """The loss of the stage of training that ``progress`` falls into."""
        config, device = self.config, self.accelerator.device
        model = self.accelerator.unwrap_model(self.model)
        weak = config.weak
        if weak is not None and progress < weak.until:
            batch = replace(batch, target=batch.target[:, : 2 * weak.half_width])
            return weak_loss(
                model,
                batch.to(device),
                connect=self.connect,
                stride=weak.stride,
                weight=weak.weight,
            )
        batch = replace(batch, target=batch.target[:, : config.unrolled_frames(progress)])
        noisy = add_random_walk(batch.state, config.noise_std, generator=generator)
        return unrolled_loss(
            model,
            noisy.to(device),
            batch.to(device),
            connect=self.connect,
            position_weight=config.position_weight,
        )


def train_stepper(
    training: StepperTraining,
    budget: Budget,
    *,
    validate: Callable[[nn.Module], dict[str, float]],
    keep: Callable[[nn.Module], None],
    report: Callable[[dict[str, Any]], None],
) -> RunState:
    """Train until the budget is used.

    Args:
        training: What is trained.
        budget: When to stop.
        validate: Scores of the averaged model; ``rollout_mse`` decides which is best.
        keep: Called with the averaged model whenever it is the best so far.
        report: Called after every step with numbers for a progress bar.

    Returns:
        The counters at the end.
    """
    config, run = training.config, training.run
    sampler = StepSampler(
        len(training.windows),
        batch_size=config.batch_size,
        seed=training.seed,
        first_step=run.step,
    )
    clock = time.perf_counter() - run.seconds
    validated = run.step
    for numbers in sampler:
        run.seconds = time.perf_counter() - clock
        progress = budget.progress(run.step, run.seconds)
        if run.step > validated and progress >= min(1.0, run.next_validation):
            run.next_validation = (
                math.floor(progress * config.validations) + 1
            ) / config.validations
            _validate(training, validate=validate, keep=keep)
            training.save()
            validated = run.step
        if progress >= 1.0:
            break
        loss = training.train_step(numbers, progress=progress)
        if not math.isfinite(loss):
            raise FloatingPointError(
                f"the training loss is {loss} at step {run.step}. Lower "
                f"TrainingConfig.learning_rate ({config.learning_rate:g}) and train again."
            )
        run.loss = loss if math.isnan(run.loss) else 0.99 * run.loss + 0.01 * loss
        run.step += 1
        report({"loss": run.loss, "progress": progress, "rollout_mse": run.best, "step": run.step})
    return run


def _validate(
    training: StepperTraining,
    *,
    validate: Callable[[nn.Module], dict[str, float]],
    keep: Callable[[nn.Module], None],
) -> None:
    """Score the averaged model, log it, keep it if it is the best so far; JSON has no infinity."""
    run = training.run
    training.average.module.eval()
    scores = validate(training.average.module)
    training.average.module.train()
    known = {name: value if math.isfinite(value) else None for name, value in scores.items()}
    entry = {"step": run.step, "seconds": run.seconds, "loss": run.loss, **known}
    run.history = [*(run.history or []), entry]
    append_log(training.folder / "log.jsonl", {"stage": "time_stepper", **entry})
    if scores["rollout_mse"] < run.best:
        run.best = scores["rollout_mse"]
        keep(training.average.module)


def append_log(path: Path, entry: dict[str, Any]) -> None:
    """Add one JSON line to a log."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def has_bfloat16(*, on_cpu: bool) -> bool:
    """Whether this machine multiplies bfloat16 matrices in hardware."""
    if on_cpu:
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.cuda.is_bf16_supported(including_emulation=False)
