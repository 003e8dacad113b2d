"""Longitudinal waves: a free bar, and a plate that its own inertia confines."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import curve_fit

from benchmarks.verification.case import COLOURS, Case, Outcome, Row, blank
from benchmarks.verification.world import World, block, make_scene
from giorom.mpm import StableNeoHookean

DENSITY, YOUNG = 1000.0, 1e5
SPEED = 0.05
"""Largest initial speed [m/s]: strains of 0.5 %, above float32 noise, below nonlinearity."""

BAR, PLATE_THICKNESS, PLATE_WIDTH = 0.5, 0.125, 0.8
FRAMES_PER_PERIOD = 40

Curve = dict[str, Any]


def ring(
    time: Float[np.ndarray, " t"], scale: float, decay: float, frequency: float, phase: float
) -> Float[np.ndarray, " t"]:
    """A decaying oscillation."""
    return scale * np.exp(-decay * time) * np.cos(2.0 * math.pi * frequency * time + phase)


def listen(
    points: np.ndarray, *, spacing: float, length: float, poissons_ratio: float, until: float
) -> Curve:
    """Set a body ringing in its lowest longitudinal mode along axis 0 and fit what is heard.

    The modal amplitude of the velocity, over the particles of the middle ``length``-high part
    of the body, is fitted with frequency, decay and phase (the phase takes up that velocities
    of symplectic Euler live half a step before positions).

    Args:
        points: The body, centred at 0.5 on each axis [m].
        spacing: Particle spacing; cells are twice as wide [m].
        length: Extent along axis 0 [m].
        poissons_ratio: Of the material.
        until: How long to listen, in periods of a wave at ``sound_speed``.

    Returns:
        Time, amplitude, fitted frequency [Hz], loss per half period and cells.
    """
    material = StableNeoHookean(
        density=DENSITY, youngs_modulus=YOUNG, poissons_ratio=poissons_ratio
    )
    expected = material.sound_speed / (2.0 * length)
    mode = np.cos(math.pi * (points[:, 0] - 0.5 + length / 2.0) / length)
    velocity = np.stack([SPEED * mode, np.zeros_like(mode)], axis=1)
    scene = make_scene(points, spacing=spacing, material=material, velocity=velocity)
    cells, frame_dt = round(0.5 / spacing), 1.0 / (FRAMES_PER_PERIOD * expected)
    world = World(scene, grid_cells=cells, frame_dt=frame_dt)
    heard = np.abs(points[:, 1] - 0.5) < length / 2.0
    weight = mode[heard] / (mode[heard] @ mode[heard])
    time, amplitude = [], []
    for now in world.frames(int(until * FRAMES_PER_PERIOD) + 1):
        time.append(now)
        amplitude.append(float(world.velocity[heard, 0] @ weight))
    start = (SPEED, 0.0, expected, 0.0)
    fitted, _ = curve_fit(ring, np.array(time), np.array(amplitude), p0=start)
    return {
        "time": np.array(time),
        "amplitude": np.array(amplitude) / SPEED,
        "expected": expected,
        "frequency": float(fitted[2]),
        "error": float(fitted[2]) / expected - 1.0,
        "loss": 1.0 - math.exp(-float(fitted[1]) / (2.0 * expected)),
        "grid_cells": cells,
        "particles": len(points),
    }


def free_bar(grid_cells: int) -> Curve:
    """A bar with nu = 0 and free ends: ``f = sqrt(E / rho) / (2 L)``."""
    spacing, half = 0.5 / grid_cells, 2.0 / grid_cells
    points = block((0.5 - BAR / 2, 0.5 - half), (0.5 + BAR / 2, 0.5 + half), spacing)
    return listen(points, spacing=spacing, length=BAR, poissons_ratio=0.0, until=3.0)


def confined_plate(grid_cells: int) -> Curve:
    """A plate ringing in its thickness: ``f = sqrt((lambda + 2 mu) / rho) / (2 h)``.

    Its middle is heard until the release waves from its free edges arrive; until then no
    particle there can move sideways, as in a bar between rigid walls. (A real pair of walls
    would not do: they let go of the bar while it is stretched.)
    """
    half = np.array([PLATE_THICKNESS, PLATE_WIDTH]) / 2
    spacing = 0.5 / grid_cells
    points = block(tuple(0.5 - half), tuple(0.5 + half), spacing)
    quiet = (half[1] - half[0]) / (2.0 * PLATE_THICKNESS)
    return listen(points, spacing=spacing, length=PLATE_THICKNESS, poissons_ratio=0.3, until=quiet)


def error_list(runs: list[Curve]) -> str:
    """The errors of some grids in words."""
    return "; ".join(f"{run['error']:+.3%} at {run['grid_cells']} cells" for run in runs)


def measure(*, quick: bool = False) -> Outcome:
    """Ring bars and plates on grids that double."""
    bars = [free_bar(cells) for cells in (32, 64, 128)]
    plates = [confined_plate(cells) for cells in ((64, 128) if quick else (64, 128, 256))]
    fine, plate = bars[-1], plates[-1]
    here = {"grid_cells": fine["grid_cells"], "particles": fine["particles"]}
    there = {"grid_cells": plate["grid_cells"], "particles": plate["particles"]}
    rows = [
        Row(
            quantity="frequency of the free bar [Hz]",
            measured=fine["frequency"],
            reference=fine["expected"],
            source="sqrt(E / rho) / (2 L), linear elasticity",
            lowest=-0.01,
            highest=0.01,
            **here,
        ),
        Row(
            quantity="amplitude kept per half period",
            measured=1.0 - fine["loss"],
            reference=1.0,
            source="no dissipation",
            lowest=-0.003,
            highest=1e-4,
            **here,
        ),
        Row(
            quantity="order of convergence of the frequency",
            measured=math.log2(bars[0]["error"] / bars[2]["error"]) / 2.0,
            reference=2.0,
            source="quadratic splines, dt proportional to dx",
            lowest=-0.2,
            highest=0.2,
            absolute=True,
            note=error_list(bars),
            **here,
        ),
        Row(
            quantity="frequency of the confined plate [Hz]",
            measured=plate["frequency"],
            reference=plate["expected"],
            source="sqrt((lambda + 2 mu) / rho) / (2 h), linear elasticity",
            lowest=-0.01,
            highest=0.01,
            note=error_list(plates),
            **there,
        ),
    ]
    return Outcome(rows=rows, curves={"bars": bars, "plates": plates})


def draw(outcome: Outcome) -> Any:
    """The ringing of the finest bar, and how the errors shrink with the cell."""
    figure, (left, right) = blank(2)
    bar = outcome.curves["bars"][-1]
    smooth = np.linspace(0.0, bar["time"][-1], 400)
    exact = np.cos(2.0 * math.pi * bar["expected"] * smooth)
    left.plot(smooth, exact, color=COLOURS[0], label="linear elasticity")
    left.plot(bar["time"], bar["amplitude"], ".", color=COLOURS[1], markersize=3.5, label="MPM")
    left.set(xlabel="time [s]", ylabel="modal velocity / initial", ylim=(-1.1, 1.6))
    left.set_title(f"free bar, {bar['grid_cells']} cells", fontsize=10)
    left.legend(loc="upper right", fontsize=8)
    names = (("bars", "free bar", "o-"), ("plates", "confined plate", "s--"))
    for colour, (name, label, mark) in zip(COLOURS[1:], names, strict=False):
        runs = outcome.curves[name]
        cells = np.array([run["grid_cells"] for run in runs])
        error = np.abs([run["error"] for run in runs])
        right.loglog(cells, error, mark, color=colour, label=label)
    guide = np.array([32.0, 256.0])
    right.loglog(guide, 1.5e-3 * (32.0 / guide) ** 2, ":", color="black", label="second order")
    right.axhline(0.01, color="#666666", linewidth=0.8)
    right.text(34, 0.0108, "tolerance", fontsize=8, color="#666666")
    right.set_xticks([32, 64, 128, 256], ["32", "64", "128", "256"])
    right.minorticks_off()
    right.set(xlabel="cells per metre", ylabel="error of the frequency")
    right.legend(fontsize=8)
    return figure


CASE = Case(
    name="elastic_wave",
    title="Elastic waves",
    method="A rubber bar (E = 1e5 Pa, rho = 1000 kg/m3, nu = 0, 0.5 m, free ends) starts with the "
    "velocity v0 cos(pi x / L) and rings in its lowest mode; a plate of 0.125 m (nu = 0.3) does "
    "the same across its thickness, heard in its middle before anything from its edges arrives. "
    "Frequency and decay are fitted to the modal velocity.",
    measure=measure,
    draw=draw,
)
