"""``giorom models``: the pretrained models, their scores and the commands that make them."""

import argparse
import json
from typing import Any

from giorom.commands.shared import print_table
from giorom.simulator import PRETRAINED


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command has no options of its own."""
    parser.epilog = "Scores are those of the commands in each model's card."


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Print the index of the pretrained models."""
    models = json.loads((PRETRAINED / "index.json").read_text())["models"]
    rows = [
        (
            model["name"],
            str(model["points"]),
            str(model["sparse_points"]),
            f"{model['full_rollout_mse']:.2e}",
            f"{model['static_mse']:.2e}",
            f"{model['constant_velocity_mse']:.2e}",
        )
        for model in models
    ]
    header = (
        "model",
        "particles",
        "samples",
        "rollout MSE",
        "holding still",
        "constant velocity",
    )
    print_table(arguments, "pretrained models (MSE in m^2 on held-out bodies)", rows, header)
    return {"models": models}
