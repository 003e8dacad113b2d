"""``giorom benchmark solver``: particle-substeps per second of the material point method."""

import argparse
from pathlib import Path
from typing import Any

from giorom.commands.shared import check_output, print_table, progress_bar
from giorom.config import load_experiment
from giorom.data.atomic import replacing
from giorom.evaluation.machine import describe_machine
from giorom.evaluation.solver_speed import (
    STANDARD_POINTS,
    SpeedCase,
    measure_speed,
    standard_case,
    with_points,
)
from giorom.mpm.materials import MATERIALS
from giorom.records import nearest

MOST_PROCESSES = 256
"""Most processes side by side."""

MOST_REPEATS = 1000
"""Most timed blocks."""

HEADER = (
    "case",
    "dim",
    "particles",
    "grid",
    "processes",
    "M/s",
    "range",
    "M/CPU s",
    "us/substep",
)
"""Columns of the table; M are 10^6 particle-substeps, of all processes together but for the last
two columns, which are those of one process."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "presets", nargs="*", metavar="PRESET", help="presets; by default every material law"
    )
    parser.add_argument("--points", metavar="N,...", help="numbers of particles, about")
    parser.add_argument("--materials", metavar="LAW,...", help="some of the laws, not all")
    parser.add_argument("--dimensions", default="3,2", metavar="D,...", help="of the laws: 3, 2")
    parser.add_argument("--processes", default="1", metavar="N,...", help="runs side by side")
    parser.add_argument("--repeats", type=int, default=5, help="timed blocks of each case")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table there")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time every case with every number of processes."""
    if not 1 <= arguments.repeats <= MOST_REPEATS:
        raise ValueError(
            f"--repeats must lie between 1 and {MOST_REPEATS}, got {arguments.repeats}."
        )
    processes = _numbers("--processes", arguments.processes, most=MOST_PROCESSES)
    cases = _cases(arguments)
    if arguments.markdown is not None:
        check_output(arguments.markdown, folder=False)
    machine = describe_machine()
    rows = []
    todo = [(case, count) for case in cases for count in processes]
    with progress_bar(arguments, total=len(todo), unit="row", text="benchmark") as bar:
        for case, count in todo:
            bar.set_postfix_str(f"{case.name} {case.scene.dimension}-D x {count}")
            row = measure_speed(
                case,
                processes=count,
                repeats=arguments.repeats,
                seed=arguments.seed,
                device=arguments.device,
            )
            rows.append(row)
            bar.update()
    texts = [_texts(row) for row in rows]
    print_table(arguments, "10^6 particle-substeps per second", texts, HEADER)
    if arguments.markdown is not None:
        with replacing(arguments.markdown) as temporary:
            temporary.write_text(_markdown(texts), encoding="utf-8")
    return {
        "rows": rows,
        "machine": machine,
        "seed": arguments.seed,
        "repeats": arguments.repeats,
    }


def _cases(arguments: argparse.Namespace) -> list[SpeedCase]:
    """The presets that are named, or every law in every dimension."""
    points = None
    if arguments.points is not None:
        points = _numbers("--points", arguments.points, most=100_000_000)
    if arguments.presets:
        presets = [_preset(name) for name in arguments.presets]
        if points is None:
            return presets
        return [
            with_points(case, count, seed=arguments.seed) for case in presets for count in points
        ]
    laws = _laws(arguments.materials)
    dimensions = _numbers("--dimensions", arguments.dimensions, most=3)
    if not set(dimensions) <= set(STANDARD_POINTS):
        raise ValueError(f"--dimensions must name 2 or 3, got {arguments.dimensions}.")
    return [
        standard_case(law, dimension=dimension, points=count)
        for dimension in dimensions
        for law in laws
        for count in points or [STANDARD_POINTS[dimension]]
    ]


def _preset(name: str) -> SpeedCase:
    experiment = load_experiment(name)
    return SpeedCase(
        name=Path(name).stem,
        scene=experiment.scene,
        grid_cells=experiment.solver.grid_cells,
        frame_dt=experiment.solver.frame_dt,
        substeps=experiment.solver.substeps,
    )


def _laws(text: str | None) -> list[str]:
    laws = list(MATERIALS) if text is None else text.split(",")
    for law in laws:
        if law not in MATERIALS:
            raise ValueError(f"there is no material {law!r}. {nearest(law, MATERIALS)}")
    return laws


def _numbers(option: str, text: str, *, most: int) -> list[int]:
    """Whole numbers above zero, separated by commas."""
    words = text.split(",")
    if not all(word.isdecimal() and 1 <= int(word[:10]) <= most for word in words):
        raise ValueError(
            f"{option} takes whole numbers from 1 to {most}, separated by commas, got {text!r}."
        )
    return [int(word) for word in words]


def _texts(row: dict[str, Any]) -> tuple[str, ...]:
    """A row as it is printed."""
    rate, least, most = (
        row[f"particle_substeps_per_second{end}"] / 1e6 for end in ("", "_min", "_max")
    )
    cpu = row["particle_substeps_per_cpu_second"]
    return (
        row["case"],
        str(row["dimension"]),
        str(row["points"]),
        f"{row['grid_cells']}^{row['dimension']}",
        str(row["processes"]),
        f"{rate:.2f}",
        f"{least:.2f}-{most:.2f}",
        "-" if cpu is None else f"{cpu / 1e6:.2f}",
        f"{row['microseconds_per_substep']:.0f}",
    )


def _markdown(texts: list[tuple[str, ...]]) -> str:
    """The table in Markdown."""
    rule = ("---",) + ("---:",) * (len(HEADER) - 1)
    return "".join(f"| {' | '.join(line)} |\n" for line in (HEADER, rule, *texts))
