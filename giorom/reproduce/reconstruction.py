"""Fields that recover all particles from the true samples of motions they were not trained on.

One task of its own, without a time-stepper (T1 of docs/protocol.md). Every field that learns has
the same time for the same thinned training motions. What is decoded: evenly spaced frames of every
test trajectory, from the samples of the preset and from as many drawn at random.
"""

import itertools
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from giorom.config import Experiment, merged
from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.distribution import chamfer_distance
from giorom.fields import Field, FieldConfig, FieldKind, build_field
from giorom.records import parse_record
from giorom.reproduce.scale import Scale
from giorom.reproduce.study import Study
from giorom.sampling import SamplingConfig, sample
from giorom.state import Trajectory
from giorom.training.field_loop import FieldTrainingConfig, thin, train_field
from giorom.training.training_config import Budget

SHARE = 3 / 8
"""Time of a field in units of that of a time-stepper's training."""

MOST_MINUTES = 10.0
"""Longest training of a field [min]."""

BODIES = 32
"""Most training motions."""

FRAMES = 20
"""Frames of a trajectory that are compared."""

TINY_FRAMES = 3
"""The same where trainings are counted in steps, which only show that all works."""

TRAJECTORIES = 4
"""Most test trajectories."""

DRAW = 1
"""Seed of the random samples, the same for every field."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One row: a field and its settings."""

    name: str
    """Key of the row."""

    title: str
    """What it is, for a person."""

    kind: FieldKind
    """Which field."""

    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of that kind."""

    rank: int | None = None
    """Coefficients of a frame, where there is a fixed number."""

    group: str = ""
    """Name of the paper's method it is, if any."""

    repeated: bool = False
    """Whether it is trained with every seed; otherwise with the first."""


def field_budget(scale: Scale) -> Budget:
    """How long each field that learns is trained at a scale."""
    if scale.budget.minutes is None:
        return Budget(steps=scale.budget.steps)
    return Budget(minutes=min(SHARE * scale.budget.minutes, MOST_MINUTES))


