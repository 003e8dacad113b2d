"""Energy of bodies in free flight: nothing may add to it, and solids keep theirs."""

from typing import Any

import numpy as np

from benchmarks.verification.case import COLOURS, GREY, Case, Outcome, Row, blank
from benchmarks.verification.world import World, block, make_scene
from giorom.mpm import (
    DruckerPragerSand,
    FixedCorotated,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
    WeaklyCompressibleFluid,
)

SPIN = 5.0
"""Angular speed of every body [rad/s]."""

BREATH = 2.0
"""Rate at which it is being stretched along one diagonal and squeezed along the other [1/s]."""

DURATION, FRAME_DT = 0.3, 5e-3
"""Until just before the fastest drop of water reaches a wall [s]."""

SOLID = {"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}

ELASTIC = {
    "stable neo-Hookean": StableNeoHookean(**SOLID),
    "fixed corotated": FixedCorotated(**SOLID),
}
DISSIPATIVE = {
    "water": WeaklyCompressibleFluid(density=1000.0, bulk_modulus=1e5),
    "sand": DruckerPragerSand(**SOLID, friction_angle=30.0),
    "plasticine": VonMisesPlasticine(**SOLID, yield_stress=100.0),
    "goop": ViscoplasticGoop(**SOLID, yield_stress=50.0, viscosity=20.0),
}

Curve = dict[str, Any]


def fly(
    material: Any, *, dimension: int = 2, grid_cells: int = 64, breath: float = BREATH
) -> Curve:
    """Let a block of 0.25 m spin and breathe in still air without gravity.

    Args:
        material: Its law.
        dimension: 2 or 3.
        grid_cells: Cells per axis.
        breath: Rate of pure shear added to the spin [1/s]; 0 is a rigid rotation.

    Returns:
        Time, and total energy (kinetic with its affine part, and elastic) over the initial.
    """
    spacing = 0.5 / grid_cells
    points = block((0.375,) * dimension, (0.625,) * dimension, spacing)
    gradient = np.zeros((dimension, dimension))
    gradient[0, 1], gradient[1, 0] = breath - SPIN, breath + SPIN
    velocity = (points - 0.5) @ gradient.T
    scene = make_scene(
        points, spacing=spacing, material=material, velocity=velocity, gradient=gradient
    )
    world = World(scene, grid_cells=grid_cells, frame_dt=FRAME_DT)
    time, energy = [], []
    for frame in range(round(DURATION / FRAME_DT)):
        time.append(frame * FRAME_DT)
        energy.append(centred_energy(world))
        world.engine.advance(world.substeps - 1)
    return {
        "time": np.array(time),
        "energy": np.array(energy) / energy[0],
        "dimension": dimension,
        "grid_cells": grid_cells,
        "particles": len(points),
    }


def centred_energy(world: World) -> float:
    """Total energy at the time of the strain; advances the world by one substep.

    Symplectic Euler keeps velocities half a step before positions, so that kinetic plus
    elastic energy of one state swings by the order of dt. With the product of the velocities
    half a step before and after, ``v_n . v_(n+1) / 2``, it is right to dt^2.
    """
    elastic = world.elastic_energy()
    before = world.velocity, world.engine.affine_velocity().double().numpy()
    world.engine.advance(1)
    after = world.velocity, world.engine.affine_velocity().double().numpy()
    per_mass = (before[0] * after[0]).sum(1)
    per_mass += (before[1] * after[1]).sum((1, 2)) / (4.0 * world.grid_cells**2)
    return float(0.5 * (world.mass * per_mass).sum()) + elastic


def growth(run: Curve) -> float:
    """Largest excess of the energy over its smallest earlier value."""
    return float((run["energy"] - np.minimum.accumulate(run["energy"])).max())


def measure(*, quick: bool = False) -> Outcome:
    """Spin the elastic bodies; spin and shake one of every law; in 3-D too unless ``quick``."""
    sizes = [(2, 64)] if quick else [(2, 64), (3, 32)]
    rows, spun, shaken = [], {}, {}
    for dimension, cells in sizes:
        for name, material in ELASTIC.items():
            run = fly(material, dimension=dimension, grid_cells=cells, breath=0.0)
            spun[name, dimension] = run
            rows.append(spin_row(name, run))
    for dimension, cells in sizes:
        for name, material in (ELASTIC | DISSIPATIVE).items():
            run = fly(material, dimension=dimension, grid_cells=cells)
            shaken[name, dimension] = run
            rows.append(growth_row(name, run))
    return Outcome(rows=rows, curves={"spun": spun, "shaken": shaken})


def spin_row(name: str, run: Curve) -> Row:
    """Energy that a spinning body keeps."""
    return Row(
        quantity=f"energy kept, spinning {name}, {run['dimension']}-D",
        measured=float(run["energy"][-1]),
        reference=1.0,
        source="conservation of energy",
        lowest=-1e-3,
        highest=1e-6,
        note=f"after {DURATION} s at {SPIN:g} rad/s",
        grid_cells=run["grid_cells"],
        particles=run["particles"],
    )


def growth_row(name: str, run: Curve) -> Row:
    """That no energy is made."""
    return Row(
        quantity=f"largest growth of the energy, {name}, {run['dimension']}-D",
        measured=growth(run),
        reference=0.0,
        source="no forcing: energy never grows",
        lowest=-np.inf,
        highest=5e-6,
        absolute=True,
        note=f"spinning and vibrating; {run['energy'][-1] - 1.0:+.1%} after {DURATION} s",
        grid_cells=run["grid_cells"],
        particles=run["particles"],
    )


def draw(outcome: Outcome) -> Any:
    """Energy over time: rigid spin, and spin with vibration."""
    figure, (left, right) = blank(2, width=8.0)
    lines = ("-", "--")
    for (name, dimension), run in outcome.curves["spun"].items():
        line, colour = lines[dimension - 2], COLOURS[list(ELASTIC).index(name)]
        label = f"{name}, {dimension}-D"
        left.plot(run["time"], (run["energy"] - 1.0) * 1e3, line, color=colour, label=label)
    left.axhspan(-1.0, 0.0, color=GREY, alpha=0.12, linewidth=0)
    left.set(xlabel="time [s]", ylabel="change of energy [1/1000]", ylim=(-1.2, 0.2))
    left.set_title("spinning", fontsize=10)
    left.legend(fontsize=8, loc="lower left")
    names = list(ELASTIC | DISSIPATIVE)
    for (name, dimension), run in outcome.curves["shaken"].items():
        if dimension == 2:
            line = ":" if name == "fixed corotated" else "-"
            colour = COLOURS[names.index(name)]
            right.plot(run["time"], run["energy"], line, color=colour, label=name)
    right.set(xlabel="time [s]", ylabel="energy / initial", ylim=(0.0, 1.05))
    right.set_title("spinning and vibrating, 2-D", fontsize=10)
    right.legend(fontsize=8, loc="lower left")
    return figure


CASE = Case(
    name="energy",
    title="Energy in free flight",
    method="Without gravity or walls a block of 0.25 m of each material spins at 5 rad/s, rigidly "
    "or while it is sheared at 2 1/s; kinetic energy includes the affine motion m dx2 |C|2 / 8 and "
    "is centred in time (velocities half a step before and after).",
    measure=measure,
    draw=draw,
)
