"""``giorom evaluate``: score a trained model on held-out trajectories."""

import argparse
from pathlib import Path
from typing import Any

from giorom.commands.shared import print_table, progress_bar
from giorom.data.atomic import write_json
from giorom.data.trajectory_file import SPLITS, iterate_trajectories, trajectory_count
from giorom.evaluation.evaluate import evaluate_trajectory, summarize
from giorom.simulator import Simulator, pretrained_directory
from giorom.version import __version__


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("model", nargs="?", help="folder of a training run or of a simulator")
    parser.add_argument("--pretrained", metavar="NAME", help="a model of the package instead")
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--split", choices=SPLITS, default="test")
    parser.add_argument("--frames", type=int, help="frames to predict; by default all")


def chosen_model(arguments: argparse.Namespace) -> str:
    """The model the arguments name."""
    if (arguments.model is None) == (arguments.pretrained is None):
        raise ValueError("give either the folder of a model or --pretrained NAME.")
    return arguments.model if arguments.pretrained is None else arguments.pretrained


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Roll out every trajectory of the split and print the means."""
    if arguments.frames is not None and arguments.frames < 1:
        raise ValueError(f"--frames must be >= 1, got {arguments.frames}.")
    name = chosen_model(arguments)
    simulator = Simulator.from_pretrained(name).to(arguments.device)
    count = trajectory_count(arguments.data, arguments.split)
    results = []
    with progress_bar(arguments, total=count, unit="trajectory", text="evaluate") as bar:
        for trajectory in iterate_trajectories(arguments.data, arguments.split):
            check_trajectory(simulator, trajectory)
            results.append(
                evaluate_trajectory(
                    simulator, trajectory.to(arguments.device), frames=arguments.frames
                )
            )
            bar.update()
    summary = summarize(results, system=simulator.config.system)
    summary |= {"split": arguments.split, "giorom": __version__, "seed": arguments.seed}
    _print(arguments, summary)
    run_folder = pretrained_directory(name).parent
    if (run_folder / "run.json").is_file():
        write_json(run_folder / "metrics.json", summary)
    return summary


def check_trajectory(simulator: Simulator, trajectory: Any) -> None:
    """Refuse data of another dimension or frame time."""
    config = simulator.config
    if trajectory.position.shape[2] != config.dimension:
        raise ValueError(
            f"the data are {trajectory.position.shape[2]}-dimensional, the model was trained in "
            f"{config.dimension} dimensions. Use a model of that dimension."
        )
    if abs(trajectory.frame_dt - config.frame_dt) > 1e-6 * config.frame_dt:
        raise ValueError(
            f"the data have a frame every {trajectory.frame_dt:g} s, the model steps "
            f"{config.frame_dt:g} s. Store the data at that interval or train another model."
        )


def _print(arguments: argparse.Namespace, summary: dict[str, Any]) -> None:
    """The table of the means."""
    if summary["sparse"] is None:
        print_table(arguments, f"all {summary['trajectories']} rollouts diverged", [], ("",))
        return
    wanted = (
        ("one-step MSE [m^2]", "one_step_mse"),
        ("rollout MSE [m^2]", "rollout_mse"),
        ("  without the given frames", "rollout_mse_without_seed_frames"),
        ("  spread over trajectories", "rollout_mse_std"),
        ("projection floor [m^2]", "projection_floor_mse"),
        ("constant velocity [m^2]", "constant_velocity_mse"),
        ("free fall [m^2]", "free_fall_mse"),
        ("holding still [m^2]", "static_mse"),
        ("relative displacement error", "relative_displacement_error"),
        ("predicted / true amplitude", "amplitude_ratio"),
        ("displacement correlation", "displacement_correlation"),
    )
    rows = []
    for label, key in wanted:
        values = [summary[where].get(key) for where in ("sparse", "full")]
        if any(value is not None for value in values):
            rows.append((label, *("" if value is None else f"{value:.3g}" for value in values)))
    title = (
        f"{summary['system']}: {summary['trajectories']} trajectories of {summary['frames']} "
        f"frames, {summary['diverged']} diverged"
    )
    header = ("", f"{summary['sparse_points']} samples", f"{summary['points']} particles")
    print_table(arguments, title, rows, header)
