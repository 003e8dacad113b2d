"""Training of a latent forecaster: first the coded field, then the equation of its codes.

Each has half of the steps or of the time. The equation is integrated over windows of the stored
frames, which grow from two frames to the whole motion, and compared with the codes of the field.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from giorom.forecasters.forecaster import LatentForecaster
from giorom.forecasters.motions import Motions

FULL_AT = 0.8
"""Share of the training at which windows reach the whole motion."""


@dataclass(frozen=True, kw_only=True)
class ForecasterTrainingConfig:
    """How a forecaster is trained."""

    field_rate: float = 5e-3
    """Learning rate of the coded field; a cosine takes it to zero."""

    code_rate: float = 1e-2
    """Learning rate of the stored codes."""

    dynamics_rate: float = 5e-3
    """Learning rate of the equation; a cosine takes it to zero."""

    frames: int = 32
    """Frames per step of the coded field."""

    points: int = 128
    """Points of each of them."""

    codes_at_once: int = 256
    """Codes per step of the equation: windows times their frames."""

    def __post_init__(self) -> None:
        """Reject values no training can use."""
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"ForecasterTrainingConfig.{name} must be > 0, got {value!r}.")


class _Clock:
    """Share of a budget that is spent, counted in steps or in time."""

    def __init__(self, steps: int | None, minutes: float | None) -> None:
        self.steps, self.minutes = steps, minutes
        self.start, self.step = time.perf_counter(), 0

    def share(self) -> float:
        """Between zero and one; one is the end."""
        spent = 0.0 if self.steps is None else self.step / self.steps
        if self.minutes is not None:
            spent = max(spent, (time.perf_counter() - self.start) / (60.0 * self.minutes))
        return min(spent, 1.0)


def train_forecaster(
    forecaster: LatentForecaster,
    motions: Motions,
    config: ForecasterTrainingConfig,
    *,
    seed: int,
    steps: int | None = None,
    minutes: float | None = None,
) -> dict[str, Any]:
    """Fit a forecaster to motions, in place.

    Args:
        forecaster: What to train.
        motions: Training motions.
        config: How.
        seed: Seed of the draws.
        steps: Most steps, half for the field and half for the equation.
        minutes: Longest time, divided likewise [min]. One of both is needed.

    Returns:
        Steps and seconds of both parts, and the last smoothed errors in units of the states and
        of the codes.

    Raises:
        ValueError: If there is no limit.
    """
    if steps is None and minutes is None:
        raise ValueError("training needs a limit: give steps, minutes or both.")
    half = (
        None if steps is None else max(1, steps // 2),
        None if minutes is None else minutes / 2,
    )
    generator = torch.Generator().manual_seed(seed)
    how = {"config": config, "limit": half, "generator": generator}
    start = time.perf_counter()
    forecaster.prepare(motions)
    point, state = forecaster.place(motions.point), motions.state / forecaster.size
    codes, first = _train_field(forecaster, point, state, **how)
    forecaster.set_codes(codes.flatten(0, 1))
    codes = (codes - forecaster.code_mean) / forecaster.code_scale
    context = torch.stack([forecaster.context(p) for p in motions.point])
    times = (motions.frame - motions.frame[0]) / forecaster.stride
    second = _train_dynamics(forecaster, codes, context, times, **how)
    return {
        "field_steps": first[0],
        "dynamics_steps": second[0],
        "steps": first[0] + second[0],
        "field_error": first[1],
        "code_error": second[1],
        "seconds": time.perf_counter() - start,
    }


def _train_field(
    forecaster: LatentForecaster,
    point: Tensor,
    state: Tensor,
    *,
    config: ForecasterTrainingConfig,
    limit: tuple[int | None, float | None],
    generator: torch.Generator,
) -> tuple[Tensor, tuple[int, float]]:
    """Train the coded field; the codes of all stored frames (m t c), steps and error."""
    field = forecaster.field
    count, frames = state.shape[:2]
    table = None
    groups = [{"params": list(field.parameters()), "base": config.field_rate}]
    if field.stores_codes:
        table = state.new_zeros(count, frames, field.code, requires_grad=True)
        groups.append({"params": [table], "base": config.code_rate})

    def draw(share: float) -> Tensor:
        del share
        which = torch.randint(count, (config.frames,), generator=generator)
        when = torch.randint(frames, (config.frames,), generator=generator)
        size = (config.frames, min(config.points, point.shape[1]))
        where = torch.randint(point.shape[1], size, generator=generator)
        code = None if table is None else table[which, when]
        rows = which[:, None]
        return field.loss(point[rows, where], state[rows, when[:, None], where], code)

    done = _descend(groups, draw, limit)
    if table is not None:
        return table.detach(), done
    chosen = torch.randperm(point.shape[1], generator=generator)[: 2 * config.points]
    parts = [
        field.fit(place[chosen].expand(frames, -1, -1), motion[:, chosen])
        for place, motion in zip(point, state, strict=True)
    ]
    return torch.stack(parts), done


def _train_dynamics(
    forecaster: LatentForecaster,
    codes: Tensor,
    context: Tensor,
    times: Tensor,
    *,
    config: ForecasterTrainingConfig,
    limit: tuple[int | None, float | None],
    generator: torch.Generator,
) -> tuple[int, float]:
    """Train the equation on windows that grow; steps and error."""
    count, frames = codes.shape[:2]

    def draw(share: float) -> Tensor:
        length = 1 + round(min(share / FULL_AT, 1.0) * (frames - 2))
        size = max(1, config.codes_at_once // (length + 1))
        which = torch.randint(count, (size,), generator=generator)
        begin = int(torch.randint(frames - length, (), generator=generator))
        window = slice(begin, begin + length + 1)
        truth = codes[which, window].transpose(0, 1)
        path = forecaster.dynamics.integrate(truth[0], context[which], times[window])
        return (path[1:] - truth[1:]).square().mean()

    parameters = list(forecaster.dynamics.parameters())
    return _descend([{"params": parameters, "base": config.dynamics_rate}], draw, limit)


def _descend(
    groups: list[dict[str, Any]],
    draw: Callable[[float], Tensor],
    limit: tuple[int | None, float | None],
) -> tuple[int, float]:
    """Adam with a cosine until the limit; steps and smoothed loss."""
    optimizer = torch.optim.Adam(groups)
    parameters = [p for group in groups for p in group["params"]]
    clock, mean = _Clock(*limit), math.nan
    while (share := clock.share()) < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = group["base"] * 0.5 * (1.0 + math.cos(math.pi * share))
        loss = draw(share)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        value = float(loss.detach())
        mean = value if math.isnan(mean) else 0.98 * mean + 0.02 * value
        clock.step += 1
    return clock.step, mean
