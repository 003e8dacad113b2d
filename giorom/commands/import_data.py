"""``giorom import``: make a data set of somebody else's particle motions."""

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
    report_files,
)
from giorom.commands.shared import check_output, say
from giorom.data.importing import ImportOptions, import_trajectories
from giorom.data.report import Origin


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_source(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of the data set")
    parser.add_argument(
        "--splits",
        type=float,
        nargs=2,
        metavar=("VALID", "TEST"),
        help="shares of the trajectories, in place of what the source says",
    )
    parser.add_argument(
        "--frozen-kinematic",
        action="store_true",
        help="take particles that never move for walls (type 3)",
    )
    parser.add_argument(
        "--drop-bad-trajectories",
        action="store_true",
        help="leave out trajectories that are damaged, not finite or unlike the first",
    )


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Import, report, and say how to train."""
    check_output(arguments.out, folder=True)
    conversion = chosen_conversion(arguments)
    options = ImportOptions(
        conversion=conversion,
        shares=None if arguments.splits is None else tuple(arguments.splits),
        frozen_kinematic=arguments.frozen_kinematic,
        drop_bad=arguments.drop_bad_trajectories,
        limit=arguments.limit,
    )
    name, read = open_source(arguments)
    origin = Origin(
        format=name,
        source=arguments.source.resolve().name,
        file_statistics=file_statistics(
            arguments.source, scale=conversion.scale, axes=conversion.axes
        ),
    )
    with frame_progress(arguments, read, conversion, text="import") as progress:
        report = import_trajectories(
            read(), arguments.out, options=options, origin=origin, progress=progress
        )
    print_report(arguments, report, title=f"{arguments.source} -> {arguments.out}")
    dimension = report.facts["dimension"]
    say(
        arguments,
        f"{arguments.out}: look at it with 'giorom inspect {arguments.out}', train with 'giorom "
        f"train PRESET --data {arguments.out} --out RUN --solver.frame_dt "
        f"{report.facts['frame_dt']!r}'; PRESET is one of {dimension} dimensions, such as "
        f"water{dimension}d-small",
    )
    return json_result(report, report_files(arguments.out))
