"""What the figures of the ablations share: points with their range over seeds, and the paper's."""

from collections.abc import Iterable, Sequence
from typing import Any

OURS, PAPER, OTHER = "#1f5fa8", "#c8501e", "#3d8f5f"
"""Colours of our numbers, the paper's and those of a second method of ours."""

ERROR = "rollout MSE [m²]"
"""Label of the axis of errors."""


def draw_rows(
    axes: Any,
    rows: Iterable[dict[str, Any]],
    places: Sequence[float | int],
    *,
    key: str = "rollout_mse",
    label: str = "ours",
    color: str = OURS,
    line: bool = True,
) -> None:
    """Mean and range over seeds of a number of each row; rows without an error are marked.

    Args:
        axes: Where.
        rows: The rows.
        places: Abscissa of each.
        key: The number.
        label: Entry of the legend.
        color: Colour.
        line: Whether the points are joined.
    """
    known = [(x, row) for x, row in zip(places, rows, strict=True) if row.get(key) is not None]
    gone = [x for x, row in zip(places, rows, strict=True) if row.get(key) is None]
    middle = [row[key] for _, row in known]
    low = [row[key] - (row.get(f"{key}_min") or row[key]) for _, row in known]
    high = [(row.get(f"{key}_max") or row[key]) - row[key] for _, row in known]
    axes.errorbar(
        [x for x, _ in known],
        middle,
        yerr=[low, high],
        fmt="o-" if line else "o",
        color=color,
        label=label,
        markersize=4,
        capsize=3,
        linewidth=1.2,
    )
    if gone and key == "rollout_mse":
        axes.plot(
            gone,
            [0.03] * len(gone),
            "x",
            color=color,
            transform=axes.get_xaxis_transform(),
            label=f"{label}: every rollout diverged",
        )


def draw_paper(
    axes: Any,
    places: Sequence[float | int],
    values: Sequence[float | None],
    *,
    label: str = "paper",
    line: bool = True,
) -> None:
    """The numbers of the paper, where it has any."""
    known = [(x, y) for x, y in zip(places, values, strict=True) if y is not None]
    if known:
        axes.plot(
            *zip(*known, strict=True),
            "s--" if line else "s",
            color=PAPER,
            label=label,
            markersize=5,
            markerfacecolor="none",
            linewidth=1.0,
        )


def name_places(axes: Any, names: Sequence[Any], *, turned: bool = False) -> list[float]:
    """Put names at equal steps of the abscissa; returns their places."""
    places = [float(number) for number in range(len(names))]
    options = {"rotation": 30, "ha": "right"} if turned else {}
    axes.set_xticks(places, [str(name) for name in names], **options)
    axes.set_xlim(-0.5, len(names) - 0.5)
    return places


def finish(
    axes: Any, *, x: str, y: str | None = ERROR, title: str | None = None, legend: bool = True
) -> None:
    """Logarithmic errors, labels with units, a faint grid, a legend."""
    axes.set_yscale("log")
    axes.set_xlabel(x)
    if y is not None:
        axes.set_ylabel(y)
    if title is not None:
        axes.set_title(title, fontsize="medium")
    axes.grid(visible=True, which="major", alpha=0.3)
    if legend:
        axes.legend(fontsize="small")
