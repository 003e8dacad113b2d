"""Rows of an ablation: one method, one value changed in each, trained side by side.

Used by the tables and figures that train variants of one network. The errors are those of the
samples, as in the paper.
"""

import tempfile
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from safetensors.torch import save_file

from giorom.config import merged
from giorom.data.trajectory_file import write_trajectory_file
from giorom.evaluation.stage_speed import DecodeCase, StepCase, measure_decode, measure_step
from giorom.reproduce.compare import over_seeds, score_columns, with_ratio
from giorom.reproduce.rollouts import first_test_trajectory, trained_model
from giorom.reproduce.study import Study
from giorom.reproduce.trial import Trial
from giorom.reproduce.tuning import tuned
from giorom.time_stepper import TimeStepperConfig

NETWORK = "io-not-io"
"""The network whose parts are varied."""

ERRORS = {"rollout_mse": ("sparse", "rollout_mse"), "static_mse": ("sparse", "static_mse")}
"""Columns of every row: where a score is found. MSE in square metres, summed over axes."""

MORE_ERRORS = {
    "one_step_mse": ("sparse", "one_step_mse"),
    "full_rollout_mse": ("full", "rollout_mse"),
}
"""Columns of rows whose trainings are scored in full, which is three quarters of the work."""

TIMED_FRAMES = 20
"""Frames whose median is the cost of one."""

MOST_SECONDS = 60.0
"""Time after which no more frames are timed [s]."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One row: what is trained, and what the paper has for it."""

    system: str
    """Physical system."""

    labels: dict[str, Any]
    """First entries of the row: what is varied, and its value."""

    method: str = NETWORK
    """Name in ``METHODS``."""

    changes: dict[str, Any] = field(default_factory=dict)
    """Values that differ from those of the method."""

    paper: float | None = None
    """Rollout error in the paper [m^2]."""


def train_variants(
    study: Study, variants: list[Variant], *, seeds: list[int] | None = None, full: bool = False
) -> list[dict[str, Any]]:
    """Train all variants, on all processes, and make a row of each.

    Args:
        study: Where and how large.
        variants: What the rows are.
        seeds: Seeds of the trainings of each; by default those of the study.
        full: Whether single steps and all particles are scored too.

    Returns:
        Rows of labels, errors with their ranges over seeds, counts, ``paper`` and ``ratio``.
    """
    trials = trials_of(study, variants, seeds=seeds)
    study.train_all([trial for several in trials for trial in several], full=full)
    pairs = zip(variants, trials, strict=True)
    return [_row(study, variant, several, full=full) for variant, several in pairs]


def trials_of(
    study: Study, variants: list[Variant], *, seeds: list[int] | None = None
) -> list[list[Trial]]:
    """The trainings of each variant, with the learning rate and noise chosen for its method.

    What a variant changes itself, noise for one, stays as it says.

    Args:
        study: Keeps the short trainings that choose them.
        variants: What is trained.
        seeds: As in ``train_variants``.
    """
    chosen = study.seeds if seeds is None else seeds
    plain = [
        Trial(system=variant.system, method=variant.method, seed=seed, changes=variant.changes)
        for variant in variants
        for seed in chosen
    ]
    made = tuned(study, plain)
    return [made[start : start + len(chosen)] for start in range(0, len(made), len(chosen))]


def _row(study: Study, variant: Variant, trials: list[Trial], *, full: bool) -> dict[str, Any]:
    """One row, from the scores of its trainings."""
    scores = [study.scores(trial, full=full) for trial in trials]
    columns = score_columns(scores, ERRORS | (MORE_ERRORS if full else {}))
    coverage = [study.training(trial).get("latent_coverage") for trial in trials]
    row = {**variant.labels, **columns, "seeds": len(trials)}
    row |= over_seeds("coverage", coverage)
    return row | with_ratio(row["rollout_mse"], variant.paper)


def network_of(study: Study, system: str, method: str = NETWORK) -> TimeStepperConfig:
    """The network of a method as it is without changes; its grid on the unit box."""
    experiment = study.experiment(system, method)
    return experiment.time_stepper.build(
        dimension=experiment.scene.dimension,
        features=experiment.features,
        latent_bounds=[[0.0, 1.0]] * experiment.scene.dimension,
    )


def network_changes(
    study: Study, system: str, values: dict[str, Any], *, method: str = NETWORK
) -> dict[str, Any]:
    """Changes that give the network some values; none where it has them already.

    A variant that is the network itself is then the training that other tables use too.
    """
    known = asdict(network_of(study, system, method))
    different = {name: value for name, value in values.items() if known[name] != value}
    return {"time_stepper": {"overrides": different}} if different else {}


def together(*changes: dict[str, Any]) -> dict[str, Any]:
    """Several changes at once, later ones winning."""
    result: dict[str, Any] = {}
    for values in changes:
        result = merged(result, values)
    return result


def frame_cost(study: Study, trials: list[Trial], *, upscale: bool) -> dict[str, Any] | None:
    """What a frame of the first of some trainings costs that has left a model; none if none has.

    Timed on one thread, while no other task of the study is at work.

    Args:
        study: Where the models are.
        trials: Trainings of one row.
        upscale: Whether the recovery of all particles is timed too.

    Returns:
        The keys of ``stage_speed.measure_step``, ``body_points`` and, if asked for,
        ``upscale_seconds``.
    """
    for trial in trials:
        name = study.folder(trial).name
        if study.run_of(trial) is not None:
            key = {"trial": name, "frames": TIMED_FRAMES, "upscale": upscale}
            make = partial(_measure, study, trial.system, name, upscale)
            return study.kept("cost of a frame", key, make)
    return None


def _measure(study: Study, system: str, name: str, upscale: bool) -> dict[str, Any]:
    """Time frames of a model on the first test trajectory."""
    simulator, body = trained_model(study, name), first_test_trajectory(study, system)
    samples = simulator.sample(body.position[0])
    model = study.shared / "models" / name / "run" / "simulator"
    common = {"threads": 1, "device": study.device}
    with tempfile.TemporaryDirectory(prefix="giorom-cost-") as folder:
        motion, points = Path(folder) / "motion.h5", Path(folder) / "body.safetensors"
        write_trajectory_file(body.subset(samples), motion)
        step = StepCase(
            simulator=model,
            motion=motion,
            radius=None,
            steps=TIMED_FRAMES,
            seconds=MOST_SECONDS,
            **common,
        )
        cost = study.alone(measure_step, step) | {"body_points": body.position.shape[1]}
        if upscale:
            tensors = {
                "reference": body.position[0, samples],
                "query": body.position[0],
                "position": body.position[1 : TIMED_FRAMES + 1, samples],
                "bounds": body.bounds,
            }
            save_file({key: value.contiguous() for key, value in tensors.items()}, points)
            found = study.alone(measure_decode, DecodeCase(simulator=model, body=points, **common))
            cost["upscale_seconds"] = found["frame_seconds"]
    return cost
