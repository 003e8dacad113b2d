"""Columns and heaps of dry sand, and what is measured on a deposit.

Sand starts on a jittered lattice: on a regular one of four particles per cell the columns of
particles stay in phase, merge while they fall, and a pile ends up with 8 % too little volume.
"""

import math
from typing import Any

import numpy as np

from benchmarks.verification.world import GRAVITY, World, block, make_scene
from giorom.mpm import DruckerPragerSand

DENSITY, YOUNG, POISSON = 1500.0, 1e6, 0.3
THIN = 0.05
"""Depth of sand, in widths of the column, that belongs to the deposit; thinner is a few
particles here and loose grains in an experiment."""

BIN = 0.1
"""Width of the strips in which depth is measured, in widths of the column."""

MOST_STRIPS = 140
FRAMES_PER_UNIT = 4

Curve = dict[str, Any]


def sand(friction_angle: float, *, volume_correction: bool = True) -> DruckerPragerSand:
    """The sand of every benchmark."""
    return DruckerPragerSand(
        density=DENSITY,
        youngs_modulus=YOUNG,
        poissons_ratio=POISSON,
        friction_angle=friction_angle,
        volume_correction=volume_correction,
    )


def jittered(points: np.ndarray, spacing: float, *, seed: int = 0) -> np.ndarray:
    """Points moved by up to a quarter of their spacing along each axis."""
    generator = np.random.default_rng(seed)
    return points + 0.25 * spacing * generator.uniform(-1.0, 1.0, points.shape)


def come_to_rest(
    points: np.ndarray, *, grid_cells: int, floor: float, until: float, height: float, **law: Any
) -> tuple[World, np.ndarray]:
    """Let sand go on a sticking floor and wait until it rests.

    Args:
        points: Positions on a lattice of half a cell [m].
        grid_cells: Cells per axis.
        floor: Height of the floor [m].
        until: How long to wait, in units of ``sqrt(height / g)``.
        height: Height of the column [m].
        law: Arguments of ``sand``.

    Returns:
        The world at rest, and where the particles started.
    """
    spacing = 0.5 / grid_cells
    start = jittered(points, spacing)
    side = 3.0 / grid_cells
    bounds = np.array([[side, 1.0 - side]] * points.shape[1])
    bounds[1, 0] = floor
    scene = make_scene(
        start,
        spacing=spacing,
        material=sand(**law),
        bounds=bounds,
        gravity=GRAVITY,
        wall_contact="stick",
    )
    frame_dt = math.sqrt(height / GRAVITY) / FRAMES_PER_UNIT
    world = World(scene, grid_cells=grid_cells, frame_dt=frame_dt)
    for _ in world.frames(round(until * FRAMES_PER_UNIT) + 1):
        pass
    return world, start


def column_2d(
    aspect: float, *, grid_cells: int, width_cells: int, until: float = 5.0, **law: Any
) -> Curve:
    """Collapse of a column ``d0`` wide beside a plane of symmetry.

    The column is twice as wide and spreads to both sides: its middle is a frictionless wall,
    and two sides tell how far chance goes.

    Args:
        aspect: Height over ``d0``.
        grid_cells: Cells per axis.
        width_cells: ``d0`` in cells.
        until: When to stop, in units of ``sqrt(max(height, d0) / g)``.
        law: Friction angle and so on.

    Returns:
        Lengths in units of ``d0``: run-out of each side, height, depth over distance, and
        the volume of the deposit over that of the column.
    """
    spacing, width = 0.5 / grid_cells, width_cells / grid_cells
    height, floor = round(aspect * width / spacing) * spacing, 8.0 / grid_cells
    points = block((0.5 - width, floor), (0.5 + width, floor + height), spacing)
    world, _ = come_to_rest(
        points,
        grid_cells=grid_cells,
        floor=floor,
        until=until,
        height=max(height, width),
        **law,
    )
    across = (world.position[:, 0] - 0.5) / width
    up = (world.position[:, 1] - floor) / width
    piece = (spacing / width) ** 2
    sides = [deposit(side * across, up, piece=piece) for side in (1.0, -1.0)]
    return {
        "aspect": aspect,
        "runout": [side["reach"] - 1.0 for side in sides],
        "height": summit(np.abs(across), up, spacing / width),
        "volume": sum(side["area"] for side in sides) / (2.0 * height / width),
        "distance": sides[0]["distance"],
        "depth": np.mean([side["depth"] for side in sides], axis=0),
        "position": np.stack([across, up], axis=1),
        "fastest": float(np.linalg.norm(world.velocity, axis=1).max()),
        "grid_cells": grid_cells,
        "particles": len(points),
        "law": law,
    }


def deposit(across: np.ndarray, up: np.ndarray, *, piece: float) -> Curve:
    """Depth of one side of a deposit over the distance, its reach, and the area it covers.

    Args:
        across: Distance from the middle; other side negative.
        up: Height over the floor.
        piece: Area of a particle.

    Returns:
        ``depth`` counts particles; ``area`` is that under the surface they form.
    """
    strip = np.floor(across / BIN).astype(int)
    depth = np.bincount(strip[strip >= 0], minlength=MOST_STRIPS) * piece / BIN
    reach = edge(np.convolve(depth, np.ones(3) / 3.0, "same"))
    length = round(reach / BIN)
    # 95 % of the particles of a strip of even depth are below 95 % of it.
    surface = [
        np.quantile(up[strip == k], 0.95) / 0.95 if depth[k] > 0.0 else 0.0 for k in range(length)
    ]
    return {
        "distance": (np.arange(len(depth)) + 0.5) * BIN,
        "depth": depth,
        "reach": reach,
        "area": float(np.sum(surface)) * BIN,
    }


def edge(depth: np.ndarray) -> float:
    """Where the depth of strips first falls to ``THIN``, between the middles of two strips."""
    outer = int(np.flatnonzero((depth < THIN) & (np.arange(len(depth)) > 1))[0])
    above, below = float(depth[outer - 1]), float(depth[outer])
    return (outer - 0.5 + (above - THIN) / (above - below)) * BIN


def summit(distance: np.ndarray, up: np.ndarray, spacing: float) -> float:
    """Height of the middle of a deposit."""
    return float(np.quantile(up[distance < 2.0 * BIN], 0.99) + spacing / 2.0)
