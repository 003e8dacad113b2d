"""Heaps of sand: they stand up to the friction angle and slide above it."""

import math
from typing import Any

import numpy as np

from benchmarks.verification.case import COLOURS, GREY, Case, Outcome, Row, blank
from benchmarks.verification.sand import Curve, come_to_rest
from benchmarks.verification.sand_collapse_3d import FRICTION_ANGLE, plane_angle
from benchmarks.verification.world import block

HALF_WIDTH = 0.3
"""Half the base of a heap [m]."""

UNTIL = 4.0
ANGLES = (25.0, 35.0)
STEEPER = (-5.0, -2.0, 2.0, 5.0, 10.0)
"""Slopes tried, less the friction angle [degrees]."""

CLEARLY = 4.0
"""How much steeper than the friction angle a heap must be to gather speed [degrees]."""


def heap(friction_angle: float, slope: float, grid_cells: int) -> Curve:
    """Let a triangular heap of a given slope go.

    Args:
        friction_angle: Of the sand [degrees].
        slope: Of both flanks at the start [degrees].
        grid_cells: Cells per axis.

    Returns:
        Slope before and after [degrees], and the farthest way of a particle [cells].
    """
    spacing, floor = 0.5 / grid_cells, 8.0 / grid_cells
    rise = math.tan(math.radians(slope))
    height = HALF_WIDTH * rise
    top = floor + math.ceil(height / spacing) * spacing
    points = block((0.5 - HALF_WIDTH, floor), (0.5 + HALF_WIDTH, top), spacing)
    inside = points[:, 1] - floor <= (HALF_WIDTH - np.abs(points[:, 0] - 0.5)) * rise
    world, start = come_to_rest(
        points[inside],
        grid_cells=grid_cells,
        floor=floor,
        until=UNTIL,
        height=height,
        friction_angle=friction_angle,
    )
    way = np.linalg.norm(world.position - start, axis=1).max() * grid_cells
    return {
        "friction_angle": friction_angle,
        "slope": slope,
        "start": start,
        "end": world.position,
        "final": flank(world.position, floor=floor, cell=1.0 / grid_cells),
        "way": float(way),
        "floor": floor,
        "grid_cells": grid_cells,
        "particles": len(start),
    }


def cone_way(friction_angle: float, slope: float, grid_cells: int) -> Curve:
    """Farthest way of a particle in a round heap of 3-D sand [cells], and their number."""
    spacing, floor, half = 0.5 / grid_cells, 4.0 / grid_cells, 0.25
    rise = math.tan(math.radians(slope))
    top = floor + math.ceil(half * rise / spacing) * spacing
    lower, upper = (0.5 - half, floor, 0.5 - half), (0.5 + half, top, 0.5 + half)
    points = block(lower, upper, spacing)
    away = np.hypot(points[:, 0] - 0.5, points[:, 2] - 0.5)
    world, start = come_to_rest(
        points[points[:, 1] - floor <= (half - away) * rise],
        grid_cells=grid_cells,
        floor=floor,
        until=UNTIL,
        height=half * rise,
        friction_angle=friction_angle,
    )
    way = np.linalg.norm(world.position - start, axis=1).max() * grid_cells
    return {"slope": slope, "way": float(way), "particles": len(start)}


def cone_rows(grid_cells: int) -> list[Row]:
    """Round heaps stand up to the plane angle of the 3-D cone of yield, 46 degrees for 31."""
    rows = []
    for slope in (40.0, 50.0):
        heap_3d = cone_way(FRICTION_ANGLE, slope, grid_cells)
        stands = slope < plane_angle(FRICTION_ANGLE)
        rows.append(
            Row(
                quantity=f"farthest way in a 3-D cone of {slope:g} degrees, friction "
                f"{FRICTION_ANGLE:g} [cells]",
                measured=heap_3d["way"],
                reference=0.0,
                source="sin(phi_p) = 2 sqrt(3) sin(phi) / (3 - sin(phi)): 46 degrees, see the 3-D "
                "collapse",
                lowest=-math.inf if stands else 1.0,
                highest=1.0 if stands else math.inf,
                absolute=True,
                grid_cells=grid_cells,
                particles=heap_3d["particles"],
            )
        )
    return rows


