"""Training of a field: what follows in closed form, then gradient descent on its loss.

The neural basis learns by variable projection (equation 11). A field without parameters takes no
step.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from giorom.data.windows import random_turn, step_generator
from giorom.fields import Field
from giorom.state import Trajectory


@dataclass(frozen=True, kw_only=True)
class FieldTrainingConfig:
    """How a field that learns is trained."""

    learning_rate: float = 2e-3
    """Learning rate at the start; a cosine takes it to zero."""

    steps: int = 3000
    """Optimiser steps, unless the minutes end before."""

    minutes: float = 2.0
    """Longest time [min]; at most a tenth of the whole budget is used."""

    frames: int = 16
    """Frames per step."""

    samples: int = 200
    """Points that play the part of the samples."""

    queries: int = 600
    """Points on which the error is measured."""

    stored_points: int = 3000
    """Points kept of each training trajectory."""

    stored_frames: int = 40
    """Frames kept of each training trajectory."""

    def __post_init__(self) -> None:
        """Reject values no training can use."""
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"FieldTrainingConfig.{name} must be > 0, got {value!r}.")


def thin(trajectory: Trajectory, config: FieldTrainingConfig, *, seed: int) -> Trajectory:
    """Random points and evenly spaced frames of a trajectory, in memory of their own."""
    generator = torch.Generator().manual_seed(seed)
    count = trajectory.position.shape[1]
    points = torch.randperm(count, generator=generator)[: config.stored_points]
    frames = torch.linspace(0, trajectory.frame_count - 1, config.stored_frames).round().long()
    small = trajectory.subset(points)
    return replace(small, position=small.position[frames.unique()].clone())


def train_field(
    field: Field,
    trajectories: list[Trajectory],
    config: FieldTrainingConfig,
    *,
    seed: int,
    minutes: float,
    report: Callable[[dict[str, Any]], None],
    turn: bool = False,
) -> dict[str, Any]:
    """Fit a field to the training trajectories.

    Args:
        field: Field to train, in place.
        trajectories: Thinned training trajectories.
        config: How.
        seed: Seed of the draws.
        minutes: Longest time of the gradient descent [min]; closed forms come on top.
        report: Called after every step with numbers for a progress bar.
        turn: Turn bodies about the vertical at random.

    Returns:
        Steps, seconds and, if there was anything to learn, the smoothed relative error.
    """
    begin, step, mean = time.perf_counter(), 0, math.nan
    field.prepare(trajectories)
    if not field.learns:
        return {"steps": 0, "seconds": time.perf_counter() - begin}
    optimizer = torch.optim.Adam(field.parameters())  # the first one of a process takes seconds
    start = time.perf_counter()
    while True:
        share = max(step / config.steps, (time.perf_counter() - start) / (60.0 * minutes))
        if share >= 1.0:
            break
        generator = step_generator(seed, step)
        reference, displacement = _draw(trajectories, config, generator, turn=turn)
        loss = field.loss(
            reference, displacement, solve_count=min(config.samples, len(reference) // 2)
        )
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(field.parameters(), 1.0)
        optimizer.step()
        value = float(loss.detach())
        mean = value if math.isnan(mean) else 0.98 * mean + 0.02 * value
        step += 1
        report({"loss": mean, "progress": share, "step": step})
    result = {"steps": step, "seconds": time.perf_counter() - begin}
    return result | ({"relative_error": mean**0.5} if step else {})


def _draw(
    trajectories: list[Trajectory],
    config: FieldTrainingConfig,
    generator: torch.Generator,
    *,
    turn: bool,
) -> tuple[Tensor, Tensor]:
    """Random points and frames of one random trajectory."""
    which = int(torch.randint(len(trajectories), (), generator=generator))
    position = trajectories[which].position
    points = torch.randperm(position.shape[1], generator=generator)
    points = points[: config.samples + config.queries]
    frames = torch.randint(1, len(position), (config.frames,), generator=generator)
    reference, moved = position[0, points], position[frames][:, points]
    if turn and position.shape[2] == 3:
        matrix = random_turn(1, generator=generator)[0]
        center = trajectories[which].bounds.mean(dim=1)
        reference = (reference - center) @ matrix.T + center
        moved = (moved - center) @ matrix.T + center
    return reference, moved - reference
