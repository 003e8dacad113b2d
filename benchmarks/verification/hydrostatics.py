"""Water at rest in a tank: the pressure grows downwards by its weight."""

from typing import Any

import numpy as np

from benchmarks.verification.case import COLOURS, GREY, Case, Outcome, Row, blank
from benchmarks.verification.world import GRAVITY, World, block, make_scene
from giorom.mpm import WeaklyCompressibleFluid

DENSITY, BULK_MODULUS = 1000.0, 1e5
DEPTH = 0.375
"""Depth before it settles [m]."""

EXCLUDED = 3
"""Cells next to floor and surface where splines reach across the boundary."""

Curve = dict[str, Any]


def settle(dimension: int, grid_cells: int, *, swings: int = 8) -> Curve:
    """Fill a tank to ``DEPTH``, let the water settle and measure the pressure over the height.

    The water starts unstrained, so it swings up and down with the period ``4 H / c``; the
    pressure is averaged over the last four of the swings.

    Args:
        dimension: 2 or 3.
        grid_cells: Cells per axis.
        swings: How many periods to wait.

    Returns:
        Heights of the layers [m], their mean pressure [Pa] and its scatter, the fitted
        slope [Pa/m], the mean volume ratio and the fastest particle at the end [m/s].
    """
    spacing, floor = 0.5 / grid_cells, 0.125
    side = (floor, 1.0 - floor) if dimension == 2 else (0.375, 0.625)
    lower, upper = [side[0]] * dimension, [side[1]] * dimension
    lower[1], upper[1] = floor, floor + DEPTH
    material = WeaklyCompressibleFluid(density=DENSITY, bulk_modulus=BULK_MODULUS)
    walls = np.array([[side[0], side[1]]] * dimension)
    walls[1] = floor, 1.0 - floor
    points = block(tuple(lower), tuple(upper), spacing)
    scene = make_scene(points, spacing=spacing, material=material, bounds=walls, gravity=GRAVITY)
    period = 4.0 * DEPTH / material.sound_speed
    world = World(scene, grid_cells=grid_cells, frame_dt=period / 20.0)
    pressure = []
    frames = 20 * swings
    for frame, _ in enumerate(world.frames(frames + 1)):
        if frame > frames - 80:
            pressure.append(BULK_MODULUS * (1.0 - world.strain.numpy()))
    return layers(world, np.array(pressure), floor) | {
        "dimension": dimension,
        "grid_cells": grid_cells,
        "particles": len(points),
    }


def layers(world: World, pressure: np.ndarray, floor: float) -> Curve:
    """Mean pressure of layers one cell high, and its slope away from floor and surface."""
    cell, height = 1.0 / world.grid_cells, world.position[:, 1] - floor
    surface = float(np.quantile(height, 0.99))
    number = np.floor(height / cell).astype(int)
    full = range(number.max())
    each = [pressure[:, number == layer] for layer in full]
    middle = (np.array(full) + 0.5) * cell
    mean = np.array([values.mean() for values in each])
    used = (middle > EXCLUDED * cell) & (middle < surface - EXCLUDED * cell)
    inside = (height > EXCLUDED * cell) & (height < surface - EXCLUDED * cell)
    slope, offset = np.polyfit(height[inside], pressure.mean(0)[inside], 1)
    return {
        "height": middle,
        "pressure": mean,
        "scatter": np.array([values.mean(0).std() for values in each]),
        "used": used,
        "slope": float(slope),
        "offset": float(offset),
        "surface": surface,
        "volume_ratio": float(1.0 - pressure[:, inside].mean() / BULK_MODULUS),
        "fastest": float(np.linalg.norm(world.velocity, axis=1).max()),
    }


def measure(*, quick: bool = False) -> Outcome:
    """Settle a tank in two and in three dimensions."""
    tanks = [settle(2, 64), settle(3, 32)] if quick else [settle(2, 128), settle(3, 48)]
    rows = []
    for tank in tanks:
        here = {"grid_cells": tank["grid_cells"], "particles": tank["particles"]}
        weight = DENSITY * GRAVITY
        rows += [
            Row(
                quantity=f"slope of the pressure in {tank['dimension']}-D [Pa/m]",
                measured=tank["slope"],
                reference=-weight / tank["volume_ratio"],
                source="dp/dy = -rho g with the density rho0 / J of the compressed water",
                lowest=-0.06,
                highest=0.06,
                note=f"{EXCLUDED} cells at floor and surface left out; mean J "
                f"{tank['volume_ratio']:.4f}",
                **here,
            ),
            Row(
                quantity=f"depth of the settled water in {tank['dimension']}-D [m]",
                measured=tank["surface"],
                reference=DEPTH * (1.0 - weight * DEPTH / (2.0 * BULK_MODULUS)),
                source="H (1 - rho g H / 2K), compression under its own weight",
                lowest=-1.0 / tank["grid_cells"],
                highest=1.0 / tank["grid_cells"],
                absolute=True,
                note="tolerance: one cell",
                **here,
            ),
        ]
    return Outcome(rows=rows, curves={"tanks": tanks})


def draw(outcome: Outcome) -> Any:
    """Mean pressure of each layer beside the weight above it."""
    figure, axes = blank(2)
    for axis, tank in zip(axes, outcome.curves["tanks"], strict=True):
        height, used = tank["height"], tank["used"]
        weight = DENSITY * GRAVITY / tank["volume_ratio"]
        exact = weight * (tank["surface"] - height)
        axis.plot(exact / 1e3, height, color=COLOURS[0], label="weight of the water above")
        bars = {"xerr": tank["scatter"] / 1e3, "markersize": 4, "elinewidth": 0.6}
        for keep, colour, label in ((used, COLOURS[1], "MPM"), (~used, GREY, "left out")):
            chosen = {"xerr": bars["xerr"][keep]}
            axis.errorbar(
                tank["pressure"][keep] / 1e3,
                height[keep],
                fmt=".",
                color=colour,
                label=label,
                **bars | chosen,
            )
        axis.set(xlabel="pressure [kPa]", ylabel="height [m]", ylim=(0.0, None))
        axis.set_title(f"{tank['dimension']}-D, {tank['grid_cells']} cells", fontsize=10)
    axes[0].legend(fontsize=8)
    return figure


CASE = Case(
    name="hydrostatics",
    title="Water at rest",
    method="A tank is filled with water (rho = 1000 kg/m3, K = 1e5 Pa) 0.375 m deep, which settles "
    "under g = 9.8 m/s2 for eight of its vertical swings (period 4 H / c); pressure K (1 - J) is "
    "averaged over the last four. Bars show the scatter of the particles of a layer one cell high.",
    measure=measure,
    draw=draw,
)
