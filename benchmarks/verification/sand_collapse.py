"""Collapse of a sand column in the plane, against experiments in a channel."""

from typing import Any

import numpy as np

from benchmarks.verification.case import COLOURS, GREY, Case, Outcome, Row, blank
from benchmarks.verification.sand import Curve, column_2d

FRICTION_ANGLE = 31.0
ASPECTS = {0.5: 20, 1.0: 16, 2.0: 12, 4.0: 8}
"""Height over width of the columns, and their width in cells of a grid of 128."""

LUBE = "Lube et al., Phys. Rev. E 72 (2005) 041301"
LAJEUNESSE = "Lajeunesse et al., Phys. Fluids 17 (2005) 103302"


def runout_of_lube(aspect: float) -> float:
    """Run-out over width; between its two branches, 1.8 < a < 2.8, their mean."""
    low, high = 1.2 * aspect, 1.9 * aspect ** (2.0 / 3.0)
    return low if aspect <= 1.8 else high if aspect >= 2.8 else 0.5 * (low + high)


def height_of_lajeunesse(aspect: float) -> float:
    """Final height over width."""
    return aspect if aspect < 0.7 else aspect ** (1.0 / 3.0)


def run(aspect: float, *, fine: bool, friction_angle: float = FRICTION_ANGLE, **law: Any) -> Curve:
    """One column on the coarse (128) or on the fine grid (256)."""
    factor = 2 if fine else 1
    return column_2d(
        aspect,
        grid_cells=128 * factor,
        width_cells=ASPECTS[aspect] * factor,
        friction_angle=friction_angle,
        **law,
    )


def measure(*, quick: bool = False) -> Outcome:
    """Columns of four heights, of three frictions, with and without the volume correction."""
    fine = not quick
    columns = [run(aspect, fine=fine) for aspect in ((1.0, 4.0) if quick else ASPECTS)]
    coarse = [run(aspect, fine=False) for aspect in ASPECTS] if fine else columns
    middle = next(column for column in coarse if column["aspect"] == 1.0)
    rough, smooth = (run(1.0, fine=False, friction_angle=angle) for angle in (37.0, 25.0))
    frictions = [smooth, middle, rough]
    bare = run(4.0, fine=fine, volume_correction=False)
    rows = [row for column in columns for row in column_rows(column)]
    reach = [float(np.mean(each["runout"])) for each in frictions]
    rows += [
        Row(
            quantity="run-out lost from 25 to 31 and from 31 to 37 degrees, the smaller",
            measured=float(-np.diff(reach).max()),
            reference=0.0,
            source="more friction, less run-out",
            lowest=0.0,
            highest=np.inf,
            absolute=True,
            note=f"run-out {', '.join(f'{value:.2f}' for value in reach)} at a = 1",
            **size_of(frictions[0]),
        ),
        Row(
            quantity="run-out without over with volume correction, a = 4",
            measured=float(np.mean(bare["runout"]) / np.mean(columns[-1]["runout"])),
            reference=1.0,
            source="the correction must not make sand run further",
            lowest=-0.05,
            highest=np.inf,
            note=f"run-out {np.mean(bare['runout']):.2f} without",
            **size_of(bare),
        ),
    ]
    curves = {"columns": columns, "coarse": coarse, "frictions": frictions, "bare": bare}
    return Outcome(rows=rows, curves=curves)


def size_of(column: Curve) -> dict[str, int]:
    """Grid and particles of a run."""
    return {"grid_cells": column["grid_cells"], "particles": column["particles"]}


