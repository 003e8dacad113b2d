"""``giorom inspect``: report on a data set, ours or foreign, with pictures."""

import argparse
from pathlib import Path
from typing import Any

from giorom.commands.data_source import (
    add_source,
    chosen_conversion,
    file_statistics,
    frame_progress,
    json_result,
    open_source,
    print_report,
)
from giorom.commands.shared import check_output, say
from giorom.data.atomic import replacing, write_json
from giorom.data.importing import measure_trajectories
from giorom.data.report import Origin, make_report
from giorom.data.report_text import markdown


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_source(parser)
    parser.add_argument(
        "--out", type=Path, help="folder of report and pictures; by default SOURCE/inspect"
    )
    parser.add_argument(
        "--pictures",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="draw a contact sheet and histograms (the default)",
    )


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Look at every frame, report, draw."""
    if arguments.limit is not None and arguments.limit < 1:
        raise ValueError(f"--limit must be >= 1, got {arguments.limit}.")
    conversion = chosen_conversion(arguments)
    name, read = open_source(arguments)
    out = check_output(arguments.out or _default_out(arguments.source), folder=True)
    with frame_progress(arguments, read, conversion, text="inspect") as progress:
        measure, complete = measure_trajectories(
            read(), conversion=conversion, limit=arguments.limit, progress=progress
        )
    statistics = file_statistics(arguments.source, scale=conversion.scale, axes=conversion.axes)
    origin = Origin(
        format=name,
        source=arguments.source.resolve().name,
        file_statistics=statistics,
        notes=tuple(conversion.notes()),
        complete=complete,
    )
    report = make_report(measure, origin)
    print_report(arguments, report, title=str(arguments.source))
    write_json(out / "report.json", report.as_json())
    with replacing(out / "report.md") as temporary:
        temporary.write_text(markdown(report), encoding="utf-8")
    files = [out / "report.json", out / "report.md"]
    if arguments.pictures:
        from giorom.export.inspection import draw_histograms, draw_motions

        files.append(draw_motions(measure.sheets, report.facts, out / "motions.png"))
        files.append(draw_histograms(measure, report, out / "histograms.png"))
    for path in files:
        say(arguments, f"wrote {path}")
    return json_result(report, [str(path) for path in files])


def _default_out(source: Path) -> Path:
    """Inside a folder; beside a file."""
    return source / "inspect" if source.is_dir() else source.with_name(f"{source.stem}-inspect")
