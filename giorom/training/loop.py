"""The plain loop that trains a time-stepper; ``field_loop.py`` trains the field.

What makes a run reproducible is kept in one place: every random number of a step comes from the
seed and the number of the step, so that a resumed run draws what an uninterrupted one would.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

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
from giorom.pipeline import Connect
from giorom.training.checkpoint import (
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
    save_checkpoint,
    unfit_checkpoint,
)
from giorom.training.loss import motion_loss, push_forward, unrolled_loss
from giorom.training.noise import add_random_walk
from giorom.training.training_config import Budget, TrainingConfig, learning_rate

VALIDATION_GAP = 4
"""Least time of training between two validations in units of what one takes, where the budget is
one of time: else a slow model would do little but roll out."""

OPTIMIZERS = {
    "adamax": torch.optim.Adamax,
    "adam": partial(torch.optim.Adam, fused=True),
    "adamw": partial(torch.optim.AdamW, fused=True),
    "nadam": torch.optim.NAdam,
}
"""Optimisers of ``TrainingConfig.optimizer``; being fused takes a sixth off a step of a network of
1.6 million parameters on a graph of a thousand edges (one CPU core)."""


@dataclass
class RunState:
    """Counters of a run that a checkpoint keeps."""

    step: int = 0
    seconds: float = 0.0
    next_validation: float = 0.0
    best: float = math.inf
    loss: float = math.nan
    history: list[dict[str, Any]] | None = None

    def __post_init__(self) -> None:
        """Reject counters that a damaged checkpoint brings."""
        if type(self.step) is not int or self.step < 0:
            raise ValueError(f"RunState.step must be a whole number >= 0, got {self.step!r}")
        for name in ("seconds", "next_validation", "best", "loss"):
            if type(getattr(self, name)) not in (int, float):
                raise ValueError(f"RunState.{name} must be a number, got {getattr(self, name)!r}")
        if not isinstance(self.history, list | None):
            raise ValueError("RunState.history must be a list")


@runtime_checkable
class Trainer(Protocol):
    """What ``train_stepper`` trains with: by gradients here, without them in ``search.py``."""

    config: TrainingConfig
    windows: Windows
    seed: int
    folder: Path
    run: RunState
    smoothing: float

    def train_step(self, numbers: list[int], *, progress: float) -> float:
        """One step on the windows ``numbers``; returns the loss."""

    def chosen(self) -> nn.Module:
        """The model that is validated and kept."""

    def save(self) -> None:
        """Write a checkpoint."""


class StepperTraining:
    """Training of a time-stepper by gradients: model, average, optimiser, counters.

    Args:
        dynamics: Model to train.
        config: How.
        windows: Training windows.
        connect: Graph of a state, where windows bring none.
        seed: Seed of batches, noise and turns.
        folder: Directory of the run.
    """

    smoothing = 0.99
    """Decay of the running average of the loss that is reported."""

    def __init__(
        self,
        dynamics: nn.Module,
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
        self.half = has_bfloat16(on_cpu=on_cpu) if wanted == "auto" else wanted == "bfloat16"
        # Its own mixed precision is one for the whole process, and would outlive the training in
        # the forward of the model that is validated and kept.
        self.accelerator = Accelerator(mixed_precision="no", cpu=on_cpu)
        self.names = [name for name, _ in dynamics.named_parameters()]
        optimizer = OPTIMIZERS[config.optimizer]
        self.model, self.optimizer = self.accelerator.prepare(
            dynamics, optimizer(dynamics.parameters(), weight_decay=config.weight_decay)
        )
        self.plain = self.accelerator.unwrap_model(self.model)
        self.average = AveragedModel(
            dynamics, multi_avg_fn=get_ema_multi_avg_fn(config.average_decay)
        )
        self.run = RunState(history=[])

    def chosen(self) -> nn.Module:
        """The averaged model."""
        return self.average.module

    def resume(self) -> None:
        """Continue from the newest checkpoint of the run.

        Raises:
            CheckpointError: If there is none, or it is damaged or of another model.
        """
        tensors, record = load_checkpoint(self.folder / "checkpoints")
        try:
            self.plain.load_state_dict(_below("model.", tensors))
            self.average.load_state_dict(_below("average.", tensors))
            load_optimizer_tensors(self.optimizer.optimizer, self.names, tensors)
            torch.set_rng_state(tensors["random"])
            self.run = RunState(**record["run"])
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise unfit_checkpoint(self.folder, error) from None

    def save(self) -> None:
        """Write a checkpoint."""
        tensors = {f"model.{k}": v for k, v in self.plain.state_dict().items()}
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
        """One optimiser step on the windows ``numbers``; returns the loss.

        Raises:
            FloatingPointError: If the loss is not finite.
        """
        config = self.config
        generator = step_generator(self.seed + 1, self.run.step)
        batch = concatenate_windows([self.windows[number] for number in numbers])
        if config.turn:
            batch = turn(batch, generator=generator)
        device = self.accelerator.device.type
        with torch.autocast(device, torch.bfloat16, enabled=self.half):
            loss = self._loss(batch, generator, progress=progress)
        rate = learning_rate(config, step=self.run.step, progress=progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        self.accelerator.backward(loss)
        if config.gradient_clip is not None:
            self.accelerator.clip_grad_norm_(self.model.parameters(), config.gradient_clip)
        self.optimizer.step()
        self.average.update_parameters(self.plain)
        if not math.isfinite(value := float(loss.detach())):
            raise FloatingPointError(
                f"the training loss is {value} at step {self.run.step}. Lower "
                f"TrainingConfig.learning_rate ({config.learning_rate:g}) and train again."
            )
        return value

    def _loss(self, batch: WindowBatch, generator: torch.Generator, *, progress: float) -> Tensor:
        """The loss of the stage of training that ``progress`` falls into."""
        config, device = self.config, self.accelerator.device
        model = self.plain
        batch = replace(batch, target=batch.target[:, : config.unrolled_frames(progress)])
        if config.objective == "motion":
            return motion_loss(model.step, batch.to(device), connect=self.connect)
        noisy = add_random_walk(batch.state, config.noise_std, generator=generator).to(device)
        batch = batch.to(device)
        if config.pushforward:
            noisy, batch = push_forward(model, noisy, batch, connect=self.connect)
        return unrolled_loss(
            model,
            noisy,
            batch,
            connect=self.connect,
            position_weight=config.position_weight,
            huber=config.huber,
        )


def train_stepper(
    training: Trainer,
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
        validate: Scores of the chosen model; ``rollout_mse`` decides which is best.
        keep: Called with the chosen model whenever it is the best so far.
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
            _validate(training, validate=validate, keep=keep)
            cost = budget.progress(0, time.perf_counter() - clock - run.seconds)
            following = (math.floor(progress * config.validations) + 1) / config.validations
            run.next_validation = max(following, progress + (1 + VALIDATION_GAP) * cost)
            training.save()
            validated = run.step
        if progress >= 1.0:
            break
        loss = training.train_step(numbers, progress=progress)
        old = training.smoothing if math.isfinite(run.loss) else 0.0
        run.loss = old * run.loss + (1.0 - old) * loss if old else loss
        run.step += 1
        report({"loss": run.loss, "progress": progress, "rollout_mse": run.best, "step": run.step})
    return run


def _validate(
    training: Trainer,
    *,
    validate: Callable[[nn.Module], dict[str, float]],
    keep: Callable[[nn.Module], None],
) -> None:
    """Score the chosen model, log it, keep it if it is the best so far; JSON has no infinity."""
    run, model = training.run, training.chosen()
    model.eval()
    scores = validate(model)
    model.train()
    numbers = {"loss": run.loss, **scores}
    known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    entry = {"step": run.step, "seconds": run.seconds, **known}
    run.history = [*(run.history or []), entry]
    append_log(training.folder / "log.jsonl", {"stage": "time_stepper", **entry})
    if scores["rollout_mse"] < run.best:
        run.best = scores["rollout_mse"]
        keep(model)


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
