"""Bodies of all six laws collide in mid-air: momentum stays, energy does not grow."""

import math
from typing import Any

import numpy as np
import torch

from benchmarks.verification.case import COLOURS, Case, Outcome, Row, blank
from benchmarks.verification.energy import DISSIPATIVE, ELASTIC, centred_energy, growth
from benchmarks.verification.world import World, block, make_scene
from giorom.mpm import Scene

SPEED, SIDE, AWAY = 1.0, 0.125, 0.2
DURATION, FRAME_DT = 0.2, 2.5e-3

Curve = dict[str, Any]


def six_bodies(spacing: float) -> Scene:
    """One block of each law on a circle, all flying at its centre."""
    laws = list((ELASTIC | DISSIPATIVE).values())
    parts, velocity, index = [], [], []
    for number, _ in enumerate(laws):
        angle = 2.0 * math.pi * number / len(laws)
        way = np.array([math.cos(angle), math.sin(angle)])
        low = 0.5 + AWAY * way - SIDE / 2.0
        points = block(tuple(low), tuple(low + SIDE), spacing)
        parts.append(points)
        velocity.append(np.tile(-SPEED * way + np.array([0.3, 0.2]), (len(points), 1)))
        index.append(np.full(len(points), number))
    scene = make_scene(
        np.concatenate(parts),
        spacing=spacing,
        material=laws[0],
        velocity=np.concatenate(velocity),
    )
    numbers = torch.from_numpy(np.concatenate(index))
    kinds = torch.tensor([law.particle_type for law in laws])[numbers]
    return Scene(
        **vars(scene)
        | {"materials": tuple(laws), "material_index": numbers, "particle_type": kinds}
    )


def collide(grid_cells: int) -> Curve:
    """Follow momentum, angular momentum and energy through the collision."""
    scene = six_bodies(0.5 / grid_cells)
    world = World(scene, grid_cells=grid_cells, frame_dt=FRAME_DT)
    scale = float((world.mass * np.linalg.norm(world.velocity, axis=1)).sum())
    time, momentum, turning, energy = [], [], [], []
    for frame in range(round(DURATION / FRAME_DT)):
        time.append(frame * FRAME_DT)
        momentum.append(world.mass @ world.velocity)
        turning.append(angular_momentum(world))
        energy.append(centred_energy(world))
        world.engine.advance(world.substeps - 1)
    return {
        "time": np.array(time),
        "momentum": np.linalg.norm(np.array(momentum) - momentum[0], axis=1) / scale,
        "turning": np.abs(np.array(turning) - turning[0]) / (scale * AWAY),
        "energy": np.array(energy) / energy[0],
        "position": world.position,
        "index": scene.material_index.numpy(),
        "reach": float(np.abs(world.position - 0.5).max()),
        "grid_cells": grid_cells,
        "particles": len(scene.position),
    }


def angular_momentum(world: World) -> float:
    """About the origin, with the affine part ``m dx^2 / 4 (C_10 - C_01)`` [kg m^2/s]."""
    x, v = world.position, world.velocity
    affine = world.engine.affine_velocity().double().numpy()
    inner = (affine[:, 1, 0] - affine[:, 0, 1]) / (4.0 * world.grid_cells**2)
    return float((world.mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + inner)).sum())


def measure(*, quick: bool = False) -> Outcome:
    """One collision."""
    run = collide(64 if quick else 128)
    here = {"grid_cells": run["grid_cells"], "particles": run["particles"]}
    common = {"reference": 0.0, "lowest": -math.inf, "absolute": True, **here}
    rows = [
        Row(
            quantity="largest change of momentum / sum of m |v|",
            measured=float(run["momentum"].max()),
            source="no outer force; float32",
            highest=1e-5,
            note="walls are out of reach",
            **common,
        ),
        Row(
            quantity="largest change of angular momentum / (sum of m |v| times 0.2 m)",
            measured=float(run["turning"].max()),
            source="no outer torque; float32",
            highest=1e-4,
            **common,
        ),
        Row(
            quantity="largest growth of the energy",
            measured=growth(run),
            source="no forcing: energy never grows",
            highest=5e-6,
            note=f"{run['energy'][-1]:.0%} left at the end",
            **common,
        ),
    ]
    return Outcome(rows=rows, curves={"run": run})


def draw(outcome: Outcome) -> Any:
    """The heap of bodies at the end, and what was conserved."""
    figure, (left, right) = blank(2, width=8.0)
    run = outcome.curves["run"]
    for number, name in enumerate(ELASTIC | DISSIPATIVE):
        x, y = run["position"][run["index"] == number].T
        left.plot(x, y, ".", color=COLOURS[number], markersize=1.5, label=name)
    left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    left.set_title(f"t = {DURATION} s", fontsize=10)
    left.legend(fontsize=7, markerscale=4)
    right.semilogy(run["time"], np.maximum(run["momentum"], 1e-9), label="momentum")
    right.semilogy(run["time"], np.maximum(run["turning"], 1e-9), "--", label="angular momentum")
    for line, colour in zip(right.lines, COLOURS, strict=False):
        line.set_color(colour)
    right.set(xlabel="time [s]", ylabel="relative change", ylim=(1e-9, 1e-4))
    twin = right.twinx()
    twin.plot(run["time"], run["energy"], ":", color="black")
    twin.set(ylabel="energy / initial (dotted)", ylim=(0.0, 1.05))
    right.legend(fontsize=8)
    return figure


CASE = Case(
    name="contact",
    title="Collision of six materials",
    method="Six blocks of 0.125 m, one of each law, fly at 1 m/s at one point, without gravity and "
    "away from walls; contact happens on the shared grid.",
    measure=measure,
    draw=draw,
)
