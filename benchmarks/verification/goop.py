"""A column of goop: it stands up to the height that its yield stress bears, and flows above."""

import math
from typing import Any

import numpy as np

from benchmarks.verification.case import COLOURS, GREY, Case, Outcome, Row, blank
from benchmarks.verification.world import GRAVITY, World, block, make_scene
from giorom.mpm import ViscoplasticGoop

DENSITY, YOUNG, POISSON, VISCOSITY = 1000.0, 1e5, 0.3, 200.0
HEIGHT, WIDTH, FLOOR = 0.25, 0.125, 0.125
WAIT, FRAME_DT = 4.0, 0.04
STRENGTHS = (1.25, 1.05, 0.75, 0.5, 0.25)
"""Height that can stand over the height of the column."""

Curve = dict[str, Any]


def slump(strength: float, grid_cells: int) -> Curve:
    r"""Let a column stand on a slippery floor.

    Uniaxial stress ``rho g (H - y)`` is in equilibrium with the weight and with the free sides.
    In plane strain its deviator is ``rho g H / sqrt(2)`` at the foot, so that the column stands
    exactly up to

    .. math::
        H_c = \frac{\sqrt 2 \sigma_y}{\rho g};

    above, a thin layer at the foot is squeezed out (both bounds of limit analysis agree).

    Args:
        strength: ``H_c`` over the height of the column.
        grid_cells: Cells per axis.

    Returns:
        Lost height over height as a function of time.
    """
    spacing = 0.5 / grid_cells
    points = block((0.5 - WIDTH / 2, FLOOR), (0.5 + WIDTH / 2, FLOOR + HEIGHT), spacing)
    material = ViscoplasticGoop(
        density=DENSITY,
        youngs_modulus=YOUNG,
        poissons_ratio=POISSON,
        yield_stress=strength * DENSITY * GRAVITY * HEIGHT / math.sqrt(2.0),
        viscosity=VISCOSITY,
    )
    bounds = np.array([[0.0625, 0.9375], [FLOOR, 0.9375]])
    scene = make_scene(points, spacing=spacing, material=material, bounds=bounds, gravity=GRAVITY)
    world = World(scene, grid_cells=grid_cells, frame_dt=FRAME_DT)
    time, lost = [], []
    for now in world.frames(round(WAIT / FRAME_DT) + 1):
        time.append(now)
        top = float(world.position[:, 1].max()) + spacing / 2.0
        lost.append(1.0 - (top - FLOOR) / HEIGHT)
    return {
        "strength": strength,
        "time": np.array(time),
        "slump": np.array(lost),
        "position": world.position,
        "grid_cells": grid_cells,
        "particles": len(points),
    }


def elastic_slump() -> float:
    """Height that an elastic column loses under its own weight, ``rho g H / 2E'``."""
    return DENSITY * GRAVITY * HEIGHT * (1.0 - POISSON**2) / (2.0 * YOUNG)


def layered_slump(strength: np.ndarray) -> np.ndarray:
    """Slump if each layer spread by itself until it bears its load."""
    held = np.minimum(strength, 1.0)
    return 1.0 - held * (1.0 - np.log(held))


def measure(*, quick: bool = False) -> Outcome:
    """Columns above and below the height that stands."""
    strengths = (1.05, 0.75) if quick else STRENGTHS
    columns = [slump(strength, 64) for strength in strengths]
    rows = []
    for column in columns:
        stands = column["strength"] > 1.0
        layered = float(layered_slump(np.array(column["strength"])))
        rows.append(
            Row(
                quantity=f"lost height, Hc / H = {column['strength']:g}",
                measured=float(column["slump"][-1]),
                reference=elastic_slump() if stands else layered,
                source="stands: rho g H / 2E', the elastic part alone"
                if stands
                else "flows: at least what layers spreading one by one lose (Pashias 1996)",
                lowest=-0.01 if stands else 0.0,
                highest=0.01 if stands else math.inf,
                absolute=True,
                grid_cells=column["grid_cells"],
                particles=column["particles"],
            )
        )
    return Outcome(rows=rows, curves={"columns": columns})


def draw(outcome: Outcome) -> Any:
    """Lost height over time, and at the end over the strength."""
    figure, (left, right) = blank(2)
    columns = outcome.curves["columns"]
    for colour, column in zip(COLOURS, columns, strict=False):
        label = f"Hc / H = {column['strength']:g}"
        left.plot(column["time"], column["slump"], color=colour, label=label)
    left.set(xlabel="time [s]", ylabel="lost height / height")
    left.legend(fontsize=8)
    strength = np.linspace(0.15, 1.4, 200)
    right.plot(strength, layered_slump(strength), color=GREY, label="layer by layer")
    at = [column["strength"] for column in columns]
    end = [column["slump"][-1] for column in columns]
    right.plot(at, end, "o", color=COLOURS[1], label="MPM")
    right.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
    right.text(1.02, 0.5, "stands", fontsize=8)
    right.text(0.98, 0.5, "flows", fontsize=8, ha="right")
    right.set(xlabel="Hc / H", ylabel="lost height / height")
    right.legend(fontsize=8)
    return figure


CASE = Case(
    name="goop",
    title="Yield height of goop",
    method="A column of goop 0.125 m wide and H = 0.25 m high (E = 1e5 Pa, viscosity 200 Pa s, "
    "plane strain) stands on a slippery floor for 4 s. It should stand exactly up to Hc = sqrt(2) "
    "sigma_y / (rho g).",
    measure=measure,
    draw=draw,
)
