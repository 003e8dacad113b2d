"""What a training of a time-stepper may use: its values, its budget, its learning rate."""

import math
from dataclasses import dataclass, field
from typing import Literal

MOST_WINDOWS = 4096
"""Largest batch."""

MOST_SUBSETS = 1000
"""Largest number of samples of each trajectory."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How the time-stepper is trained."""

    batch_size: int = 4
    """Windows per optimiser step; those of ``cma`` are shared by the candidates of a step."""

    optimizer: Literal["adamax", "adam", "adamw", "nadam", "cma"] = "adamax"
    """Optimiser (Adamax in the paper); ``cma`` searches a few learned values without gradients,
    one generation of candidates a step, and uses none of the values from ``learning_rate`` to
    ``gradient_clip``, no ``average_decay`` and no ``precision``."""

    learning_rate: float = 1e-4
    """Learning rate at the start."""

    final_learning_rate: float = 1e-6
    """Learning rate that the decay approaches."""

    decades: float = 2.0
    """Powers of ten by which the learning rate above the final one decays over the budget."""

    decay_steps: float | None = None
    """Steps in which it decays by one power of ten whatever the budget (5e6 in the paper); null:
    as ``decades`` says."""

    warmup: int = 100
    """Steps over which the learning rate rises from zero."""

    weight_decay: float = 1e-6
    """Weight decay."""

    gradient_clip: float | None = 1.0
    """Largest norm of the gradient; null: any (the paper)."""

    noise_std: float = 0.0
    """Spread of the training noise on the newest velocity, as displacement per frame [m]."""

    position_weight: float = 1e5
    """Weight beta of the position error in equation 10 [1/m^2]."""

    huber: float | None = None
    """Error of the dimensionless acceleration above which it counts linearly and no longer
    squared, for data whose few largest accelerations outweigh all others; null: always squared
    (the paper)."""

    objective: Literal["acceleration", "motion"] = "acceleration"
    """What the loss compares: the accelerations and positions of equation 10, or, for grid
    and body steppers, the whole motion from the first frame on."""

    unroll: list[list[float]] | None = None
    """Stages [share of the budget at which it begins, frames per window]; null: one frame (the
    paper)."""

    pushforward: bool = False
    """Train the last frame of an unrolled window alone: the frames before it, without gradient,
    make the disturbed state from which the model has to go on."""

    gate_steps: int = 4000
    """Steps that fit the gate of a gated skip before the whole network is trained."""

    trajectories: int | None = None
    """Training trajectories that are used, the first of the data set: how much data a model needs;
    null: all."""

    subsets: int = 8
    """Different samples of each trajectory."""

    turn: bool = False
    """Turn and mirror scenes at random; sound where the side walls are out of reach."""

    straight_past: bool = False
    """Let windows begin at the first frame, their past extrapolated straight; a model that is
    started from a shape and a velocity has to know such beginnings."""

    isotropic: bool = False
    """One velocity and one acceleration scale for all axes, no offset."""

    explicit_gravity: bool = False
    """Learn how accelerations differ from the free fall of ``scene.gravity``: where the network
    gives zero, particles fall."""

    average_decay: float = 0.998
    """Decay of the running average of the weights that is validated and kept; 0: no average, the
    newest weights."""

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    """Precision of the matrix products; ``auto`` takes bfloat16 where the machine computes it."""

    validations: int = 12
    """Validation rollouts over the budget, evenly spaced; fewer where they would take more than a
    fifth of a budget of minutes."""

    validation_frames: int = 100
    """Frames of a validation rollout, as far as the trajectories reach."""

    validation_trajectories: int = 8
    """Held-out trajectories rolled out, at most."""

    least_coverage: float = 0.9
    """Smallest share of the training samples that the latent grid must reach; a run that falls
    short is refused."""

    goals: list[float] = field(default_factory=lambda: [1.0, 0.5, 0.25, 0.1, 0.05])
    """Validation rollout errors to whose first reaching the time is reported."""

    goal_unit: Literal["static", "m^2"] = "static"
    """Unit of the goals: the error of holding still, or square metres."""

    def __post_init__(self) -> None:
        """Reject values no training can use."""
        positive = "batch_size learning_rate decades subsets validations".split()
        optional = [
            n for n in ("decay_steps", "gradient_clip", "huber") if getattr(self, n) is not None
        ]
        natural = "final_learning_rate warmup weight_decay noise_std position_weight".split()
        for name in [*positive, *optional, "validation_frames", "validation_trajectories"]:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"TrainingConfig.{name} must be > 0 and finite, got {getattr(self, name)!r}."
                )
        for name, most in (("batch_size", MOST_WINDOWS), ("subsets", MOST_SUBSETS)):
            if getattr(self, name) > most:
                raise ValueError(
                    f"TrainingConfig.{name} must be <= {most}, got {getattr(self, name)!r}: more "
                    f"would fill the memory."
                )
        for name in natural:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"TrainingConfig.{name} must be >= 0 and finite, got {getattr(self, name)!r}."
                )
        if self.trajectories is not None and self.trajectories < 1:
            raise ValueError(
                f"TrainingConfig.trajectories must be >= 1, got {self.trajectories!r}. Null takes "
                f"all there are."
            )
        self._check_objective()
        self._check_unroll()
        self._check_shares()

    def _check_unroll(self) -> None:
        begun = -1.0
        for stage in self.unroll or []:
            whole = len(stage) == 2 and math.isfinite(stage[1]) and stage[1] == int(stage[1])
            if not whole or not 0.0 <= stage[0] < 1.0 or not stage[1] >= 1:
                raise ValueError(
                    f"TrainingConfig.unroll must be pairs [share in [0, 1), whole frames >= 1], "
                    f"got {stage!r}. Null trains on single frames."
                )
            if not stage[0] > begun:
                raise ValueError(
                    f"the shares of TrainingConfig.unroll must rise, but {stage[0]!r} follows "
                    f"{begun!r}. Put the stages in the order in which they begin."
                )
            begun = stage[0]

    def _check_shares(self) -> None:
        if not all(goal > 0 for goal in self.goals):
            raise ValueError(f"TrainingConfig.goals must all be > 0, got {self.goals!r}.")
        if not 0.0 <= self.least_coverage <= 1.0:
            raise ValueError(
                f"TrainingConfig.least_coverage is a share and must lie in [0, 1], got "
                f"{self.least_coverage!r}. 0 refuses nothing."
            )
        if not 0.0 <= self.average_decay < 1.0:
            raise ValueError(
                f"TrainingConfig.average_decay must lie in [0, 1), got {self.average_decay!r}."
            )

    def _check_objective(self) -> None:
        if self.optimizer == "cma" and self.objective != "motion":
            raise ValueError(
                f"TrainingConfig.optimizer 'cma' compares whole motions: objective must be "
                f"'motion', got {self.objective!r}. Change it, or take another optimizer."
            )
        if self.objective == "motion" and (self.pushforward or self.huber is not None):
            raise ValueError(
                f"TrainingConfig.pushforward={self.pushforward!r} and huber={self.huber!r} belong "
                f"to the objective 'acceleration', not to 'motion'. Leave them out."
            )

    def unrolled_frames(self, progress: float) -> int:
        """Frames per window after the share ``progress`` of the budget."""
        begun = [frames for share, frames in self.unroll or [] if share <= progress]
        return int(begun[-1]) if begun else 1

    @property
    def longest_unroll(self) -> int:
        """Frames after the current one that a window must hold."""
        return max([1, *(int(frames) for _, frames in self.unroll or [])])


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
    """The GNS rule with a horizon that fits the budget, or with the configured one.

    Source:
        arXiv:2002.09405: lr = lr_end + (lr_start - lr_end) 0.1^(t / 5e6).
    """
    span = config.learning_rate - config.final_learning_rate
    tenths = config.decades * progress if config.decay_steps is None else step / config.decay_steps
    rate = config.final_learning_rate + span * 0.1**tenths
    return rate * min(1.0, (step + 1) / max(1, config.warmup))
