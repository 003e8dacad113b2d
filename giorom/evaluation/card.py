"""The card of a pretrained model: what it is, what made it, and its scores.

Every number is copied from ``training.json`` and ``metrics.json``.
"""

import json
import math
from pathlib import Path
from typing import Any

from giorom.data.atomic import replacing
from giorom.simulator import SimulatorConfig

SCORES = (
    ("one-step MSE", "one_step_mse"),
    ("rollout MSE", "rollout_mse"),
    ("rollout MSE without the given frames", "rollout_mse_without_seed_frames"),
    ("standard deviation of the rollout MSE over trajectories", "rollout_mse_std"),
    ("projection floor", "projection_floor_mse"),
    ("constant velocity", "constant_velocity_mse"),
    ("free fall", "free_fall_mse"),
    ("holding still", "static_mse"),
    ("oracle: true centroid, frozen shape", "frozen_shape_mse"),
    ("relative displacement error", "relative_displacement_error"),
    ("predicted over true amplitude", "amplitude_ratio"),
    ("displacement correlation", "displacement_correlation"),
    ("predicted over true period", "swing_period_ratio"),
    ("Chamfer distance", "chamfer"),
    ("density difference", "density_difference"),
    ("squared sliced Wasserstein distance", "sliced_wasserstein"),
)
"""Rows of the table of scores."""


def write_card(directory: Path, config: SimulatorConfig, commands: list[str]) -> None:
    """Write ``README.md`` from the files beside it.

    Args:
        directory: Folder of the model.
        config: The model.
        commands: What makes its data, trains and scores it.
    """
    training, scores = (
        json.loads((directory / name).read_text(encoding="utf-8"))
        for name in ("training.json", "metrics.json")
    )
    text = model_card(directory.name, config, training, scores, commands=commands)
    with replacing(directory / "README.md") as temporary:
        temporary.write_text(text, encoding="utf-8")


def model_card(
    name: str,
    config: SimulatorConfig,
    training: dict[str, Any],
    scores: dict[str, Any],
    *,
    commands: list[str],
) -> str:
    """The card as Markdown.

    Args:
        name: Name of the model.
        config: The model.
        training: What ``giorom train --json`` wrote.
        scores: What ``giorom evaluate --json`` wrote.
        commands: What makes its data, trains and scores it.
    """
    return "\n".join(
        [
            f"# {name}",
            "",
            f"System {config.system}, {config.dimension}-D, a frame every "
            f"{1e3 * config.frame_dt:g} ms; {_effort(training)}",
            "",
            "Made by",
            "",
            *[f"    {command}" for command in commands],
            "",
            _origin(name, scores),
            "",
            *_table(scores),
            "",
            "Trained on synthetic data of the package's own simulator. MIT licence.",
            "",
        ]
    )


def _effort(training: dict[str, Any]) -> str:
    """Size and cost of the training."""
    history = [entry for entry in training.get("history", []) if entry.get("rollout_mse")]
    best = min(history, key=lambda entry: entry["rollout_mse"] or math.inf, default=None)
    kept = "" if best is None else f", the weights kept are those of step {best['step']}"
    place = training.get("device", "cpu")
    if place == "cpu":
        place = f"{training['threads']} CPU thread(s)"
    stopped = f" The run was stopped {training['stopped']}." if "stopped" in training else ""
    return (
        f"{training['parameters']} + {training['field_parameters']} parameters (time-stepper and "
        f"field); {training['steps']} steps in {training['seconds'] / 60.0:.0f} minutes{kept} on "
        f"{place}, seed {training['seed']}.{stopped}"
    )


def _origin(name: str, scores: dict[str, Any]) -> str:
    """Which trajectories the scores are means over."""
    held_out = scores.get("held_out")
    source = "" if held_out is None else f", made afresh with the seed {held_out['seed']}"
    again = "" if held_out is None else f" `giorom evaluate --pretrained {name}` gives them again."
    return (
        f"Means over {scores['trajectories']} held-out trajectories of {scores['frames']} "
        f"frames{source}; {scores['diverged']} diverged. MSE in m^2 (squared distance, summed over "
        f"axes).{again}"
    )


def _table(scores: dict[str, Any]) -> list[str]:
    """Scores on the samples and on all particles; empty where all rollouts diverged."""
    sparse, full = scores["sparse"] or {}, scores["full"] or {}
    lines = [
        f"| | {scores['sparse_points']} samples | {scores['points']} particles |",
        "|---|---|---|",
    ]
    for label, key in SCORES:
        values = [where.get(key) for where in (sparse, full)]
        if any(value is not None for value in values):
            shown = ["" if value is None else f"{value:.3g}" for value in values]
            lines.append(f"| {label} | {shown[0]} | {shown[1]} |")
    return lines
