"""``giorom benchmark pareto``: error against time, of models and of the solver itself.

Data sets and trained models are those of ``giorom reproduce``: with the same ``--scale`` and
``--out`` nothing is made twice.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from giorom.commands.reproduce import DEVICE, make_and_write, open_study, writing
from giorom.records import nearest
from giorom.reproduce.methods import METHODS
from giorom.reproduce.pareto import run_pareto

__all__ = ["DEVICE", "add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--system", required=True, help="physical system, such as water3d")
    parser.add_argument("--scale", default="cpu", help="tiny, cpu or paper, as in giorom reproduce")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--jobs", type=int, default=1, help="processes that train; one measures")
    parser.add_argument(
        "--methods",
        metavar="NAME,...",
        help="time-steppers beside the default, of " + ", ".join(METHODS) + "; all of them",
    )


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train what is missing, measure everything and write the chart."""
    methods = _methods(arguments.methods)
    study = open_study(arguments)
    study.experiment(arguments.system)  # refuses what is no system
    make = partial(run_pareto, system=arguments.system, methods=methods)
    with writing(study):
        return make_and_write(arguments, "pareto", study, make)


def _methods(text: str | None) -> list[str]:
    """Names of the time-steppers that are asked for."""
    names = list(METHODS) if text is None else text.split(",")
    for name in names:
        if name not in METHODS:
            raise ValueError(f"there is no method {name!r}. {nearest(name, METHODS)}")
    return names
