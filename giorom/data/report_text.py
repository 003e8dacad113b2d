"""The report of a data set as tables for people: on the screen and as Markdown."""

from typing import Any

from giorom.data.report import Report

__all__ = ["markdown", "overview_rows", "statistics_rows"]

TYPES = {
    "0": "rigid",
    "3": "kinematic",
    "4": "plasticine",
    "5": "water",
    "6": "sand",
    "7": "goop",
    "8": "elastic",
}
"""Words for particle types (GNS convention; 4 and 8 are ours)."""

STATISTICS = (
    ("velocity mean", "vel_mean"),
    ("velocity deviation", "vel_std"),
    ("acceleration mean", "acc_mean"),
    ("acceleration deviation", "acc_std"),
)


def overview_rows(report: Report) -> list[tuple[str, str]]:
    """What was found, a label and a value each."""
    facts = report.facts
    splits = ", ".join(f"{count} {name}" for name, count in facts["splits"].items() if count)
    frame_dt = "not known" if facts["frame_dt"] is None else f"{facts['frame_dt']:g} s"
    gravity = facts["gravity"]
    return [
        ("format", facts["format"]),
        ("trajectories", f"{facts['trajectories']}" + (f" ({splits})" if splits else "")),
        ("particles (least, mean, most)", _three(facts)),
        ("types", _types(facts)),
        ("kinematic", f"{facts['kinematic']}, of which {facts['moving_kinematic']} move"),
        ("frames", _range(facts["frames"], facts["frames_max"])),
        ("time between frames", frame_dt),
        ("bounds [m]" + ("" if facts["bounds_given"] else " (not given)"), _box(facts["bounds"])),
        ("particles reach [m]", _box(facts["extent"])),
        ("gravity [m/s^2]", "not known" if gravity is None else _vector(gravity)),
        ("units", facts["units"]),
        ("particle identity", facts["identity"]),
        ("spacing [m]", f"{facts['spacing']:.4g}"),
        ("largest step in one frame", _step(facts["largest_step"])),
        ("frozen, duplicate, not finite", _oddities(facts)),
        ("suggested samples and radius", _suggested(facts["suggested"])),
    ]


def statistics_rows(report: Report) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and rows of the statistics: measured, in SI, of the file, of published sets."""
    statistics = report.facts["statistics"]
    columns = [("per frame", statistics), ("per second", statistics.get("si"))]
    if not _agree(statistics, statistics.get("file")):
        columns.append(("in the file", statistics.get("file")))
    columns += [(row["name"], row["statistics"]) for row in report.facts["published"]]
    known = [(title, values) for title, values in columns if values]
    header = ("", *(title for title, _ in known))
    rows = [(label, *(_vector(values[key]) for _, values in known)) for label, key in STATISTICS]
    return header, rows if known else []


def _agree(measured: dict[str, Any], file: dict[str, Any] | None) -> bool:
    """Whether the file says what was measured, so that its numbers need no column."""
    if not file or not measured or len(file["acc_std"]) != len(measured["acc_std"]):
        return False
    pairs = [
        (a, b)
        for key in ("vel_std", "acc_std")
        for a, b in zip(measured[key], file[key], strict=True)
    ]
    return all(abs(a - b) <= 1e-3 * abs(b) for a, b in pairs)


def markdown(report: Report) -> str:
    """The whole report as a Markdown page."""
    header, rows = statistics_rows(report)
    lines = [f"# {report.facts['source']}", "", *_table(("", ""), overview_rows(report))]
    if rows:
        lines += ["", "## Statistics", "", *_table(header, rows)]
    lines += ["", "## Suspicious", "", *_listed(report.suspicious)]
    lines += ["", "## Notes", "", *_listed(report.notes)]
    return "\n".join(lines) + "\n"


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


def _listed(texts: list[str]) -> list[str]:
    return [f"- {text}" for text in texts] or ["Nothing."]


def _three(facts: dict[str, Any]) -> str:
    if facts["points_min"] == facts["points"]:
        return f"{facts['points']}"
    return f"{facts['points_min']}, {facts['points_mean']:g}, {facts['points']}"


def _range(low: int, high: int) -> str:
    return f"{low}" if low == high else f"{low} to {high}"


def _types(facts: dict[str, Any]) -> str:
    return ", ".join(
        f"{count} of {kind} ({TYPES.get(kind, 'no name')})"
        for kind, count in facts["types"].items()
    )


def _box(box: list[list[float | None]] | None) -> str:
    if box is None:
        return "not known"
    return " x ".join("..".join("?" if v is None else f"{v:.4g}" for v in pair) for pair in box)


def _vector(values: list[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _step(step: dict[str, Any]) -> str:
    text = f"{step['metres']:.3g} m"
    if step["over_radius"] is not None:
        text += f" = {step['over_radius']:.2g} radii"
    if step["over_spacing"] is not None:
        text += f" = {step['over_spacing']:.2g} spacings"
    return f"{text} ({step['trajectory']}, frame {step['frame']}, particle {step['particle']})"


def _oddities(facts: dict[str, Any]) -> str:
    return f"{facts['frozen']}, {facts['duplicates']}, {facts['not_finite']}"


def _suggested(suggested: dict[str, Any]) -> str:
    if suggested["radius"] is None:
        return suggested["why"]
    return (
        f"{suggested['sparse_points']} samples, {suggested['radius']:.4g} m, "
        f"{suggested['neighbors']:.1f} neighbours each"
    )
