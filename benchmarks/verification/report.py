"""Write what the benchmarks gave: one figure each, ``results.json`` and ``README.md``.

Results of a case replace those of an earlier run of it and leave the other cases alone.
"""

import json
import math
import platform
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.verification.case import Row
from benchmarks.verification.cases import CASES

FIGURE_DPI = 100
COMMAND = "python -m benchmarks.verification --out docs/verification"

HEAD = """# Verification of the simulator

Each case runs the material point solver on a problem whose answer is known: a closed form, a
conservation law or a published experiment. Written by

    {command}

in {minutes:.0f} minutes of processor time on one machine ({machine}; {versions}).
One case:
`--case NAME`; smaller: `--quick`. The same functions run at reduced size in `tests/verification`.
Everything random has the seed 0. A deviation is relative unless its tolerance has no per cent sign.
Scalings of experiments are those commonly cited, the papers were not at hand; the table of Martin
and Moyce is that used by other solvers and agrees with PySPH's digitisation of their figure to 0.1.

{passed} of {count} quantities are within their tolerance{missed}

"""

COLUMNS = ("quantity", "measured", "reference", "deviation", "tolerance", "within", "grid")


def run_case(name: str, out: str, quick: bool) -> dict[str, Any]:
    """Run one case, write its figure and return its results as JSON values.

    Args:
        name: Key of ``CASES``.
        out: Folder of the report.
        quick: Whether to run the reduced size.
    """
    case = CASES[name]
    start = time.process_time()
    outcome = case.measure(quick=quick)
    seconds = time.process_time() - start
    case.draw(outcome).savefig(Path(out) / f"{name}.png", dpi=FIGURE_DPI)
    return {
        "case": name,
        "quick": quick,
        "seconds": round(seconds, 1),
        "seed": 0,
        "rows": [row_values(row) for row in outcome.rows],
        **machine(),
    }


def row_values(row: Row) -> dict[str, Any]:
    """A row as JSON values."""
    return {
        "quantity": row.quantity,
        "measured": float(f"{row.measured:.6g}"),
        "reference": float(f"{row.reference:.6g}"),
        "source": row.source,
        "deviation": float(f"{row.deviation:.4g}"),
        "absolute": row.absolute,
        "tolerance": row.tolerance,
        "passed": bool(row.passed),
        "grid_cells": row.grid_cells,
        "particles": row.particles,
        "note": row.note,
    }


def machine() -> dict[str, Any]:
    """Processor and versions behind a measurement."""
    packages = ("numpy", "torch", "warp-lang")
    versions = {"python": platform.python_version()}
    versions |= {package: metadata.version(package) for package in packages}
    return {"processor": processor(), "versions": versions}


def processor() -> str:
    """Model name of the processor."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def update(out: Path, results: list[dict[str, Any]]) -> None:
    """Merge new results into ``results.json`` and write ``README.md`` from it."""
    path = out / "results.json"
    known = json.loads(path.read_text())["cases"] if path.is_file() else {}
    known |= {result["case"]: result for result in results}
    ordered = {name: known[name] for name in CASES if name in known}
    path.write_text(json.dumps({"cases": ordered}, indent=1) + "\n")
    (out / "README.md").write_text(page(ordered))


def page(results: dict[str, dict[str, Any]]) -> str:
    """The report as Markdown."""
    rows = [row for result in results.values() for row in result["rows"]]
    passed = sum(row["passed"] for row in rows)
    last = next(iter(results.values()))
    missed = (
        "." if passed == len(rows) else "; the others are marked **no**, with the reason below."
    )
    text = HEAD.format(
        command=COMMAND,
        minutes=sum(result["seconds"] for result in results.values()) / 60.0,
        machine=last["processor"],
        versions=", ".join(f"{name} {version}" for name, version in last["versions"].items()),
        passed=passed,
        count=len(rows),
        missed=missed,
    )
    return text + "\n".join(section(result) for result in results.values())


def section(result: dict[str, Any]) -> str:
    """One case: what was done, the figure, the numbers, their sources."""
    case = CASES[result["case"]]
    lines = [f"## {case.title}", "", case.method, "", f"![{case.title}]({case.name}.png)", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in result["rows"]]
    sources = dict.fromkeys(row["source"] for row in result["rows"])
    lines += ["", f"References: {'; '.join(sources)}."]
    notes = [f"* {row['quantity']}: {row['note']}." for row in result["rows"] if row["note"]]
    lines += ["", *notes] if notes else []
    lines += ["", *case.remarks] if case.remarks else []
    size = "reduced size, " if result["quick"] else ""
    lines += ["", f"`--case {case.name}`: {size}{result['seconds']:.0f} s of one core.", ""]
    return "\n".join(lines)


def cells(row: dict[str, Any]) -> list[str]:
    """One row of the table."""
    deviation = row["deviation"]
    shown = f"{deviation:+.3g}" if row["absolute"] else f"{100.0 * deviation:+.3g} %"
    if math.isclose(deviation, 0.0, abs_tol=1e-12):
        shown = "0"
    return [
        row["quantity"].replace("|", "\\|"),
        f"{row['measured']:.4g}",
        f"{row['reference']:.4g}",
        shown,
        row["tolerance"],
        "yes" if row["passed"] else "**no**",
        f"{row['grid_cells']}, {row['particles']} particles",
    ]
