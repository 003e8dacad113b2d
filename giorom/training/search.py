"""Training without gradients: a search for the few values of a stepper that fit whole motions.

Where few values are learned and motions are chaotic, the gradient through a hundred frames says
little and costs three times the rollout. So candidates are drawn from a normal distribution over
the values, each is scored by a rollout, and the distribution moves and narrows towards the better
half of them. One step of training is one generation: 4 + 3 ln(n) candidates for n values, all
scored on the same scenes. The mean of the distribution is what is validated and kept.

Source:
    Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772.
"""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from giorom.data.windows import WindowBatch, Windows, concatenate_windows, step_generator, turn
from giorom.pipeline import Connect, Step
from giorom.state import SparseState
from giorom.training.checkpoint import load_checkpoint, save_checkpoint, unfit_checkpoint
from giorom.training.loop import RunState
from giorom.training.loss import motion_loss
from giorom.training.training_config import TrainingConfig

FIRST_SPREAD = 0.3
"""Standard deviation of every value in the first generation; most values are logarithms."""

MOST_VALUES = 100
"""Largest number of values searched: the work of a generation grows with its third power."""

STATE = ("mean", "spread", "covariance", "covariance_path", "spread_path", "evaluations")
"""What a checkpoint keeps of the distribution."""


@runtime_checkable
class Selective(Protocol):
    """A model that knows which of its values matter for a material."""

    def searched(self, particle_type: Int[Tensor, " q"]) -> dict[str, Bool[Tensor, "..."]]:
        """Which entries of each parameter matter where some particle types occur."""


class Distribution:
    """A normal distribution that moves towards better values (CMA-ES).

    Args:
        mean: Where it begins.
        spread: Standard deviation of every value at the beginning.
    """

    def __init__(self, mean: list[float], *, spread: float) -> None:
        from cma import purecma

        self.strategy = purecma.CMAES(mean, spread)
        # Axes that are new in every generation are the same after an interruption.
        self.strategy.params.lazy_gap_evals = 0

    @property
    def mean(self) -> list[float]:
        """The most likely values."""
        return self.strategy.xmean

    def draw(self, generator: torch.Generator) -> list[list[float]]:
        """The candidates of a generation."""

        def normal(mean: int, spread: int) -> float:
            return mean + spread * float(torch.randn((), generator=generator, dtype=torch.float64))

        self.strategy.randn = normal
        return self.strategy.ask()

    def update(self, candidates: list[list[float]], scores: list[float]) -> None:
        """Move towards the better candidates; the worst score is infinity.

        Where not one candidate has a score, the mean stays and the spread is halved.
        """
        if math.isfinite(min(scores)):
            self.strategy.tell(candidates, scores)
        else:
            self.strategy.sigma *= 0.5

    def tensors(self) -> dict[str, Tensor]:
        """Everything the next generation depends on."""
        of = self.strategy
        values = (of.xmean, of.sigma, list(of.C), of.pc, of.ps, of.counteval)
        pairs = zip(STATE, values, strict=True)
        return {name: torch.tensor(value, dtype=torch.float64) for name, value in pairs}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """The inverse of ``tensors``.

        Raises:
            ValueError: If they belong to another number of values or to no distribution.
        """
        for name, known in self.tensors().items():
            if tensors[name].shape != known.shape:
                raise ValueError(
                    f"{name} has the shape {tuple(tensors[name].shape)} instead of "
                    f"{tuple(known.shape)}"
                )
            if not bool(tensors[name].isfinite().all()):
                raise ValueError(f"{name} holds values that are not finite")
        covariance = tensors["covariance"]
        if not tensors["spread"] > 0 or int(torch.linalg.cholesky_ex(covariance).info):
            raise ValueError("spread or covariance are not those of a distribution")
        of, values = self.strategy, {name: tensors[name].tolist() for name in STATE}
        of.xmean, of.sigma = values["mean"], values["spread"]
        of.pc, of.ps = values["covariance_path"], values["spread_path"]
        of.counteval = int(values["evaluations"])
        for row, known in zip(of.C, values["covariance"], strict=True):
            row[:] = known


