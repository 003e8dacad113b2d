"""``giorom simulate``: make training data with the material point method."""

import argparse
import os
from pathlib import Path
from typing import Any

from giorom.commands.shared import (
    add_experiment,
    check_output,
    chosen_experiment,
    progress_bar,
    say,
)
from giorom.generate import generate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_experiment(parser)
    parser.add_argument("--trajectories", type=int, required=True, help="number of trajectories")
    parser.add_argument("--out", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--shape", help="shape name or closed mesh file for every trajectory")
    parser.add_argument("--jobs", type=int, help="processes; by default one per core")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Make the data set; continues where an earlier call stopped."""
    if arguments.trajectories < 1:
        raise ValueError(f"--trajectories must be >= 1, got {arguments.trajectories}.")
    jobs = os.cpu_count() or 1 if arguments.jobs is None else arguments.jobs
    if jobs < 1:
        raise ValueError(f"--jobs must be >= 1, got {jobs}.")
    check_output(arguments.out, folder=True)
    experiment = chosen_experiment(arguments)
    with progress_bar(
        arguments, total=arguments.trajectories, unit="trajectory", text="simulate"
    ) as bar:

        def report(finished: int, _: int) -> None:
            bar.update(finished - bar.n)

        result = generate(
            experiment,
            folder=arguments.out,
            trajectories=arguments.trajectories,
            seed=arguments.seed,
            jobs=jobs,
            shape=arguments.shape,
            device=arguments.device,
            report=report,
        )
    splits = ", ".join(f"{count} {name}" for name, count in result["splits"].items())
    say(
        arguments,
        f"{arguments.out}: {result['trajectories']} trajectories ({splits}) of "
        f"{result['frames']} frames, up to {result['points']} particles; {result['failed']} "
        f"failed; {result['seconds']:.1f} s",
    )
    return result
