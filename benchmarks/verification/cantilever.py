"""A slender beam on its clamp: the frequency of its first bending mode."""

import math
from typing import Any

import numpy as np
import torch
from scipy.optimize import curve_fit

from benchmarks.verification.case import COLOURS, Case, Outcome, Row, blank
from benchmarks.verification.elastic_wave import error_list, ring
from benchmarks.verification.world import World, block, make_scene
from giorom.mpm import Scene, StableNeoHookean
from giorom.state import KINEMATIC

DENSITY, YOUNG, POISSON = 1000.0, 1e6, 0.3
LENGTH, THICKNESS, CLAMP = 0.4, 0.0625, 0.125
SPEED = 0.1
FRAMES_PER_PERIOD = 40
WAVE_NUMBER = 1.875104
"""First root of ``1 + cos b cosh b = 0``."""

MODE_SLOPE = 4.648
"""``L^2`` times the integral of the squared slope of the mode over that of its square."""

Curve = dict[str, Any]


def expected_frequency() -> float:
    r"""First frequency of Timoshenko's beam, to first order in ``(h / L)^2`` [Hz].

    .. math::
        f = \frac{b^2}{2 \pi L^2} \sqrt{\frac{E' h^2}{12 \rho}}
            \left(1 - \frac{4.648}{2} \frac{h^2}{12 L^2}
            \left(1 + \frac{E'}{\kappa G}\right)\right),
        \qquad E' = \frac{E}{1 - \nu^2}, \; \kappa = \frac56 .
    """
    modulus = YOUNG / (1.0 - POISSON**2)
    euler = WAVE_NUMBER**2 / (2.0 * math.pi * LENGTH**2)
    euler *= THICKNESS * math.sqrt(modulus / (12.0 * DENSITY))
    over_shear = modulus * 2.0 * (1.0 + POISSON) / (YOUNG * 5.0 / 6.0)
    slender = THICKNESS**2 / (12.0 * LENGTH**2)
    return euler * (1.0 - 0.5 * MODE_SLOPE * slender * (1.0 + over_shear))


def first_mode(height: np.ndarray) -> np.ndarray:
    """Shape of the first bending mode, one at the tip; ``height`` over the length."""
    b, s = WAVE_NUMBER, np.clip(height, 0.0, 1.0)
    ratio = (math.cosh(b) + math.cos(b)) / (math.sinh(b) + math.sin(b))
    return 0.5 * (np.cosh(b * s) - np.cos(b * s) - ratio * (np.sinh(b * s) - np.sin(b * s)))


def swing(grid_cells: int, *, periods: float = 2.0) -> Curve:
    """Set a clamped beam swinging in its first mode and fit the frequency."""
    spacing = 0.5 / grid_cells
    side = 0.5 * THICKNESS
    lower, upper = (0.5 - side, CLAMP - 4.0 * spacing), (0.5 + side, CLAMP + LENGTH)
    points = block(lower, upper, spacing)
    mode = first_mode((points[:, 1] - CLAMP) / LENGTH)
    velocity = np.stack([SPEED * mode, np.zeros_like(mode)], axis=1)
    material = StableNeoHookean(density=DENSITY, youngs_modulus=YOUNG, poissons_ratio=POISSON)
    scene = make_scene(
        points, spacing=spacing, material=material, velocity=velocity, clamp_plane=CLAMP
    )
    held = torch.from_numpy(points[:, 1] < CLAMP)
    kinds = torch.where(held, KINEMATIC, scene.particle_type)
    expected = expected_frequency()
    world = World(
        Scene(**vars(scene) | {"particle_type": kinds}),
        grid_cells=grid_cells,
        frame_dt=1.0 / (FRAMES_PER_PERIOD * expected),
    )
    time, amplitude = [], []
    for now in world.frames(round(periods * FRAMES_PER_PERIOD) + 1):
        time.append(now)
        amplitude.append(float(world.velocity[:, 0] @ mode / (mode @ mode)) / SPEED)
    fitted, _ = curve_fit(ring, np.array(time), np.array(amplitude), p0=(1.0, 0.0, expected, 0.0))
    return {
        "time": np.array(time),
        "amplitude": np.array(amplitude),
        "frequency": float(fitted[2]),
        "error": float(fitted[2]) / expected - 1.0,
        "grid_cells": grid_cells,
        "particles": len(points),
    }


def measure(*, quick: bool = False) -> Outcome:
    """Swing on grids that double."""
    beams = [swing(cells) for cells in ((32, 64) if quick else (32, 64, 128))]
    fine = beams[-1]
    here = {"grid_cells": fine["grid_cells"], "particles": fine["particles"]}
    rows = [
        Row(
            quantity="first bending frequency [Hz]",
            measured=fine["frequency"],
            reference=expected_frequency(),
            source="Timoshenko beam, plane strain, first order in (h / L)^2",
            lowest=-0.02,
            highest=0.02,
            note=error_list(beams),
            **here,
        )
    ]
    return Outcome(rows=rows, curves={"beams": beams})


def draw(outcome: Outcome) -> Any:
    """The swinging on every grid."""
    figure, (axis,) = blank(1)
    beams = outcome.curves["beams"]
    smooth = np.linspace(0.0, beams[-1]["time"][-1], 400)
    exact = np.cos(2.0 * math.pi * expected_frequency() * smooth)
    axis.plot(smooth, exact, color=COLOURS[0], label="Timoshenko beam")
    for colour, beam, mark in zip(COLOURS[1:], beams, ("x", "+", "."), strict=False):
        label = f"MPM, {beam['grid_cells']} cells"
        axis.plot(beam["time"], beam["amplitude"], mark, color=colour, markersize=5, label=label)
    axis.set(xlabel="time [s]", ylabel="modal velocity / initial", ylim=(-1.1, 1.7))
    axis.legend(fontsize=8, ncols=2, loc="upper right")
    return figure


CASE = Case(
    name="cantilever",
    title="Cantilever",
    method="A rubber beam 0.4 m high and 0.0625 m thick (E = 1e6 Pa, nu = 0.3, plane strain, no "
    "gravity) stands on its clamp and starts with the velocity of its first bending mode; the "
    "frequency is fitted to the modal velocity over two periods.",
    measure=measure,
    draw=draw,
)
