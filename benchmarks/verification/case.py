"""What a benchmark gives: measured quantities beside their references, and a figure.

A case is a module with ``measure(*, quick) -> Outcome`` and ``draw(outcome) -> figure``.
Colours are those of Okabe and Ito, which colour-blind readers can tell apart.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#666666"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One measured quantity and what it should be."""

    quantity: str
    """What was measured, with its unit."""

    measured: float
    """What came out."""

    reference: float
    """What should have come out; of a bound, the bound."""

    source: str
    """Where the reference is from."""

    lowest: float
    """Smallest accepted deviation; -inf for an upper bound."""

    highest: float
    """Largest accepted deviation."""

    absolute: bool = False
    """Whether the deviation is a difference; else it is relative to the reference."""

    grid_cells: int
    """Cells per axis of the unit box."""

    particles: int
    """Particles of the run."""

    note: str = ""
    """Why it deviates, where that is known."""

    @property
    def deviation(self) -> float:
        """Measured less reference, relative unless ``absolute``."""
        difference = self.measured - self.reference
        return difference if self.absolute else difference / abs(self.reference)

    @property
    def passed(self) -> bool:
        """Whether the deviation is within its tolerance."""
        return self.lowest <= self.deviation <= self.highest

    @property
    def tolerance(self) -> str:
        """The accepted deviation in words."""
        scale, unit = (1.0, "") if self.absolute else (100.0, " %")
        low, high = self.lowest * scale, self.highest * scale
        if math.isinf(low):
            return f"at most {high:+.3g}{unit}" if high else "not above"
        if math.isinf(high):
            return f"at least {low:+.3g}{unit}" if low else "not below"
        if low == -high:
            return f"± {high:.3g}{unit}"
        return f"{low:+.3g} to {high:+.3g}{unit}"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Everything one case gave."""

    rows: list[Row]
    """The quantities."""

    curves: dict[str, Any] = field(default_factory=dict)
    """Arrays for the figure, named by the case."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A benchmark by name."""

    name: str
    """Name on the command line and of the figure."""

    title: str
    """Heading in the report."""

    method: str
    """What is simulated and how it is measured, for the report."""

    measure: Callable[..., Outcome]
    """Runs it: ``measure(quick=...)``."""

    draw: Callable[[Outcome], Any]
    """Draws a matplotlib figure."""

    remarks: tuple[str, ...] = ()
    """Paragraphs below the numbers: what they mean, why they miss."""


def blank(columns: int = 1, *, width: float = 7.2, height: float = 3.6) -> tuple[Any, list[Any]]:
    """An empty figure and its axes, without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(visible=True, color="#e6e6e6", linewidth=0.6)
        each.set_axisbelow(True)
    return figure, list(axes)
