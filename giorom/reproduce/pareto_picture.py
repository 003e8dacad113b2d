"""The picture of error against time, and of what many rollouts cost."""

from typing import Any

from giorom.evaluation.tradeoff import front
from giorom.reproduce.drawing import OTHERS, OURS, PAPER

SOLVER = "#1b7837"
"""Colour of the solver."""

MOST_ROLLOUTS = 100_000
"""End of the axis of rollouts."""

LABELS = 6
"""Most peers that are named in the picture; the table has all."""


def draw_pareto(
    figure: Any, *, rows: list[dict[str, Any]], floor: float | None, frames: int
) -> None:
    """Error against time on the left, total time against rollouts on the right.

    Args:
        figure: An empty matplotlib figure.
        rows: The rows of the table.
        floor: Noise floor [m^2].
        frames: Frames of a rollout.
    """
    figure.set_size_inches(12.0, 5.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
    _draw_errors(left, rows, floor)
    _draw_totals(right, rows, frames)
    for panel in (left, right):
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.grid(color="0.92")
        panel.set_axisbelow(True)
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)


def _draw_errors(panel: Any, rows: list[dict[str, Any]], floor: float | None) -> None:
    points = [(row["full_rollout_mse"], row["seconds_per_frame"]) for row in _front_rows(rows)]
    line = front(points)
    panel.step(
        [1e3 * seconds for _, seconds in line],
        [error for error, _ in line],
        where="post",
        color="0.35",
        linewidth=1.0,
        label="front",
    )
    groups = {
        "ours": (_of(rows, lambda r: r["name"] == "default"), OURS, "o-"),
        "solver, largest stable steps": (_solver(rows, "largest"), SOLVER, "s"),
        "solver, steps by its rules": (_solver(rows, "rules"), SOLVER, "x"),
        "full-order solver": (_of(rows, lambda r: r["kind"] == "truth"), SOLVER, "*"),
        "other models": (_of(rows, _is_peer), OTHERS, "^"),
    }
    for label, (members, color, style) in groups.items():
        if members:
            ordered = sorted(members, key=lambda row: row["seconds_per_frame"])
            panel.plot(
                [1e3 * row["seconds_per_frame"] for row in ordered],
                [row["full_rollout_mse"] for row in ordered],
                style,
                color=color,
                markersize=10 if style == "*" else 5,
                linewidth=0.8,
                label=label,
            )
    for number, row in enumerate(_named(rows)):
        place = (1e3 * row["seconds_per_frame"], row["full_rollout_mse"])
        offset = (4, 4 if number % 2 == 0 else -9)
        panel.annotate(_label(row), place, offset, textcoords="offset points", fontsize=7)
    if floor:
        panel.axhline(floor, color=PAPER, linestyle="--", linewidth=1.0, label="noise floor")
    still = [row["full_rollout_mse"] for row in rows if row["name"] == "static"]
    for error in still:
        panel.axhline(error, color=PAPER, linestyle=":", linewidth=1.0, label="holding still")
    panel.set_xlabel("time of a frame [ms]", fontsize=9)
    panel.set_ylabel("full-order rollout MSE [m²]", fontsize=9)
    panel.legend(fontsize=7, loc="best", framealpha=0.9)


def _draw_totals(panel: Any, rows: list[dict[str, Any]], frames: int) -> None:
    """Data, training and rollouts together, of ours and of the solver at the error of ours."""
    ours = [row for row in rows if row["name"] == "default" and row.get("share") == 1.0]
    counts = [10 ** (exponent / 8) for exponent in range(41)]
    lines = []
    for row in ours:
        if row.get("solver_seconds_per_frame") is None:
            continue
        lines.append(("ours", OURS, "-", row["upfront_seconds"], row["seconds_per_frame"]))
        solver = row["solver_seconds_per_frame"]
        lines.append(("solver at the error of ours", SOLVER, "-", 0.0, solver))
    full = [row["seconds_per_frame"] for row in rows if row["kind"] == "truth"]
    lines += [("full-order solver", SOLVER, ":", 0.0, seconds) for seconds in full]
    for label, color, style, upfront, seconds in lines:
        total = [(upfront + count * frames * seconds) / 60.0 for count in counts]
        panel.plot(counts, total, style, color=color, linewidth=1.4, label=label)
    panel.set_xlim(1.0, MOST_ROLLOUTS)
    panel.set_xlabel(f"rollouts of {frames} frames", fontsize=9)
    panel.set_ylabel("minutes in all, data and training included", fontsize=9)
    panel.legend(fontsize=7, loc="upper left")


def _front_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in _drawn(rows) if row.get("on_front")]


def _drawn(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with a place on two logarithmic axes."""
    return [
        row
        for row in rows
        if row.get("seconds_per_frame") and (row.get("full_rollout_mse") or 0) > 0
    ]


def _of(rows: list[dict[str, Any]], wanted: Any) -> list[dict[str, Any]]:
    return [row for row in _drawn(rows) if wanted(row)]


def _is_peer(row: dict[str, Any]) -> bool:
    return row["kind"] == "model" and row["name"] != "default"


def _solver(rows: list[dict[str, Any]], steps: str) -> list[dict[str, Any]]:
    return [row for row in _drawn(rows) if row["kind"] == "solver" and row["steps"] == steps]


def _named(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows whose names fit: ours, what is on the front, the best of the peers."""
    peers = sorted(_of(rows, _is_peer), key=lambda row: row["full_rollout_mse"])[:LABELS]
    ours = _of(rows, lambda row: row["name"] == "default")
    found = [*_front_rows(rows), *ours, *peers]
    return list({id(row): row for row in found if row["kind"] != "truth"}.values())


def _label(row: dict[str, Any]) -> str:
    if row["kind"] == "solver":
        grid = "n" if row["coarsening"] == 1.0 else f"n/{row['coarsening']:g}"
        return f"{grid}, {row['points']}"
    return f"Q = {row['points']}" if row["name"] == "default" else row["name"]
