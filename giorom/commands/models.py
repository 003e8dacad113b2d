"""``giorom models``: the pretrained models, their scores and the commands that make them."""

import argparse
from typing import Any

from giorom.commands.shared import print_table, say
from giorom.evaluation.catalogue import catalogue
from giorom.simulator import PRETRAINED

SIZES = ("model", "points", "samples", "frames", "cost", "step", "rollout")
"""Columns of the first table: what it was scored on, the time of training, errors on the samples of
one step and of rollouts."""

ERRORS = ("model", "rollout", "still", "straight", "fall", "oracle", "paper")
"""Columns of the second table; errors on all particles."""

LEGEND = (
    "MSE in m^2, means over held-out scenes. still: held at the start; straight: constant velocity "
    "up to the walls; fall: the same with gravity; oracle: true centroid, frozen shape; paper: "
    "Table 1 of arXiv:2407.03925v2, measured on other bodies, sizes and numbers of frames."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command has no options of its own."""
    parser.epilog = "Scores are those of the commands in each model's card."


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Print the index of the pretrained models."""
    models = catalogue(PRETRAINED)
    sizes = [_sizes(model) for model in models]
    print_table(arguments, "pretrained models, errors on the samples", sizes, SIZES)
    print_table(arguments, "errors on all particles", [_errors(m) for m in models], ERRORS)
    say(arguments, LEGEND)
    for model in models:
        say(arguments, f"\n{model['name']} is made by")
        for command in model["commands"]:
            say(arguments, f"    {command}")
    return {"models": models}


def _sizes(model: dict[str, Any]) -> tuple[str, ...]:
    """What it was scored on, and what it cost."""
    seconds = (model.get("training") or {}).get("seconds")
    return (
        model["name"],
        *(str(model.get(key, "")) for key in ("points", "sparse_points", "frames")),
        "" if seconds is None else f"{seconds / 60.0:.0f} min",
        *(_number(model.get(key)) for key in ("one_step_mse", "rollout_mse")),
    )


def _errors(model: dict[str, Any]) -> tuple[str, ...]:
    """The model, what needs no model, and the paper."""
    keys = ("full_rollout_mse", "static_mse", "constant_velocity_mse", "free_fall_mse")
    more = ("frozen_shape_mse", "paper_rollout_mse")
    return (model["name"], *(_number(model.get(key)) for key in keys + more))


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}".replace("e-0", "e-")
