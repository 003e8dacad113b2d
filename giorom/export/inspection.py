"""Pictures of a data set: some frames of some motions, and histograms. Drawn without a display.

Axis 1 points up. Plane motions are drawn as they are, motions in space seen from a fixed corner,
far particles first. Colours can be told apart by colour-blind eyes.
"""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from giorom.data.atomic import replacing
from giorom.data.measure import SetMeasure, Sheet
from giorom.data.report import Report
from giorom.state import KINEMATIC

__all__ = ["draw_histograms", "draw_motions"]

COLUMNS = 6
"""Frames of each motion."""

PANEL = 2.0
"""Width of a panel [inch]."""

TYPE_COLORS = {
    0: "#000000",
    1: "#f0e442",
    2: "#cc79a7",
    3: "#999999",
    4: "#d55e00",
    5: "#0072b2",
    6: "#e69f00",
    7: "#009e73",
    8: "#56b4e9",
}
"""Colours of the particle types (Okabe and Ito's palette, kinematic grey)."""

AXIS_COLORS = ("#0072b2", "#d55e00", "#009e73")
"""Colours of the curves of x, y and z."""

AZIMUTH, ELEVATION = math.radians(35.0), math.radians(20.0)
"""Direction motions in space are seen from."""


def draw_motions(sheets: Sequence[Sheet], facts: dict[str, Any], path: Path) -> Path:
    """Draw a row for each motion and a column for each of some frames.

    Particles are coloured by their type where there are several, else by their speed.

    Args:
        sheets: Motions to draw, at least one.
        facts: The facts of the report (bounds, extent, time between frames).
        path: PNG file to create or replace.

    Returns:
        The path.
    """
    from matplotlib.figure import Figure

    box = _view(facts)
    corners = _flat(np.stack(np.meshgrid(*box, indexing="ij"), axis=-1).reshape(-1, len(box)))[0]
    low, high = corners.min(axis=0), corners.max(axis=0)
    width, height = np.maximum(high - low, 1e-3 * np.ptp(corners))
    tall = PANEL * min(2.5, max(0.4, height / width))
    high_inches = len(sheets) * (tall + 0.25) + 0.6
    figure = Figure(figsize=(PANEL * COLUMNS + 0.6, high_inches))
    axes = figure.subplots(len(sheets), COLUMNS, squeeze=False)
    kinds = len(facts["types"]) > 1
    fastest = max((_fast(sheet) for sheet in sheets), default=0.0) or 1.0
    for sheet, row in zip(sheets, axes, strict=True):
        for ax, frame in zip(row, _evenly(sheet.frames), strict=True):
            _box(ax, box, low, high)
            if frame is not None:
                _draw_frame(ax, sheet, frame, fastest=None if kinds else fastest)
                ax.set_title(_when(frame[0], facts["frame_dt"]), fontsize=7, pad=2)
        row[0].set_ylabel(sheet.name[-32:], fontsize=6)
    text = "colour: particle type" if kinds else "colour: speed, dark slow to light fast"
    figure.suptitle(f"{facts['source']}   ({text})", fontsize=9, y=1.0 - 0.12 / high_inches)
    top = 1.0 - 0.55 / high_inches
    figure.subplots_adjust(left=0.04, right=0.99, bottom=0.01, top=top, wspace=0.04, hspace=0.15)
    if kinds:
        _legend(figure, facts)
    return _save(figure, path)


