"""What the package says about each of its pretrained models.

``pretrained/index.json`` holds one entry per model; every number of an entry is copied from the
``metrics.json`` and ``training.json`` beside the weights, so that nothing is typed by hand.
"""

import json
from pathlib import Path
from typing import Any

from giorom.data.atomic import write_json
from giorom.evaluation.paper import paper_values

SPARSE_SCORES = ("one_step_mse", "rollout_mse", "rollout_mse_std")
"""Scores on the samples that an entry repeats."""

FULL_SCORES = (
    "constant_velocity_mse",
    "static_mse",
    "free_fall_mse",
    "frozen_shape_mse",
)
"""Scores on all particles that an entry repeats."""


def catalogue(pretrained: Path) -> list[dict[str, Any]]:
    """The entries of the index, in the order of their names.

    Args:
        pretrained: Folder of the models.
    """
    path = pretrained / "index.json"
    if not path.is_file():
        return []
    return json.loads(path.read_text(encoding="utf-8"))["models"]


def update_catalogue(pretrained: Path, name: str, commands: list[str]) -> dict[str, Any]:
    """Write the entry of a model anew from the files beside its weights.

    Args:
        pretrained: Folder of the models.
        name: Name of the model, that of its folder.
        commands: What makes its data, trains and scores it.

    Returns:
        The entry.
    """
    entry = catalogue_entry(pretrained / name, commands)
    others = [model for model in catalogue(pretrained) if model["name"] != name]
    models = sorted([*others, entry], key=lambda model: model["name"])
    write_json(pretrained / "index.json", {"models": models})
    return entry


def catalogue_entry(directory: Path, commands: list[str]) -> dict[str, Any]:
    """The entry of a model, from ``metrics.json`` and ``training.json``.

    Scores are None where every rollout diverged.

    Args:
        directory: Folder of the model.
        commands: What makes its data, trains and scores it.
    """
    scores = json.loads((directory / "metrics.json").read_text(encoding="utf-8"))
    paper = paper_values(scores["system"])
    sparse, full = scores["sparse"] or {}, scores["full"] or {}
    return {
        "name": directory.name,
        "system": scores["system"],
        "points": scores["points"],
        "sparse_points": scores["sparse_points"],
        "frames": scores["frames"],
        "trajectories": scores["trajectories"],
        "diverged": scores["diverged"],
        "bytes": (directory / "model.safetensors").stat().st_size,
        "training": training_cost(directory),
        **{key: sparse.get(key) for key in SPARSE_SCORES},
        "full_rollout_mse": full.get("rollout_mse"),
        **{key: full.get(key) for key in FULL_SCORES},
        "paper_rollout_mse": None if paper is None else paper["rollout_mse"],
        "paper": paper,
        "commands": commands,
    }


def training_cost(directory: Path) -> dict[str, Any]:
    """What a model cost: optimiser steps, seconds and device; empty without ``training.json``."""
    path = directory / "training.json"
    if not path.is_file():
        return {}
    training = json.loads(path.read_text(encoding="utf-8"))
    kept = ("steps", "best_step", "seconds", "parameters", "field_parameters", "threads", "device")
    return {key: training[key] for key in kept if key in training}
