"""What all commands share: common options, overrides, progress, results."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import yaml
from tqdm.auto import tqdm

from giorom.config import Experiment, load_experiment, merged
from giorom.data.atomic import write_json
from giorom.records import nearest


class RefusingParser(argparse.ArgumentParser):
    """A parser whose complaints are one line, like all others."""

    def error(self, message: str) -> None:
        """Refuse the arguments."""
        raise ValueError(f"{message}. See '{self.prog} --help'.")


def execute(name: str, command: ModuleType, arguments: list[str], *, description: str) -> int:
    """Parse the arguments of one command, run it and write its result.

    Args:
        name: Its name.
        command: Module with ``add_arguments(parser)`` and ``run(arguments) -> dict``.
        arguments: What was typed after the name.
        description: One line of help.
    """
    parser = RefusingParser(prog=f"giorom {name}", description=description)
    command.add_arguments(parser)
    _add_common(parser)
    parsed, rest = parser.parse_known_args(arguments)
    parsed.overrides = _overrides(rest, parser) if hasattr(parsed, "config") else {}
    if rest and not hasattr(parsed, "config"):
        raise ValueError(f"unrecognised arguments: {' '.join(rest)}. See '{parser.prog} --help'.")
    check_device(parsed.device)
    if parsed.json is not None and not parsed.json.parent.is_dir():
        raise ValueError(f"--json {parsed.json}: the folder {parsed.json.parent} does not exist.")
    if parsed.threads is not None:
        if parsed.threads < 1:
            raise ValueError(f"--threads must be >= 1, got {parsed.threads}.")
        torch.set_num_threads(parsed.threads)
    result = command.run(parsed)
    if parsed.json is not None:
        write_json(parsed.json, result)
    return 0


def add_experiment(parser: argparse.ArgumentParser) -> None:
    """Options that choose an experiment."""
    parser.add_argument("preset", nargs="?", help="name of a preset, such as elastic3d-small")
    parser.add_argument(
        "--config",
        type=Path,
        help="YAML file in place of a preset; any value is changed by --group.field value",
    )


def chosen_experiment(arguments: argparse.Namespace) -> Experiment:
    """The experiment the arguments describe."""
    if (arguments.preset is None) == (arguments.config is None):
        raise ValueError("give either the name of a preset or --config FILE.yaml.")
    name = arguments.preset if arguments.config is None else str(arguments.config)
    return load_experiment(name, arguments.overrides)


def check_device(device: str) -> None:
    """Refuse a device this machine does not have."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu.")


def progress_bar(arguments: argparse.Namespace, *, total: float, unit: str, text: str) -> tqdm:
    """A progress bar on stderr, silent with --quiet."""
    return tqdm(
        total=total, unit=unit, desc=text, disable=arguments.quiet, file=sys.stderr, leave=False
    )


def say(arguments: argparse.Namespace, text: str) -> None:
    """Print a line unless --quiet."""
    if not arguments.quiet:
        print(text, flush=True)


def print_table(
    arguments: argparse.Namespace, title: str, rows: list[tuple[str, ...]], header: tuple[str, ...]
) -> None:
    """Print a table unless --quiet."""
    if arguments.quiet:
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for number, column in enumerate(header):
        table.add_column(column, justify="left" if number == 0 else "right")
    for row in rows:
        table.add_row(*row)
    Console(soft_wrap=True).print(table)


def existing_outputs(*paths: Path) -> Callable[[], None]:
    """Make the folders of output files."""

    def make() -> None:
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)

    return make


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--seed", type=_natural, default=0, help="seed of all random draws")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, help="CPU threads of the networks")


def _natural(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2147483647, got {text}")
    return value


def _overrides(rest: list[str], parser: argparse.ArgumentParser) -> dict[str, Any]:
    """Nested values from ``--group.field value`` pairs."""
    result: dict[str, Any] = {}
    words = [part for word in rest for part in (word.split("=", 1) if "=" in word else [word])]
    if len(words) % 2 or any(not key.startswith("--") for key in words[::2]):
        raise ValueError(f"unrecognised arguments: {' '.join(rest)}. See '{parser.prog} --help'.")
    for key, text in zip(words[::2], words[1::2], strict=True):
        if "." not in key:
            options = [option for action in parser._actions for option in action.option_strings]
            raise ValueError(f"there is no option {key!r}. {nearest(key, options)}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f"{key}: {text!r} is not a value YAML can read.") from None
        for name in reversed(key.removeprefix("--").split(".")):
            value = {name: value}
        result = merged(result, value)
    return result