def column_rows(column: Curve) -> list[Row]:
    """Run-out, height and volume of one deposit beside their references."""
    aspect, low = column["aspect"], column["aspect"] < 1.0
    between = "the middle of the branches 1.2 a and 1.9 a^(2/3)"
    law = {0.5: "1.2 a", 1.0: "1.2 a", 2.0: between, 4.0: "1.9 a^(2/3)"}[aspect]
    sides = " and ".join(f"{value:.2f}" for value in column["runout"])
    return [
        Row(
            quantity=f"run-out / width, a = {aspect:g}",
            measured=float(np.mean(column["runout"])),
            reference=runout_of_lube(aspect),
            source=f"{LUBE}: {law}",
            lowest=-0.4 if low else -0.15,
            highest=0.15,
            note=f"sides {sides}",
            **size_of(column),
        ),
        Row(
            quantity=f"height / width, a = {aspect:g}",
            measured=column["height"],
            reference=height_of_lajeunesse(aspect),
            source=f"{LAJEUNESSE}: {'a' if aspect < 0.7 else 'a^(1/3)'}",
            lowest=-0.15,
            highest=0.15,
            note="" if low else f"Lube: 0.65 a^0.4 = {0.65 * aspect**0.4:.2f} for a > 1.15",
            **size_of(column),
        ),
        Row(
            quantity=f"volume of the deposit / column, a = {aspect:g}",
            measured=column["volume"],
            reference=1.0,
            source="no dilatancy: volume is kept",
            lowest=-0.1,
            highest=0.1,
            **size_of(column),
        ),
    ]


def draw(outcome: Outcome) -> Any:
    """Deposits, and run-out over aspect ratio."""
    figure, (left, right) = blank(2, width=8.4)
    for colour, column in zip(COLOURS, outcome.curves["columns"], strict=False):
        shown = column["depth"] > 0.0
        label = f"a = {column['aspect']:g}"
        left.plot(column["distance"][shown], column["depth"][shown], color=colour, label=label)
    bare = outcome.curves["bare"]
    shown = bare["depth"] > 0.0
    label = "a = 4, no volume correction"
    left.plot(bare["distance"][shown], bare["depth"][shown], ":", color=GREY, label=label)
    left.set(xlabel="distance / width", ylabel="depth / width", xlim=(0.0, None), ylim=(0.0, None))
    left.legend(fontsize=8)
    aspects = np.linspace(0.3, 4.5, 100)
    low, high = aspects <= 1.8, aspects >= 2.8
    right.plot(aspects[low], 1.2 * aspects[low], color=GREY, label="Lube 2005")
    right.plot(aspects[high], 1.9 * aspects[high] ** (2 / 3), color=GREY)
    for name, mark, colour in (("columns", "o", COLOURS[0]), ("coarse", "s", COLOURS[4])):
        for index, column in enumerate(outcome.curves[name]):
            label = f"MPM, {column['grid_cells']} cells" if index == 0 else None
            where = [column["aspect"]] * 2
            right.plot(where, column["runout"], mark, color=colour, markersize=5, label=label)
    right.plot([4.0] * 2, bare["runout"], "x", color=COLOURS[1], label="no volume correction")
    for index, column in enumerate(outcome.curves["frictions"][::2]):
        label = "25 and 37 degrees, 128 cells" if index == 0 else None
        mean = np.mean(column["runout"])
        right.plot(column["aspect"], mean, "d", color=COLOURS[2], markersize=4, label=label)
    right.set(xlabel="aspect ratio a", ylabel="run-out / width", ylim=(0.0, None))
    right.legend(fontsize=8)
    return figure


CASE = Case(
    name="sand_collapse",
    title="Collapse of a sand column, 2-D",
    method="A column of dry sand (friction angle 31 degrees, rho = 1500 kg/m3, E = 1e6 Pa, plane "
    "strain, four jittered particles per cell) a widths high is let go on a floor it sticks to, "
    "beside a plane of symmetry, and comes to rest. Run-out: how far sand at least 0.05 widths "
    "deep has come, over the width.",
    measure=measure,
    draw=draw,
    remarks=(
        "Run-out depends on what counts as the edge: sand 0.02 widths deep reaches 1.2 at 128 and "
        "1.5 at 256 cells (a = 1), sand 0.1 widths deep 1.1 on both; a thin tongue runs on as the "
        "grid is refined. That is why a = 1 is 4 % short at 128 and 15.1 % "
        "far at 256 cells. Heights lie between the two experiments, which differ by 40 %.",
    ),
)
