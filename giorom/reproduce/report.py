"""What a table or figure leaves behind: CSV, Markdown, JSON and a picture, each put in place whole.

The Markdown says first how the numbers came about: protocol, machine, versions, seeds, time of the
trainings.
"""

import csv
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from giorom.data.atomic import replacing, write_json
from giorom.evaluation.machine import describe_machine
from giorom.reproduce.study import Study
from giorom.reproduce.trial import finite

PEERS = ("neuraloperator", "torch_geometric", "torchdiffeq", "POT", "geomloss", "scipy")
"""Packages that some of the compared methods are made of."""

DOTS_PER_INCH = 120
"""Resolution of the pictures."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """A table with its picture."""

    id: str
    """Name of the command's argument and of the files."""

    title: str
    """What it shows."""

    columns: list[str]
    """Keys of the rows that are printed, in order; a key with ``_min`` and ``_max`` beside it is
    printed with its range over seeds, one with ``_low`` and ``_high`` with its interval."""

    rows: list[dict[str, Any]]
    """JSON values; keys that are no column go to CSV and JSON alone."""

    notes: list[str] = field(default_factory=list)
    """Sentences below the table: what the paper counts otherwise, what was left out."""

    draw: Callable[[Any], None] | None = None
    """Draws the picture on an empty matplotlib figure."""


def write_result(result: Result, study: Study) -> list[Path]:
    """Write the files of a result; the JSON last.

    Returns:
        Their paths.
    """
    base = study.out / result.id
    files = [_with(base, "csv"), _with(base, "md")]
    record = _record(result, study)
    with replacing(files[0]) as temporary:
        _write_csv(temporary, result, record)
    if result.draw is not None:
        files.append(_with(base, "png"))
        with replacing(files[-1]) as temporary:
            _draw(temporary, result.draw)
    with replacing(files[1]) as temporary:
        temporary.write_text(markdown(result, record), encoding="utf-8")
    files.append(_with(base, "json"))
    write_json(files[-1], record)
    return files


def markdown(result: Result, record: dict[str, Any]) -> str:
    """The page of a result.

    Args:
        result: Table and notes.
        record: How it came about.
    """
    parts = [f"# {result.title}", "", *_circumstances(record), ""]
    parts += [markdown_table(result.columns, result.rows), ""]
    parts += [f"* {note}" for note in result.notes]
    if result.notes:
        parts.append("")
    if result.draw is not None:
        parts += [f"![{result.title}]({result.id}.png)", ""]
    return "\n".join(parts)


def markdown_table(columns: list[str], rows: list[dict[str, Any]]) -> str:
    """Rows as a table: three digits, ranges in brackets, a dash where there is nothing."""
    head = [column.replace("_", " ") for column in columns]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell(row, column) for column in columns) + " |" for row in rows]
    return "\n".join(lines)


def cell(row: dict[str, Any], column: str) -> str:
    """One entry of a row as text."""
    text = number(row.get(column))
    for ends, pattern in ((("min", "max"), "{} ({} to {})"), (("low", "high"), "{} [{}, {}]")):
        low, high = (row.get(f"{column}_{end}") for end in ends)
        if low is not None and high is not None and low != high:
            return pattern.format(text, number(low), number(high))
    return text


def number(value: Any) -> str:
    """A value as text: three digits of what is no whole number."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        whole = value.is_integer() and abs(value) < 1e7
        return f"{value:.0f}" if whole else f"{value:.3g}"
    return str(value).replace("|", "/")


def _with(base: Path, extension: str) -> Path:
    return base.with_name(f"{base.name}.{extension}")


def _record(result: Result, study: Study) -> dict[str, Any]:
    """The result and all that has to be known about it, as JSON values."""
    machine = describe_machine()
    machine["versions"] |= {name: _version(name) for name in PEERS}
    trainings = dict(sorted(study.used.items()))
    return finite(
        {
            "id": result.id,
            "title": result.title,
            "scale": study.scale.name,
            "protocol": f"{study.scale.describe()} Rules: docs/protocol.md.",
            "seeds": study.seeds,
            "device": study.device,
            "machine": machine,
            "training_seconds": sum(t["seconds"] or 0.0 for t in trainings.values()),
            "trainings": trainings,
            "columns": result.columns,
            "rows": result.rows,
            "notes": result.notes,
        }
    )


def _circumstances(record: dict[str, Any]) -> list[str]:
    machine = record["machine"]
    versions = ", ".join(f"{name} {text}" for name, text in machine["versions"].items() if text)
    count = len(record["trainings"])
    spent = f"{count} trainings, {record['training_seconds']:.0f} s together"
    return [
        f"{record['protocol']}",
        "",
        f"{machine['processor']}, {machine['cores']} cores, {record['device']}; {versions}; seeds "
        f"{', '.join(map(str, record['seeds']))}; {spent if count else 'nothing was trained'}.",
    ]


def _write_csv(path: Path, result: Result, record: dict[str, Any]) -> None:
    """All keys of all rows, and to each row what it was made with."""
    more = {
        "scale": record["scale"],
        "seeds": " ".join(map(str, record["seeds"])),
        "giorom": record["machine"]["versions"]["giorom"],
        "machine": record["machine"]["processor"],
    }
    names = list(dict.fromkeys([*result.columns, *(key for row in record["rows"] for key in row)]))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*names, *more])
        for row in record["rows"]:
            writer.writerow([_plain(row.get(name)) for name in names] + list(more.values()))


def _plain(value: Any) -> Any:
    """A value of a row in one field of a CSV file."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "" if value is None else value


def _draw(path: Path, draw: Callable[[Any], None]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure)
    figure.savefig(path)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
