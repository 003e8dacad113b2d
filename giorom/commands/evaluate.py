"""``giorom evaluate``: score a trained model on held-out trajectories.

Without ``--data`` the trajectories are made afresh, by the functions of ``giorom simulate`` and
from the scenes that the model stores, in a temporary folder.
"""

import argparse
import os
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from giorom.commands.shared import print_table, progress_bar, say
from giorom.data.atomic import write_json
from giorom.data.trajectory_file import SPLITS, iterate_trajectories, trajectory_count
from giorom.evaluation.evaluate import evaluate_trajectory, summarize
from giorom.generate.held_out import (
    HELD_OUT_SEED,
    held_out_trajectories,
    make_held_out,
    require_unseen,
)
from giorom.simulator import Simulator, pretrained_directory
from giorom.state import Trajectory
from giorom.version import __version__

HELD_OUT_TRAJECTORIES = 10
"""Trajectories that are made where none are given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("model", nargs="?", help="folder of a training run or of a simulator")
    parser.add_argument("--pretrained", metavar="NAME", help="a model of the package instead")
    parser.add_argument(
        "--data", type=Path, help="folder of the data set; by default one is made and thrown away"
    )
    parser.add_argument("--split", choices=SPLITS, help="part of --data; by default test")
    parser.add_argument("--frames", type=int, help="frames to predict; by default all")
    parser.add_argument("--sparse", type=int, help="number of samples; by default as trained")
    group = parser.add_argument_group("without --data")
    group.add_argument(
        "--trajectories",
        type=int,
        help=f"number of fresh trajectories; by default {HELD_OUT_TRAJECTORIES}",
    )
    group.add_argument("--shape", help="shape name or closed mesh file for every fresh trajectory")
    group.add_argument("--jobs", type=int, help="processes that make them; by default one per core")


def chosen_model(arguments: argparse.Namespace) -> str:
    """The model the arguments name."""
    if (arguments.model is None) == (arguments.pretrained is None):
        raise ValueError("give either the folder of a model or --pretrained NAME.")
    return arguments.model if arguments.pretrained is None else arguments.pretrained


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Roll out every trajectory and print the means."""
    _check_arguments(arguments)
    name = chosen_model(arguments)
    simulator = Simulator.from_pretrained(name)
    if arguments.data is None:
        summary = _evaluate_fresh(arguments, simulator, name)
    else:
        split = arguments.split or "test"
        trajectories = iterate_trajectories(arguments.data, split)
        count = trajectory_count(arguments.data, split)
        summary = _evaluate(arguments, simulator, trajectories, count=count) | {"split": split}
    summary |= {"giorom": __version__, "seed": arguments.seed}
    _print(arguments, summary)
    run_folder = pretrained_directory(name).parent
    if (run_folder / "run.json").is_file():
        write_json(run_folder / "metrics.json", summary)
    return summary


def _check_arguments(arguments: argparse.Namespace) -> None:
    """Refuse numbers below one, and options of the other source of trajectories."""
    for name in ("frames", "sparse", "trajectories", "jobs"):
        value = getattr(arguments, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name} must be >= 1, got {value}.")
    others = ("split",) if arguments.data is None else ("trajectories", "shape", "jobs")
    for name in others:
        if getattr(arguments, name) is not None:
            needed = "needs --data" if arguments.data is None else "is for runs without --data"
            raise ValueError(f"--{name} {needed}. Leave one of them out.")


def _evaluate_fresh(
    arguments: argparse.Namespace, simulator: Simulator, name: str
) -> dict[str, Any]:
    """Score on trajectories that are made for it and thrown away."""
    require_unseen(pretrained_directory(name), HELD_OUT_SEED + arguments.seed)
    wanted = arguments.trajectories or HELD_OUT_TRAJECTORIES
    with tempfile.TemporaryDirectory(prefix="giorom-held-out-") as temporary:
        folder = Path(temporary) / "data"
        say(
            arguments,
            f"no --data: making {wanted} trajectories with the seed "
            f"{HELD_OUT_SEED + arguments.seed} in {folder}, which is removed afterwards",
        )
        with progress_bar(arguments, total=0, unit="frame", text="simulate") as bar:
            made = make_held_out(
                simulator.config,
                folder=folder,
                trajectories=wanted,
                seed=arguments.seed,
                frames=arguments.frames,
                shape=arguments.shape,
                jobs=arguments.jobs or os.cpu_count() or 1,
                device=arguments.device,
                report=_follow(bar),
            )
        trajectories, count = held_out_trajectories(folder), made["trajectories"]
        summary = _evaluate(arguments, simulator, trajectories, count=count)
    kept = ("trajectories", "frames", "points", "seed", "failed", "failures")
    return summary | {"held_out": {key: made[key] for key in kept} | {"shape": arguments.shape}}


def _follow(bar: Any) -> Callable[[int, int], None]:
    """Progress in frames on a bar whose length is known later."""

    def report(done: int, wanted: int) -> None:
        bar.total = wanted
        bar.update(done - bar.n)

    return report


def _evaluate(
    arguments: argparse.Namespace,
    simulator: Simulator,
    trajectories: Iterable[Trajectory],
    *,
    count: int,
) -> dict[str, Any]:
    """Mean scores over trajectories."""
    simulator = simulator.to(arguments.device)
    results = []
    with progress_bar(arguments, total=count, unit="trajectory", text="evaluate") as bar:
        for trajectory in trajectories:
            check_trajectory(simulator, trajectory)
            results.append(
                evaluate_trajectory(
                    simulator,
                    trajectory.to(arguments.device),
                    frames=arguments.frames,
                    sparse_points=arguments.sparse,
                )
            )
            bar.update()
    return summarize(results, system=simulator.config.system)


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
        ("constant velocity, stopped at walls [m^2]", "constant_velocity_mse"),
        ("free fall, stopped at walls [m^2]", "free_fall_mse"),
        ("holding still [m^2]", "static_mse"),
        ("oracle: true centroid, frozen shape [m^2]", "frozen_shape_mse"),
        ("relative displacement error", "relative_displacement_error"),
        ("predicted / true amplitude", "amplitude_ratio"),
        ("displacement correlation", "displacement_correlation"),
        ("predicted / true period", "swing_period_ratio"),
        ("final centroid error [m]", "final_centroid_error"),
        ("final bounding box error [m]", "final_bounding_box_error"),
        ("Chamfer distance [m^2]", "chamfer"),
        ("density difference", "density_difference"),
        ("sliced Wasserstein, squared [m^2]", "sliced_wasserstein"),
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