class StepperSearch:
    """Search for the values of a stepper; trained by ``train_stepper`` like any other.

    Args:
        dynamics: Model to train, anything with a ``step``; if it is ``Selective``, those of its
            values that matter are searched, else all.
        config: How.
        windows: Training windows.
        connect: Graph of a state, where windows bring none.
        seed: Seed of batches, candidates and turns.
        folder: Directory of the run.
    """

    smoothing = 0.0
    """The loss of a generation is that of its best candidate, no average over generations."""

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
        self.model, self.config = dynamics, config
        self.windows, self.connect = windows, connect
        self.seed, self.folder = seed, folder
        self.masks = searched_entries(dynamics, windows)
        self.distribution = Distribution(self._values(), spread=FIRST_SPREAD)
        self.run = RunState(history=[])

    def chosen(self) -> nn.Module:
        """The model at the mean of the distribution."""
        self._place(self.distribution.mean)
        return self.model

    def resume(self) -> None:
        """Continue from the newest checkpoint of the run.

        Raises:
            CheckpointError: If there is none, or it is damaged or of another model.
        """
        tensors, record = load_checkpoint(self.folder / "checkpoints")
        try:
            self.distribution.load({name: tensors[f"search.{name}"] for name in STATE})
            self.run = RunState(**record["run"])
        except (KeyError, TypeError, ValueError) as error:
            raise unfit_checkpoint(self.folder, error) from None

    def save(self) -> None:
        """Write a checkpoint."""
        tensors = {f"search.{name}": value for name, value in self.distribution.tensors().items()}
        save_checkpoint(
            self.folder / "checkpoints",
            step=self.run.step,
            tensors=tensors,
            record={"run": asdict(self.run)},
        )

    def train_step(self, numbers: list[int], *, progress: float) -> float:
        """One generation on the windows ``numbers``; returns the best score, maybe infinity."""
        batch = concatenate_windows([self.windows[number] for number in numbers])
        if self.config.turn:
            batch = turn(batch, generator=step_generator(self.seed + 1, self.run.step))
        frames = self.config.unrolled_frames(progress)
        batch = replace(batch, target=batch.target[:, :frames])
        batch = batch.to(next(self.model.parameters()).device)
        candidates = self.distribution.draw(step_generator(self.seed + 2, self.run.step))
        scores = [self._score(candidate, batch) for candidate in candidates]
        self.distribution.update(candidates, scores)
        return min(scores)

    @torch.no_grad()
    def _score(self, candidate: list[float], batch: WindowBatch) -> float:
        """The loss of the motion with some values; infinity where it diverges [m]."""
        self._place(candidate)
        try:
            loss = float(motion_loss(watched(self.model.step), batch, connect=self.connect))
        except FloatingPointError:
            return math.inf
        return loss if math.isfinite(loss) else math.inf

    def _values(self) -> list[float]:
        """The searched values of the model."""
        known = dict(self.model.named_parameters())
        values = [known[name].detach()[mask] for name, mask in self.masks.items()]
        return torch.cat(values).double().tolist()

    @torch.no_grad()
    def _place(self, values: list[float]) -> None:
        """Give the model the searched values; all others stay."""
        known = dict(self.model.named_parameters())
        rest = torch.tensor(values, dtype=torch.float64)
        for name, mask in self.masks.items():
            count = int(mask.sum())
            known[name][mask] = rest[:count].to(known[name])
            rest = rest[count:]


def searched_entries(model: nn.Module, windows: Windows) -> dict[str, Bool[Tensor, "..."]]:
    """Which entries of the parameters the training data can say anything about.

    Args:
        model: Model to train.
        windows: Training windows.

    Returns:
        A mask for every parameter with such an entry, by name.

    Raises:
        ValueError: If there are too many of them, or none.
    """
    masks = {n: torch.ones_like(p, dtype=torch.bool) for n, p in model.named_parameters()}
    if isinstance(model, Selective):
        masks = model.searched(occurring_types(windows))
    masks = {name: mask.cpu() for name, mask in masks.items() if mask.any()}
    count = sum(int(mask.sum()) for mask in masks.values())
    if not 0 < count <= MOST_VALUES:
        raise ValueError(
            f"TrainingConfig.optimizer 'cma' searches 1 to {MOST_VALUES} values, but this model "
            f"learns {count}. Train it by 'adamax' or 'adamw', or choose a grid_stepper or "
            f"body_stepper."
        )
    return masks


def occurring_types(windows: Windows) -> Int[Tensor, " k"]:
    """The particle types of some windows."""
    return torch.cat([t.motion.particle_type for t in windows.trajectories]).unique()


def watched(step: Step) -> Step:
    """The same step, which raises FloatingPointError once a sample is lost.

    Lost is what is not finite, or further outside the walls than the domain is wide.
    """

    def careful(state: SparseState, *arguments: object) -> SparseState:
        later = step(state, *arguments)
        low, high = state.bounds[:, 0], state.bounds[:, 1]
        inside = (later.position >= 2.0 * low - high) & (later.position <= 2.0 * high - low)
        if not bool(inside.all()):
            raise FloatingPointError("a sample is lost")
        return later

    return careful
