"""Pictures of tables: values with their ranges, a panel for each system."""

from collections.abc import Callable
from functools import partial
from typing import Any

OURS, OTHERS, PAPER = "#c1272d", "#30506d", "#8a8a8a"
"""Colours of our default, of everything else that was measured, of the paper's numbers."""

LEAST_SPAN = 100.0
"""Least ratio of the ends of a logarithmic axis."""

SMALL: dict[str, Any] = {"fontsize": 7, "color": PAPER, "verticalalignment": "center"}
"""Words inside a panel."""


def panels_of(
    rows: list[dict[str, Any]],
    *,
    label: str = "rollout MSE [m²]",
    ours: str = "default",
) -> Callable[[Any], None]:
    """A function that draws the rollout errors of rows, a panel for each system."""
    return partial(draw_systems, rows=rows, value="rollout_mse", label=label, ours=ours)


def draw_systems(
    figure: Any,
    rows: list[dict[str, Any]],
    *,
    value: str,
    label: str,
    name: str = "name",
    ours: str = "default",
) -> None:
    """A panel for each system, a line for each row: value and range, and the paper's cross.

    Args:
        figure: An empty matplotlib figure.
        rows: Rows with ``system``, ``name``, the value, its ``_min`` and ``_max``, and ``paper``.
        value: Key of what is drawn, on a logarithmic axis; rows without it keep an empty line.
        label: What it is, with its unit.
        name: Key of the names of the lines.
        ours: Name of the row in another colour.
    """
    systems = list(dict.fromkeys(row["system"] for row in rows))
    most = max(sum(row["system"] == system for row in rows) for system in systems)
    figure.set_size_inches(max(8.0, 2.6 * len(systems)), 1.8 + 0.26 * most)
    panels = figure.subplots(1, len(systems), squeeze=False)[0]
    for panel, system in zip(panels, systems, strict=True):
        mine = [row for row in rows if row["system"] == system]
        _draw_panel(panel, mine, value=value, name=name, ours=ours)
        panel.set_title(system, fontsize=10)
        panel.set_xlabel(label, fontsize=8)
        if panel is not panels[0] and _same_names(rows, systems, name):
            panel.set_yticklabels([])


def _draw_panel(
    panel: Any, rows: list[dict[str, Any]], *, value: str, name: str, ours: str
) -> None:
    for line, row in enumerate(rows):
        color = OURS if row[name] == ours else OTHERS
        middle = row.get(value)
        if middle is not None and middle > 0.0:
            low, high = row.get(f"{value}_min") or middle, row.get(f"{value}_max") or middle
            panel.plot([low, high], [line, line], color=color, linewidth=2.0)
            panel.plot([middle], [line], "o", color=color, markersize=5.0)
        elif row.get("diverged"):
            panel.text(0.02, line, "diverged", transform=panel.get_yaxis_transform(), **SMALL)
        if row.get("paper"):
            panel.plot([row["paper"]], [line], "x", color=PAPER, markersize=6.0)
    _logarithmic(panel)
    panel.set_yticks(range(len(rows)), [str(row[name]) for row in rows], fontsize=8)
    panel.set_ylim(len(rows) - 0.5, -0.5)
    panel.tick_params(axis="x", labelsize=8)
    panel.grid(axis="x", color="0.9")
    panel.spines[["top", "right"]].set_visible(False)


def _logarithmic(panel: Any) -> None:
    """A logarithmic axis with a name at every power of ten, of which there are two at least."""
    from matplotlib.ticker import NullFormatter

    panel.set_xscale("log")
    low, high = panel.get_xlim()
    missing = LEAST_SPAN / (high / low)
    if missing > 1.0:
        panel.set_xlim(low / missing**0.5, high * missing**0.5)
    panel.xaxis.set_minor_formatter(NullFormatter())


def _same_names(rows: list[dict[str, Any]], systems: list[str], name: str) -> bool:
    """Whether all systems have the same rows in the same order."""
    listed = [[row[name] for row in rows if row["system"] == system] for system in systems]
    return all(names == listed[0] for names in listed)
