"""``giorom reproduce``: the tables and figures of the paper, at three sizes.

Data sets, trained models and scores are kept in ``OUT/shared`` and used by all of them. A command
that was stopped, however, goes on when it is given again.
"""

import argparse
import importlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from giorom.commands.shared import check_output, print_table, progress_bar, say
from giorom.data.atomic import write_json
from giorom.data.lock import only_writer
from giorom.records import nearest, one_line
from giorom.reproduce import IDS, SCALES, Result, Study
from giorom.reproduce.report import cell, write_result

DEVICE = None
"""Default of --device: the scale chooses."""

FAILURES = (ArithmeticError, ImportError, LookupError, RuntimeError, TypeError, ValueError)
"""What ends the work on one table and leaves the others to be made; a full disk ends all."""

MARK = "reproduce.json"
"""File that says what a folder of results holds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("id", help=f"{', '.join(IDS)}, or all")
    parser.add_argument(
        "--scale",
        default="cpu",
        help="tiny: shows that it works; cpu: two cores, six hours for all; paper: needs a GPU",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--jobs", type=int, default=1, help="processes of one thread each")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Make what is missing of one table or figure, or of all, and write its files."""
    ids = _chosen_ids(arguments.id)
    study = open_study(arguments)
    with writing(study):
        return _write_all(arguments, ids, study)


def _write_all(arguments: argparse.Namespace, ids: list[str], study: Study) -> dict[str, Any]:
    """Write the results of all ids; of several, one that fails does not stop the others."""
    results: list[dict[str, Any]] = []
    failures: dict[str, str] = {}
    for name in ids:
        try:
            results.append(_write_one(arguments, name, study))
        except FAILURES as error:
            if len(ids) == 1:
                raise
            failures[name] = one_line(error)
            say(arguments, f"{name} failed: {failures[name]}")
    if failures:
        found = "; ".join(f"{name}: {text}" for name, text in failures.items())
        raise RuntimeError(
            f"{len(failures)} of {len(ids)} failed, the others are in {study.out}: {found}"
        )
    if arguments.id != "all":
        return results[0]
    files = [path for result in results for path in result["files"]]
    rows = [{"id": result["id"], "rows": len(result["rows"])} for result in results]
    return {"id": "all", "scale": study.scale.name, "rows": rows, "files": files}


def _write_one(arguments: argparse.Namespace, name: str, study: Study) -> dict[str, Any]:
    """Make one result; the keys of ``--json``."""
    module = importlib.import_module(f"giorom.reproduce.{name}")
    return make_and_write(arguments, name, study, module.run)


def make_and_write(
    arguments: argparse.Namespace, name: str, study: Study, make: Callable[[Study], Result]
) -> dict[str, Any]:
    """Make a result with a bar, write its files and print its table; the keys of ``--json``.

    Args:
        arguments: Of the command.
        name: What the bar says.
        study: Where it is made.
        make: Makes it.
    """
    with progress_bar(arguments, total=0, unit="task", text=name) as bar:

        def report(text: str, done: int, total: int) -> None:
            if bar.total != total:
                bar.reset(total=total)
            bar.set_postfix_str(text, refresh=False)
            bar.update(done - bar.n)

        own = Study(
            scale=study.scale,
            out=study.out,
            seed=study.seed,
            device=study.device,
            jobs=study.jobs,
            report=report,
        )
        result = make(own)
        files = write_result(result, own)
    texts = [tuple(cell(row, column) for column in result.columns) for row in result.rows]
    print_table(arguments, result.title, texts, tuple(result.columns))
    say(arguments, f"{files[1]}: {len(result.rows)} rows")
    record = json.loads(files[-1].read_text(encoding="utf-8"))
    kept = ("id", "scale", "rows", "seeds", "machine", "training_seconds", "notes")
    return {key: record[key] for key in kept} | {"files": [str(path) for path in files]}


def _chosen_ids(name: str) -> list[str]:
    """The ids that are asked for."""
    if name == "all":
        return list(IDS)
    if name not in IDS:
        raise ValueError(f"there is no table or figure {name!r}. {nearest(name, [*IDS, 'all'])}")
    return [name]


def open_study(arguments: argparse.Namespace) -> Study:
    """The study the arguments describe; refused before anything is written."""
    if arguments.scale not in SCALES:
        raise ValueError(
            f"there is no scale {arguments.scale!r}. {nearest(arguments.scale, SCALES)}"
        )
    if arguments.jobs < 1:
        raise ValueError(f"--jobs must be >= 1, got {arguments.jobs}.")
    scale = SCALES[arguments.scale]
    device = arguments.device
    if device is None and scale.needs_gpu:
        if not torch.cuda.is_available():
            raise ValueError(
                f"--scale {scale.name} needs a CUDA device, and PyTorch finds none here. Use "
                f"--scale cpu, or give --device cpu to do it all the same, which takes months."
            )
        device = "cuda"
    check_output(arguments.out, folder=True)
    study = Study(
        scale=scale,
        out=arguments.out,
        seed=arguments.seed,
        device=device or "cpu",
        jobs=arguments.jobs,
    )
    _check_folder(study)
    return study


def _settings(study: Study) -> dict[str, Any]:
    """What all results of a folder have in common."""
    return {"scale": study.scale.name, "seed": study.seed, "device": study.device}


def _check_folder(study: Study) -> None:
    """Refuse a folder of other things, or of results of another size."""
    mark = study.out / MARK
    if not mark.is_file():
        if study.out.is_dir() and any(study.out.iterdir()):
            raise ValueError(
                f"{study.out} holds files that are no results of giorom reproduce. Choose a new or "
                f"an empty folder for --out."
            )
        return
    try:
        known = json.loads(mark.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{mark} is not readable ({one_line(error)}). Choose another --out."
        ) from None
    if known != _settings(study):
        raise ValueError(
            f"{study.out} holds results of {known}, asked for are {_settings(study)}. Choose "
            f"another --out."
        )


def _mark(study: Study) -> None:
    study.out.mkdir(parents=True, exist_ok=True)
    if not (study.out / MARK).is_file():
        write_json(study.out / MARK, _settings(study))


@contextmanager
def writing(study: Study) -> Iterator[None]:
    """Be the only one who writes to a folder; say how to go on when the work is interrupted."""
    try:
        _mark(study)
        with only_writer(study.shared):
            yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; what is finished is kept in {study.out}. Run the same command again to "
            f"go on."
        ) from None