def draw_histograms(measure: SetMeasure, report: Report, path: Path) -> Path:
    """Draw how velocities, accelerations, steps and neighbour counts are distributed.

    Args:
        measure: The measured motions.
        report: Their report.
        path: PNG file to create or replace.

    Returns:
        The path.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    velocity, acceleration, steps, neighbors = figure.subplots(2, 2).flat
    frame_dt = report.facts["frame_dt"]
    dimension = report.facts["dimension"]
    rows = _rows(measure.steps.items, dimension)
    _per_axis(velocity, rows if frame_dt is None else rows / frame_dt)
    velocity.set_xlabel("velocity [m/frame]" if frame_dt is None else "velocity [m/s]")
    changes = _rows(measure.changes.items, dimension)
    _per_axis(acceleration, changes if frame_dt is None else changes / frame_dt**2)
    unit = "m/frame$^2$" if frame_dt is None else "m/s$^2$"
    acceleration.set_xlabel(f"acceleration [{unit}]")
    _steps(steps, rows, report.facts)
    suggested = report.facts["suggested"]
    counts = report.suggestion.neighbors
    if len(counts):
        edges = np.arange(counts.min(), counts.max() + 2) - 0.5
        neighbors.hist(counts, bins=edges[:: max(1, len(edges) // 60)], color=AXIS_COLORS[0])
    radius = "" if suggested["radius"] is None else f" within {suggested['radius']:.4g} m"
    neighbors.set_xlabel(f"neighbours of {suggested['sparse_points']} samples{radius}")
    neighbors.set_ylabel("samples")
    figure.suptitle(report.facts["source"], fontsize=10)
    return _save(figure, path)


def _draw_frame(
    ax: Any, sheet: Sheet, frame: tuple[int, np.ndarray, np.ndarray], *, fastest: float | None
) -> None:
    """Scatter the particles of one frame, far ones first."""
    _, position, speed = frame
    place, depth = _flat(position.astype(np.float64))
    order = np.argsort(depth, kind="stable")
    size = max(0.3, min(6.0, 900.0 / max(1, len(order))))
    kind = sheet.particle_type[order]
    options: dict[str, Any] = {"s": size, "linewidths": 0, "rasterized": True}
    if fastest is None:
        options["c"] = [TYPE_COLORS[int(number)] for number in kind]
        ax.scatter(*place[order].T, **options)
        return
    held = kind == KINEMATIC
    ax.scatter(*place[order][held].T, c=TYPE_COLORS[KINEMATIC], **options)
    color = {"c": speed[order][~held], "cmap": "viridis", "vmin": 0.0, "vmax": fastest}
    ax.scatter(*place[order][~held].T, **color, **options)


def _flat(position: Float[np.ndarray, "n d"]) -> tuple[np.ndarray, np.ndarray]:
    """Places on the picture and nearness to the eye."""
    if position.shape[1] == 2:
        return position, np.zeros(len(position))
    x, y, z = position.T
    across = math.cos(AZIMUTH) * x - math.sin(AZIMUTH) * z
    away = math.sin(AZIMUTH) * x + math.cos(AZIMUTH) * z
    up = math.cos(ELEVATION) * y - math.sin(ELEVATION) * away
    near = math.sin(ELEVATION) * y + math.cos(ELEVATION) * away
    return np.stack([across, up], axis=1), near


def _view(facts: dict[str, Any]) -> np.ndarray:
    """The part of the domain that the particles reach, with some room around them."""
    extent = np.array([[0.0 if v is None else v for v in pair] for pair in facts["extent"]])
    room = max(0.1 * float((extent[:, 1] - extent[:, 0]).max()), 1e-6)
    view = extent + np.array([-room, room])
    if facts["bounds"] is None:
        return view
    walls = np.array(facts["bounds"])
    low = np.minimum(np.maximum(view[:, 0], walls[:, 0]), extent[:, 0])
    high = np.maximum(np.minimum(view[:, 1], walls[:, 1]), extent[:, 1])
    return np.stack([low, high], axis=1)


def _box(ax: Any, box: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """An empty panel with the edges of the domain."""
    from matplotlib.collections import LineCollection

    corners = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1).reshape(-1, len(box))
    place = _flat(corners)[0]
    differing = (corners[:, None] != corners).sum(axis=2)
    edges = place[np.argwhere(np.triu(differing == 1))]
    ax.add_collection(LineCollection(edges, colors="#bbbbbb", linewidths=0.6, zorder=0))
    margin = 0.03 * (high - low).max()
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)


def _legend(figure: Any, facts: dict[str, Any]) -> None:
    from matplotlib.lines import Line2D

    from giorom.data.report_text import TYPES

    handles = [
        Line2D([], [], marker="o", linestyle="", color=TYPE_COLORS[int(k)], label=TYPES.get(k, k))
        for k in facts["types"]
    ]
    figure.legend(handles=handles, loc="upper right", ncols=len(handles), fontsize=7, frameon=False)


def _per_axis(ax: Any, rows: np.ndarray) -> None:
    """A curve for each component, over the range that holds nearly all."""
    if len(rows) == 0:
        return
    low, high = np.quantile(rows, [0.001, 0.999])
    if not high > low:
        low, high = low - 0.5, high + 0.5
    for axis in range(rows.shape[1]):
        ax.hist(
            rows[:, axis],
            bins=np.linspace(low, high, 81),
            histtype="step",
            color=AXIS_COLORS[axis],
            label="xyz"[axis],
            log=True,
        )
    ax.set_ylim(bottom=0.5)
    ax.set_ylabel("particles and frames")
    ax.legend(fontsize=8, frameon=False)


def _steps(ax: Any, rows: np.ndarray, facts: dict[str, Any]) -> None:
    """Lengths of the steps beside the spacing and the radius."""
    lengths = np.linalg.norm(rows, axis=1)
    lengths = lengths[lengths > 0.0]
    marks = {"spacing": facts["spacing"], "radius": facts["suggested"]["radius"]}
    known = {name: value for name, value in marks.items() if value}
    if len(lengths):
        edge = max(float(lengths.max()), *known.values(), 0.0)
        bins = np.geomspace(max(float(np.quantile(lengths, 0.01)), 1e-6 * edge), edge, 61)
        if bins[-1] > bins[0]:
            ax.hist(lengths, bins=bins, color=AXIS_COLORS[0])
            ax.set_xscale("log")
    for (name, value), style in zip(known.items(), ("--", "-"), strict=False):
        ax.axvline(value, color="#d55e00", linestyle=style, label=name)
    if known:
        ax.legend(fontsize=8, frameon=False)
    ax.set_xlabel("displacement in one frame [m]")
    ax.set_ylabel("particles and frames")


def _rows(items: list[np.ndarray], dimension: int) -> np.ndarray:
    return np.concatenate([np.zeros((0, dimension)), *items])


def _fast(sheet: Sheet) -> float:
    """Speed that nearly all drawn particles stay below."""
    speeds = [speed for _, _, speed in sheet.frames]
    return float(np.quantile(np.concatenate(speeds), 0.99)) if speeds else 0.0


def _evenly(frames: list[Any]) -> list[Any]:
    """Some frames from the first to the last; none where there are fewer."""
    if len(frames) <= COLUMNS:
        return [*frames, *[None] * (COLUMNS - len(frames))]
    return [frames[i] for i in np.linspace(0, len(frames) - 1, COLUMNS).round().astype(int)]


def _when(frame: int, frame_dt: float | None) -> str:
    return f"frame {frame}" if frame_dt is None else f"frame {frame}, {frame * frame_dt:.4g} s"


def _save(figure: Any, path: Path) -> Path:
    with replacing(path) as temporary, warnings.catch_warnings():
        # Of data without anything to draw, axes stay empty; matplotlib need not say so.
        warnings.simplefilter("ignore", UserWarning)
        figure.savefig(temporary, dpi=130)
    return path