def flank(position: np.ndarray, *, floor: float, cell: float) -> float:
    """Slope of both flanks between 20 and 80 % of the height, by least squares [degrees]."""
    away, up = np.abs(position[:, 0] - 0.5), position[:, 1] - floor
    strip = np.floor(away / (2.0 * cell)).astype(int)
    number = np.bincount(strip)
    kept = np.flatnonzero(number > 4)
    surface = np.array([np.quantile(up[strip == k], 0.95) / 0.95 for k in kept])
    middle = (kept + 0.5) * 2.0 * cell
    used = (surface > 0.2 * surface.max()) & (surface < 0.8 * surface.max())
    return math.degrees(math.atan(-np.polyfit(middle[used], surface[used], 1)[0]))


def measure(*, quick: bool = False) -> Outcome:
    """Heaps flatter and steeper than the friction angle."""
    cells = 64 if quick else 128
    steeper = (-5.0, 10.0) if quick else STEEPER
    heaps = [heap(angle, angle + more, cells) for angle in ANGLES for more in steeper]
    rows = [row_of(each) for each in heaps] + ([] if quick else cone_rows(40))
    return Outcome(rows=rows, curves={"heaps": heaps})


def row_of(each: Curve) -> Row:
    """A flatter heap must stand, a steeper one must end below the friction angle."""
    angle, slope = each["friction_angle"], each["slope"]
    here = {"grid_cells": each["grid_cells"], "particles": each["particles"]}
    if slope < angle:
        return Row(
            quantity=f"farthest way in a heap of {slope:g} degrees, friction {angle:g} [cells]",
            measured=each["way"],
            reference=0.0,
            source="an infinite slope stands below the friction angle",
            lowest=-math.inf,
            highest=1.0,
            absolute=True,
            note=f"slope at the end {each['final']:.1f} degrees",
            **here,
        )
    if slope - angle < CLEARLY:
        return Row(
            quantity=f"farthest way in a heap of {slope:g} degrees, friction {angle:g} [cells]",
            measured=each["way"],
            reference=0.0,
            source="an infinite slope slides above the friction angle",
            lowest=1.0,
            highest=math.inf,
            absolute=True,
            note=f"slope at the end {each['final']:.1f} degrees",
            **here,
        )
    return Row(
        quantity=f"slope at the end of a heap of {slope:g} degrees, friction {angle:g} [degrees]",
        measured=each["final"],
        reference=angle,
        source="sand in motion comes to rest below the friction angle",
        lowest=-math.inf,
        highest=0.0,
        absolute=True,
        note=f"farthest way {each['way']:.1f} cells",
        **here,
    )


def draw(outcome: Outcome) -> Any:
    """How far heaps slide, and where they come to rest."""
    figure, (left, right) = blank(2, width=8.0)
    for number, angle in enumerate(ANGLES):
        chosen = [each for each in outcome.curves["heaps"] if each["friction_angle"] == angle]
        slopes = [each["slope"] for each in chosen]
        colour = COLOURS[number]
        ways = [each["way"] for each in chosen]
        left.semilogy(slopes, ways, "o-", color=colour, label=f"friction {angle:g} degrees")
        left.axvline(angle, color=colour, linewidth=0.8, linestyle=":")
        right.plot(slopes, [each["final"] for each in chosen], "o-", color=colour)
        right.axhline(angle, color=colour, linewidth=0.8, linestyle=":")
    left.axhline(1.0, color=GREY, linewidth=0.8)
    left.set(xlabel="slope at the start [degrees]", ylabel="farthest way of a particle [cells]")
    left.legend(fontsize=8)
    ends = np.array([15.0, 46.0])
    right.plot(ends, ends, color=GREY, linewidth=0.8)
    right.text(40.0, 43.0, "unmoved", fontsize=8, color=GREY, ha="right")
    right.set(xlabel="slope at the start [degrees]", ylabel="slope at the end [degrees]")
    return figure


CASE = Case(
    name="repose",
    title="Heaps and the angle of repose",
    method="Triangular heaps of dry sand, 0.6 m wide, of 25 and of 35 degrees of friction, are let "
    "go on a floor they stick to (plane strain, jittered particles). A flank flatter than the "
    "friction angle stands; a steeper one slides and, being in motion, comes to rest below it. "
    "Dotted: the friction angles. Round heaps of 3-D sand of 31 degrees stand up to 46.",
    measure=measure,
    draw=draw,
)
