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
from giorom.generate import Cluster, generate

EXECUTORS = {"local": None, "slurm": "slurm", "submitit-local": "local"}
"""Values of --executor and the executors of submitit they stand for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_experiment(parser)
    parser.add_argument("--trajectories", type=int, required=True, help="number of trajectories")
    parser.add_argument("--out", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--shape", help="shape name or closed mesh file for every trajectory")
    parser.add_argument("--jobs", type=int, help="processes; by default one per core, on a GPU one")
    parser.add_argument(
        "--executor",
        choices=tuple(EXECUTORS),
        default="local",
        help="local: processes here; slurm: a job array; submitit-local: the same path, tried here",
    )
    group = parser.add_argument_group("slurm")
    group.add_argument("--chunk", type=int, default=8, help="trajectories of one task")
    group.add_argument("--slurm-partition", metavar="NAME")
    group.add_argument("--slurm-account", metavar="NAME")
    group.add_argument("--slurm-time", type=int, default=240, metavar="MINUTES")
    group.add_argument("--slurm-memory", type=int, default=4, metavar="GIB")
    group.add_argument("--slurm-parallel", type=int, default=256, help="most tasks at a time")
    group.add_argument("--no-wait", action="store_true", help="send the work and end")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Make the data set; continues where an earlier call stopped."""
    if arguments.trajectories < 1:
        raise ValueError(f"--trajectories must be >= 1, got {arguments.trajectories}.")
    jobs = arguments.jobs
    if jobs is None:
        jobs = os.cpu_count() or 1 if arguments.device == "cpu" else 1
    if jobs < 1:
        raise ValueError(f"--jobs must be >= 1, got {jobs}.")
    cluster = _cluster(arguments)
    check_output(arguments.out, folder=True)
    experiment = chosen_experiment(arguments)
    with progress_bar(arguments, total=0, unit="frame", text="simulate") as bar:

        def report(done: int, wanted: int) -> None:
            if bar.total != wanted:  # what is there already says nothing about the speed
                bar.total, bar.initial = wanted, done
            bar.update(done - bar.n)

        result = generate(
            experiment,
            folder=arguments.out,
            trajectories=arguments.trajectories,
            seed=arguments.seed,
            jobs=jobs,
            shape=arguments.shape,
            device=arguments.device,
            report=report,
            cluster=cluster,
            announce=lambda line: say(arguments, line),
        )
    _say_result(arguments, result)
    return result


def _cluster(arguments: argparse.Namespace) -> Cluster | None:
    kind = EXECUTORS[arguments.executor]
    if kind is None:
        if arguments.no_wait:
            raise ValueError("--no-wait needs --executor slurm.")
        return None
    return Cluster(
        kind=kind,
        chunk=arguments.chunk,
        minutes=arguments.slurm_time,
        memory_gib=arguments.slurm_memory,
        partition=arguments.slurm_partition,
        account=arguments.slurm_account,
        parallel=arguments.slurm_parallel,
        wait=not arguments.no_wait,
    )


def _say_result(arguments: argparse.Namespace, result: dict[str, Any]) -> None:
    if result["splits"] is None:
        return  # the line about what was sent has said it
    splits = ", ".join(f"{count} {name}" for name, count in result["splits"].items())
    more = f" (see {arguments.out / 'failures.json'})" if result["failed"] else ""
    say(
        arguments,
        f"{arguments.out}: {result['trajectories']} trajectories ({splits}) of "
        f"{result['frames']} frames, up to {result['points']} particles; {result['failed']} "
        f"failed{more}; {result['seconds']:.1f} s",
    )
