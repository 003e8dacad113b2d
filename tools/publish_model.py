"""Put a trained simulator into the package, with its card and its line in the index.

    python tools/publish_model.py NAME RUN --train train.json --evaluate metrics.json \
        --data data --command "giorom simulate ..." --command "giorom train ..."

The numbers of the card are those of the JSON files that ``giorom train --json`` and
``giorom evaluate --json`` wrote; nothing is typed by hand.
"""

import argparse
import json
import platform
import shutil
import sys
from pathlib import Path
from typing import Any

from giorom.data.atomic import replacing_folder
from giorom.data.metadata import read_metadata
from giorom.evaluation.catalogue import update_catalogue
from giorom.simulator import PRETRAINED, Simulator, pretrained_directory

SIZE_LIMIT = 5_000_000
"""Largest model file of the package [bytes]."""

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


def main() -> int:
    """Copy, check, write card and index."""
    arguments = _parse()
    simulator = Simulator.from_pretrained(arguments.run)
    trained = json.loads(arguments.train.read_text())
    scores = json.loads(arguments.evaluate.read_text())
    target = PRETRAINED / arguments.name
    size = (pretrained_directory(arguments.run) / "model.safetensors").stat().st_size
    if size > SIZE_LIMIT:
        sys.stderr.write(
            f"{arguments.run} has {size} bytes of weights; a model of the package may have "
            f"{SIZE_LIMIT}. Train a smaller network.\n"
        )
        return 2
    with replacing_folder(target) as directory:
        simulator.save_pretrained(directory)
        card = _card(arguments.name, simulator, trained, scores, arguments.command)
        (directory / "README.md").write_text(card)
        shutil.copy(arguments.evaluate, directory / "metrics.json")
        record = trained | _machine() | {"data_seed": read_metadata(arguments.data).get("seed")}
        (directory / "training.json").write_text(json.dumps(record, indent=1) + "\n")
    update_catalogue(PRETRAINED, arguments.name, arguments.command)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name")
    parser.add_argument("run", type=Path)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--evaluate", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="the training data")
    parser.add_argument("--command", action="append", default=[])
    return parser.parse_args()


def _card(
    name: str,
    simulator: Simulator,
    trained: dict[str, Any],
    scores: dict[str, Any],
    commands: list[str],
) -> str:
    """The model card."""
    config = simulator.config
    rows = [
        f"| | {scores['sparse_points']} samples | {scores['points']} particles |",
        "|---|---|---|",
    ]
    for label, key in SCORES:
        values = [scores[where].get(key) for where in ("sparse", "full")]
        shown = ["" if value is None else f"{value:.3g}" for value in values]
        rows.append(f"| {label} | {shown[0]} | {shown[1]} |")
    best = min(trained["history"], key=lambda entry: entry["rollout_mse"] or float("inf"))
    steps = (
        f"{trained['steps']} steps in {trained['seconds'] / 60.0:.0f} minutes, the weights kept "
        f"are those of step {best['step']}"
    )
    stopped = f" The run was stopped {trained['stopped']}." if "stopped" in trained else ""
    return "\n".join(
        [
            f"# {name}",
            "",
            f"System {config.system}, {config.dimension}-D, a frame every "
            f"{1e3 * config.frame_dt:g} ms; {trained['parameters']} + "
            f"{trained['field_parameters']} parameters (time-stepper and field); {steps} on "
            f"{trained['threads']} CPU thread(s), seed {trained['seed']}.{stopped}",
            "",
            "Made by",
            "",
            *[f"    {command}" for command in commands],
            "",
            f"Means over {scores['trajectories']} held-out trajectories of {scores['frames']} "
            f"frames, {scores['diverged']} diverged; MSE in m^2 (squared distance, summed over "
            f"axes).",
            "",
            *rows,
            "",
            "Trained on synthetic data of the package's own simulator. MIT licence.",
            "",
        ]
    )


def _machine() -> dict[str, str]:
    """What the numbers were made on."""
    return {"python": platform.python_version(), "processor": platform.machine()}


if __name__ == "__main__":
    sys.exit(main())