def score_fields(study: Study, key: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Scores of some fields on one system after trainings of one seed, each of them kept.

    Args:
        study: Keeps the scores.
        key: ``system``, ``seed``, and ``fields``: by name the kind and its settings.
    """
    system, seed, budget = key["system"], key["seed"], field_budget(study.scale)
    experiment, folder = study.experiment(system), study.dataset(system)
    frames = FRAMES if study.scale.budget.steps is None else TINY_FRAMES
    motions: dict[str, list[Trajectory]] = {}

    def make(name: str, kind: FieldKind, settings: dict[str, Any]) -> dict[str, Any]:
        if not motions:
            motions.update(train=_thinned(folder, experiment), test=_test(folder))
        config = _config(kind, settings, experiment, where=name)
        return _scores_of(config, experiment, motions, budget=budget, seed=seed, frames=frames)

    found = {}
    for name, (kind, settings) in key["fields"].items():
        known = {
            "system": system,
            "data": folder.name,
            "seed": seed,
            "kind": kind,
            "settings": settings,
            "budget": vars(budget),
        }
        found[name] = study.kept("field", known, partial(make, name, kind, settings))
    return found


def _config(
    kind: FieldKind, settings: dict[str, Any], experiment: Experiment, *, where: str
) -> FieldConfig:
    """A field with the settings of the preset where it has any for that kind of interpolation."""
    values: dict[str, Any] = {"kind": kind, kind: settings}
    if kind in ("local", "transport"):
        values = merged({kind: vars(getattr(experiment.field, kind))}, values)
    return parse_record(FieldConfig, values, where=where)


def _thinned(folder: Path, experiment: Experiment) -> list[Trajectory]:
    """Some points and frames of the training motions."""
    bodies = itertools.islice(iterate_trajectories(folder, "train"), BODIES)
    config = experiment.field_training
    return [thin(trajectory, config, seed=number) for number, trajectory in enumerate(bodies)]


def _test(folder: Path) -> list[Trajectory]:
    return list(itertools.islice(iterate_trajectories(folder, "test"), TRAJECTORIES))


def _scores_of(
    config: FieldConfig,
    experiment: Experiment,
    motions: dict[str, list[Trajectory]],
    *,
    budget: Budget,
    seed: int,
    frames: int,
) -> dict[str, Any]:
    """Train one field and score it; ``problem`` says why there is none, if so."""
    torch.manual_seed(seed)
    made = build_field(config, dimension=experiment.scene.dimension)
    training = _training(experiment, motions["train"], budget)
    try:
        result = train_field(
            made,
            motions["train"],
            training,
            seed=seed,
            minutes=MOST_MINUTES if budget.minutes is None else budget.minutes,
            turn=experiment.training.turn,
            report=lambda _: None,
        )
        made.eval().requires_grad_(False)
        scores = {
            where: _mean(
                [score_trajectory(made, t, chosen, frame_count=frames) for t in motions["test"]]
            )
            for where, chosen in _samplings(experiment.sampling)
        }
    except ValueError as error:  # too few frames or samples for its coefficients
        return {"problem": str(error)}
    parameters = sum(p.numel() for p in made.parameters())
    kept = {"seconds": result["seconds"], "steps": result["steps"], "parameters": parameters}
    return kept | {"problem": None} | scores


def _training(
    experiment: Experiment, motions: list[Trajectory], budget: Budget
) -> FieldTrainingConfig:
    """How fields are trained: with as many samples as they are asked with later."""
    counts = [experiment.sampling.sample_count(t.position.shape[1]) for t in motions]
    samples = round(sum(counts) / len(counts))
    return replace(experiment.field_training, samples=samples, steps=budget.steps or 10**7)


def _samplings(config: SamplingConfig) -> list[tuple[str, SamplingConfig]]:
    """The samples of the preset, and as many at random."""
    return [("own", config), ("random", replace(config, method="random"))]


def score_trajectory(
    made: Field, trajectory: Trajectory, sampling: SamplingConfig, *, frame_count: int
) -> dict[str, float]:
    """Errors of one motion recovered from its true samples.

    Args:
        made: A trained field.
        trajectory: The motion; its first frame is the undeformed body.
        sampling: Which of its particles are known.
        frame_count: Frames that are compared, evenly spaced.

    Returns:
        ``mse`` [m^2], ``relative`` to the displacement, ``chamfer`` [m^2], and seconds a frame.
    """
    body = trajectory.position[0]
    samples = sample(body, sampling, seed=DRAW if sampling.method == "random" else None)
    start = time.perf_counter()
    decode = made.bind(body[samples], body, held=trajectory.kinematic, bounds=trajectory.bounds)
    frames = torch.linspace(1, trajectory.frame_count - 1, frame_count).round().long().unique()
    fed = range(1, trajectory.frame_count) if decode.remembers else frames.tolist()
    found = {number: decode(trajectory.position[number, samples]) for number in fed}
    seconds = (time.perf_counter() - start) / len(found)
    truth = trajectory.position[frames]
    error = _squares(torch.stack([found[n] for n in frames.tolist()]) - truth)
    chamfer = [chamfer_distance(found[n], trajectory.position[n]) for n in frames.tolist()]
    return {
        "mse": float(error.mean()),
        "relative": float((error.sum() / _squares(truth - body).sum().clamp_min(1e-300)).sqrt()),
        "chamfer": sum(chamfer) / len(chamfer),
        "seconds_per_frame": seconds,
    }


def _squares(offset: Tensor) -> Tensor:
    """Squared lengths."""
    return offset.double().square().sum(dim=-1)


def _mean(scores: list[dict[str, float]]) -> dict[str, Any]:
    """Means over trajectories, and the relative error of each."""
    means = {name: sum(s[name] for s in scores) / len(scores) for name in scores[0]}
    return means | {"per_trajectory": [s["relative"] for s in scores]}
