"""``giorom train``: train a field and a time-stepper."""

import argparse
from pathlib import Path
from typing import Any

from giorom.commands.shared import (
    add_experiment,
    check_output,
    chosen_experiment,
    print_table,
    progress_bar,
    say,
)
from giorom.experiment import train
from giorom.training.training_config import Budget


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_experiment(parser)
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument(
        "--max-minutes", type=float, help="longest training, reading the data set aside [min]"
    )
    parser.add_argument("--max-steps", type=int, help="most optimiser steps")
    parser.add_argument("--resume", action="store_true", help="continue the run in --out")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train within the budget and store the best simulator in ``OUT/simulator``."""
    budget = Budget(steps=arguments.max_steps, minutes=arguments.max_minutes)
    check_output(arguments.out, folder=True)
    experiment = chosen_experiment(arguments)
    with progress_bar(arguments, total=100.0, unit="%", text="read data") as bar:
        bar.bar_format = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}<{remaining} {postfix}"

        def report(stage: str, numbers: dict[str, Any]) -> None:
            if arguments.quiet:
                return
            if stage == "note":
                bar.write(numbers["text"])
                return
            if bar.desc != stage:
                bar.reset(total=100.0)
                bar.set_description_str(stage, refresh=False)
            bar.update(100.0 * numbers["progress"] - bar.n)
            shown = {"step": numbers["step"], "loss": f"{numbers['loss']:.3g}"}
            elapsed = bar.format_dict["elapsed"]
            shown["steps/s"] = f"{numbers['step'] / max(elapsed, 1e-9):.1f}"
            if "rollout_mse" in numbers:
                shown["rollout"] = f"{numbers['rollout_mse']:.2e}"
            bar.set_postfix(shown, refresh=False)

        result = train(
            experiment,
            data_folder=arguments.data,
            out=arguments.out,
            budget=budget,
            seed=arguments.seed,
            resume=arguments.resume,
            device=arguments.device,
            report=report,
        )
    static = result["history"][-1]["static_mse"] if result["history"] else float("nan")
    say(
        arguments,
        f"{arguments.out / 'simulator'}: {result['steps']} steps, {result['parameters']} + "
        f"{result['field_parameters']} parameters, best validation rollout MSE "
        f"{result['best_rollout_mse']:.3g} m^2 (holding still: {static:.3g})",
    )
    rows = [
        (goal, "not reached" if seconds is None else f"{seconds:.0f} s")
        for goal, seconds in result["time_to"].items()
    ]
    if rows:
        print_table(arguments, "training until", rows, ("validation rollout MSE", "time"))
    return result
