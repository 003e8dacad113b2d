"""What a training run reads of a data set, and what follows from it before any training.

The data set is sampled, thinned and cut into windows; the graph radius, the bounds of the latent
grid, the scales and gravity are found from the training split alone.
"""

import math
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from giorom.config import Experiment
from giorom.data.statistics import Statistics, measure_statistics
from giorom.data.trajectory_file import iterate_trajectories, read_metadata, trajectory_count
from giorom.data.windows import SampledTrajectory, Windows, sample_trajectories
from giorom.graph import RadiusChoice, choose_radius
from giorom.normalization import Normalization
from giorom.sampling import sample
from giorom.state import Trajectory
from giorom.training.field_loop import thin

FALLING_FRAMES = 4
"""Frames at the start of each trajectory that say what gravity is."""

RADIUS_BODIES = 16
"""Training bodies whose connectivity decides the graph radius."""


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """What a run reads of a data set."""

    metadata: dict[str, Any]
    """Metadata of the data set."""

    choice: RadiusChoice
    """Graph radius and its reason."""

    windows: Windows
    """Training windows."""

    thinned: list[Trajectory]
    """Training trajectories for the field."""

    validation: list[SampledTrajectory]
    """Held-out trajectories, sampled as in use."""

    latent_bounds: list[list[float]]
    """Padded bounds of the training positions [m]."""


def load_training_data(experiment: Experiment, folder: Path) -> TrainingData:
    """Read, sample and thin a data set.

    Raises:
        ValueError: If the data set is unfinished, damaged, of another dimension or frame time.
    """
    metadata = read_metadata(folder)
    _check_match(experiment, metadata, folder)
    training = experiment.training
    full = _training_trajectories(folder, wanted=training.trajectories)
    if training.trajectories is not None:
        metadata |= measure_statistics(full).to_metadata()
    choice = choose_common_radius(full, experiment)
    reference = choice.radius if experiment.graph.configuration == "reference" else None
    past = experiment.features.velocities if training.straight_past else 0
    sampled = sample_trajectories(
        full,
        experiment.sampling,
        subsets=training.subsets,
        reference_radius=reference,
        kind=experiment.graph.kind,
        past=past,
    )
    validation = sample_trajectories(
        iterate_trajectories(folder, "valid"),
        experiment.sampling,
        subsets=1,
        reference_radius=reference,
        kind=experiment.graph.kind,
        past=past,
    )
    return TrainingData(
        metadata=metadata,
        choice=choice,
        windows=Windows(
            sampled,
            history=experiment.features.history,
            future=training.longest_unroll,
            starts=training.objective == "motion",
        ),
        thinned=[thin(t, experiment.field_training, seed=i) for i, t in enumerate(full)],
        validation=validation[: training.validation_trajectories],
        latent_bounds=padded_bounds(full, turned=training.turn),
    )


def _training_trajectories(folder: Path, *, wanted: int | None) -> list[Trajectory]:
    """The training split, or as many of its first trajectories as are wanted.

    Raises:
        ValueError: If there are fewer.
    """
    present = trajectory_count(folder, "train")
    if wanted is not None and wanted > present:
        raise ValueError(
            f"training.trajectories is {wanted}, but {folder} holds {present} for training. Make "
            f"more, or set it to null to use all."
        )
    return list(islice(iterate_trajectories(folder, "train"), wanted))


def choose_common_radius(trajectories: list[Trajectory], experiment: Experiment) -> RadiusChoice:
    """The largest of the radii that some training bodies ask for, or the configured one."""
    config = experiment.graph
    choices = []
    for trajectory in trajectories[:RADIUS_BODIES]:
        start = trajectory.position[0]
        samples = start[sample(start, experiment.sampling)]
        choices.append(choose_radius(samples, start, margin=config.margin))
    largest = max(choices, key=lambda choice: choice.radius)
    if config.radius is None:
        return largest
    margin = config.radius / max(largest.smallest, largest.full_radius)
    return replace(largest, radius=config.radius, margin=margin, mean_degree=math.nan)


def padded_bounds(trajectories: list[Trajectory], *, turned: bool) -> list[list[float]]:
    """Bounds of all training positions, a tenth of their extent wider on every side.

    Args:
        trajectories: Training trajectories.
        turned: Whether training turns them about the vertical axis.
    """
    low = torch.stack([t.position.amin(dim=(0, 1)) for t in trajectories]).amin(dim=0)
    high = torch.stack([t.position.amax(dim=(0, 1)) for t in trajectories]).amax(dim=0)
    if turned:
        center = trajectories[0].bounds.mean(dim=1)
        level = [axis for axis in range(len(center)) if axis != 1]
        distances = [(t.position - center)[..., level].norm(dim=2).max() for t in trajectories]
        reach = torch.stack(distances).max()
        low[level], high[level] = center[level] - reach, center[level] + reach
    pad = 0.1 * (high - low)
    return torch.stack([low - pad, high + pad], dim=1).tolist()


def fit_normalization(experiment: Experiment, metadata: dict[str, Any]) -> Normalization:
    """Scales of the training split and the training noise, in SI units."""
    frame_dt = float(metadata["dt"])
    statistics = Statistics.from_metadata(metadata).in_si(frame_dt=frame_dt)
    dimension = len(statistics.velocity_mean)
    gravity = tuple(-experiment.scene.gravity * (axis == 1) for axis in range(dimension))
    return Normalization.fit(
        velocity_mean=tuple(statistics.velocity_mean.tolist()),
        velocity_std=tuple(statistics.velocity_std.tolist()),
        acceleration_mean=tuple(statistics.acceleration_mean.tolist()),
        acceleration_std=tuple(statistics.acceleration_std.tolist()),
        noise_std=experiment.training.noise_std,
        frame_dt=frame_dt,
        isotropic=experiment.training.isotropic,
        gravity=gravity if experiment.training.explicit_gravity else None,
    )


def all_held(trajectories: list[SampledTrajectory]) -> bool:
    """Whether every body is held, so that its first acceleration says nothing about gravity."""
    return all(t.body is not None and bool(t.body.kinematic.any()) for t in trajectories)


def first_acceleration(trajectories: list[SampledTrajectory]) -> Tensor:
    """Mean acceleration of the first frames, before anything touches anything: gravity [m/s^2]."""
    found = [
        t.motion.position[: FALLING_FRAMES + 2].double().diff(n=2, dim=0).mean(dim=(0, 1))
        / t.motion.frame_dt**2
        for t in trajectories
    ]
    return torch.stack(found).median(dim=0).values.float()


def _check_match(experiment: Experiment, metadata: dict[str, Any], folder: Path) -> None:
    """Reject data that the experiment was not made for."""
    found, wanted = int(metadata["dim"]), experiment.scene.dimension
    if found != wanted:
        raise ValueError(
            f"{folder} has dim={found}, the experiment {experiment.system} expects {wanted}. Use "
            f"the preset the data were made with; for imported data, one of {found} dimensions, or "
            f"change it with --scene.dimension {found}."
        )
    frame_dt, expected = float(metadata["dt"]), experiment.solver.frame_dt
    if abs(frame_dt - expected) > 1e-6 * expected:
        raise ValueError(
            f"{folder} has dt={frame_dt:g}, the experiment {experiment.system} expects "
            f"{expected:g}. Use the preset the data were made with; for imported data, change it "
            f"with --solver.frame_dt {frame_dt!r}."
        )
