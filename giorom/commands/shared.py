"""What all commands share: common options, overrides, progress, results."""

import argparse
import dataclasses
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import yaml
from tqdm.auto import tqdm

from giorom.config import Experiment, load_experiment, merged
from giorom.data.atomic import write_json
from giorom.records import nearest

MOST_THREADS = 1024
"""Most threads asked of PyTorch; far more than it can start end the process without a word."""


GROUPS = frozenset(field.name for field in dataclasses.fields(Experiment))
"""Groups of an experiment, which an option can replace as a whole."""

MOST_NAME_BYTES = 200
"""Longest name of an output; the file systems take 255, of which temporary names need some."""

NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")
"""What is a value and no option; argparse before Python 3.14 takes ``-1e-3`` for an option."""


class RefusingParser(argparse.ArgumentParser):
    """A parser whose complaints are one line, like all others, and that knows ``-1e-3``."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = NEGATIVE_NUMBER

    def error(self, message: str) -> None:
        """Refuse the arguments."""
        raise ValueError(f"{message}. See '{self.prog} --help'.")


def execute(name: str, command: ModuleType, arguments: list[str], *, description: str) -> int:
    """Parse the arguments of one command, run it and write its result.

    Args:
        name: Its name.
        command: Module with ``add_arguments(parser)`` and ``run(arguments) -> dict``; its constant
            ``DEVICE``, if it has one, is the default of ``--device``.
        arguments: What was typed after the name.
        description: One line of help.
    """
    parser = RefusingParser(prog=f"giorom {name}", description=description)
    command.add_arguments(parser)
    _add_common(parser, device=vars(command).get("DEVICE", "cpu"))
    changes: list[tuple[str, str]] = []
    if _takes_overrides(parser):
        arguments, changes = _split_overrides(arguments)
    try:
        parsed, rest = parser.parse_known_args(arguments)
    except SystemExit:  # argparse's way to end after --help
        return 0
    _refuse_unknown(rest, parser)
    parsed.overrides = _overrides(changes)
    check_device(parsed.device)
    if parsed.json is not None:
        check_output(parsed.json, folder=False)
        if not parsed.json.parent.is_dir():
            raise ValueError(
                f"--json {parsed.json}: the folder {parsed.json.parent} does not exist."
            )
    if parsed.threads is not None:
        if parsed.threads < 1:
            raise ValueError(f"--threads must be >= 1, got {parsed.threads}.")
        if parsed.threads > MOST_THREADS:
            raise ValueError(f"--threads must be <= {MOST_THREADS}, got {parsed.threads}.")
        torch.set_num_threads(parsed.threads)
    with _terminated_as_interrupted():
        result = command.run(parsed)
    if parsed.json is not None:
        write_json(parsed.json, result)
    return 0


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Clean up also when a batch system ends the process with SIGTERM."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread hears signals
        return

    def stop(number: int, _: Any) -> None:
        raise KeyboardInterrupt(f"signal {number}")

    earlier = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, earlier)


def add_experiment(parser: argparse.ArgumentParser) -> None:
    """Options that choose an experiment."""
    parser.add_argument(
        "preset",
        nargs="?",
        help="name of a preset, such as elastic3d-small; +paper behind it trains as the paper does",
    )
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


def check_device(device: str | None) -> None:
    """Refuse a device this machine does not have."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device here; use --device cpu.")


def progress_bar(
    arguments: argparse.Namespace, *, total: float | int | None, unit: str, text: str
) -> tqdm:
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
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    # Without vertical lines seven columns of numbers fit a screen of 80 characters.
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for number, column in enumerate(header):
        first = number == 0
        table.add_column(column, justify="left" if first else "right", no_wrap=first)
    for row in rows:
        table.add_row(*row)
    Console(soft_wrap=True, markup=False, highlight=False).print(table)


def check_output(path: Path, *, folder: bool) -> Path:
    """Refuse an output that cannot be written, before any work is done for it.

    Args:
        path: File or folder to write.
        folder: Whether it is to be a folder.
    """
    try:
        os.lstat(path)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        if not isinstance(error, NotADirectoryError):
            raise ValueError(f"{str(path)[:200]!r} cannot be written ({error}).") from None
    if path.is_symlink() and not os.path.exists(path):
        raise ValueError(f"{path} is a link that leads nowhere. Remove it or name another place.")
    if len(os.fsencode(path.name)) > MOST_NAME_BYTES:
        raise ValueError(
            f"the name {path.name[:40]!r} ... has {len(os.fsencode(path.name))} bytes; temporary "
            f"names need room, so that at most {MOST_NAME_BYTES} are taken. Shorten it."
        )
    if path.exists() and not (path.is_dir() or path.is_file()):
        raise ValueError(f"{path} is a device or a pipe, which would be replaced. Name a file.")
    if path.exists() and path.is_dir() != folder:
        kind, other = ("folder", "file") if folder else ("file", "folder")
        raise ValueError(f"{path} is to be a {kind}, but there is a {other} of that name.")
    above = next((parent for parent in path.parents if parent.exists()), None)
    if above is not None and not above.is_dir():
        raise ValueError(f"{path} cannot be made: {above} is a file, not a folder.")
    effective = os.access in os.supports_effective_ids
    if above is not None and not os.access(above, os.W_OK, effective_ids=effective):
        raise ValueError(f"{path} cannot be made: {above} does not let you write into it.")
    return path


def _add_common(parser: argparse.ArgumentParser, *, device: str | None) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--seed", type=_natural, default=0, help="seed of all random draws")
    parser.add_argument("--device", choices=("cpu", "cuda"), default=device)
    parser.add_argument("--threads", type=int, help="CPU threads of the networks")


def _natural(text: str) -> int:
    value = int(text) if text.isdecimal() else -1
    if not 0 <= value < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2147483647, got {text}")
    return value


def _options(parser: argparse.ArgumentParser) -> list[str]:
    return [option for action in parser._actions for option in action.option_strings]


def _takes_overrides(parser: argparse.ArgumentParser) -> bool:
    return "--config" in _options(parser)


def _refuse_unknown(rest: list[str], parser: argparse.ArgumentParser) -> None:
    """Name the option that is nearest to an unknown one."""
    for word in rest:
        option = word.split("=", 1)[0]
        if option.startswith("--") and "." not in option:
            raise ValueError(f"there is no option {option!r}. {nearest(option, _options(parser))}")
    if rest:
        raise ValueError(f"unrecognised arguments: {' '.join(rest)}. See '{parser.prog} --help'.")


def _split_overrides(arguments: list[str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Part ``--group.field value``, with ``=`` or of a whole group, from the other arguments.

    argparse does not know these options and would take their values for the name of a preset.
    """
    others, changes, words = [], [], iter(arguments)
    for word in words:
        key, equals, value = word.partition("=")
        group = key.removeprefix("--").split(".")[0] in GROUPS
        if not key.startswith("--") or not ("." in key or group):
            others.append(word)
            continue
        text = value if equals else next(words, None)
        if text is None or text.startswith("--"):
            raise ValueError(f"{key} needs a value.")
        changes.append((key, text))
    return others, changes


def _overrides(changes: list[tuple[str, str]]) -> dict[str, Any]:
    """Nested values from dotted names and YAML texts."""
    result: dict[str, Any] = {}
    for key, text in changes:
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f"{key}: {text!r} is not a value YAML can read.") from None
        for name in reversed(key.removeprefix("--").split(".")):
            value = {name: value}
        result = merged(result, value)
    return result
