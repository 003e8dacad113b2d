"""Start the pointwise part of a time-stepper where it explains most, before the rest is trained.

The linear map is fitted by least squares; the gate, a small network on each particle alone, by a
few thousand cheap steps. Neither needs a graph.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from giorom.data.windows import WindowBatch, Windows, concatenate_windows, step_generator, turn
from giorom.features import compute_features
from giorom.graph import Edges
from giorom.integrate import finite_differences
from giorom.pipeline import Dynamics
from giorom.training.noise import add_random_walk
from giorom.training.training_config import TrainingConfig

LINEAR_BATCHES = 64
"""Batches the linear map is fitted to."""

BATCH_WINDOWS = 8
"""Windows of a batch."""

GATE_LEARNING_RATE = 3e-3
"""Learning rate of the gate at the start; a cosine takes it to zero."""


def fit_skip(
    dynamics: Dynamics,
    windows: Windows,
    config: TrainingConfig,
    *,
    seed: int,
    minutes: float,
    report: Callable[[dict[str, Any]], None],
) -> float:
    """Fit the pointwise skip of the time-stepper, in place.

    Args:
        dynamics: Model on the CPU.
        windows: Training windows.
        config: Noise, turning and number of gate steps.
        seed: Seed of the draws.
        minutes: Longest time for the gate [min].
        report: Called after every gate step with numbers for a progress bar.

    Returns:
        Share of the variance of the training accelerations that the linear map explains.
    """
    skip = dynamics.time_stepper.input_skip
    batches = [_draw(dynamics, windows, config, seed=seed, draw=d) for d in range(LINEAR_BATCHES)]
    matrix = torch.cat([node for node, _ in batches]).double()
    wanted = torch.cat([target for _, target in batches]).double()
    normal = matrix.T @ matrix
    normal += 1e-6 * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype)
    weight = torch.linalg.solve(normal, matrix.T @ wanted)
    with torch.no_grad():
        skip.linear.weight.copy_(weight.T)
    if skip.gate is not None:
        _train_gate(dynamics, windows, config, seed=seed, minutes=minutes, report=report)
    error = (matrix @ weight - wanted).square().sum()
    return 1.0 - float(error / wanted.square().sum())


def _train_gate(
    dynamics: Dynamics,
    windows: Windows,
    config: TrainingConfig,
    *,
    seed: int,
    minutes: float,
    report: Callable[[dict[str, Any]], None],
) -> None:
    """Adam on the one-step error of the skip alone."""
    skip = dynamics.time_stepper.input_skip
    optimizer = torch.optim.Adam(skip.parameters())
    start, mean = time.perf_counter(), math.nan
    for step in range(config.gate_steps):
        share = max(step / config.gate_steps, (time.perf_counter() - start) / (60.0 * minutes))
        if share >= 1.0:
            break
        for group in optimizer.param_groups:
            group["lr"] = GATE_LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * share))
        node, target = _draw(dynamics, windows, config, seed=seed, draw=LINEAR_BATCHES + step)
        loss = (skip(node) - target).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if config.gradient_clip is not None:
            torch.nn.utils.clip_grad_norm_(skip.parameters(), config.gradient_clip)
        optimizer.step()
        value = float(loss.detach())
        mean = value if math.isnan(mean) else 0.99 * mean + 0.01 * value
        report({"loss": mean, "progress": share, "step": step + 1})


def _draw(
    dynamics: Dynamics, windows: Windows, config: TrainingConfig, *, seed: int, draw: int
) -> tuple[Tensor, Tensor]:
    """Node features and normalised accelerations of the free particles of some windows."""
    generator = step_generator(seed + 2, draw)
    numbers = torch.randint(len(windows), (BATCH_WINDOWS,), generator=generator)
    batch: WindowBatch = concatenate_windows(
        [replace(windows[int(number)], edges=None) for number in numbers]
    )
    if config.turn:
        batch = turn(batch, generator=generator)
    state = add_random_walk(batch.state, config.noise_std, generator=generator)
    loops = torch.arange(len(state.reference))
    features = compute_features(
        state,
        Edges(sender=loops, receiver=loops, offset=torch.arange(len(loops) + 1)),
        dynamics.features,
        normalization=dynamics.normalization,
        radius=dynamics.radius,
    )
    target = finite_differences(
        batch.target[:, 0] + state.position - batch.state.position,
        state.position,
        state.history[:, -2],
        frame_dt=state.frame_dt,
    )
    free = ~state.kinematic
    return features.node[free], dynamics.normalization.acceleration(target)[free]
