"""A scene of simple blocks, run frame by frame with everything a benchmark wants to measure.

The benchmarks need velocities, strains and energies beside the positions that ``simulate``
gives, so they drive the engine themselves, at the substeps that ``simulate`` would choose and
with its check that the state is finite. SI units; axis 1 points up; the box is ``[0, 1]^d``.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from giorom.mpm import Scene, SolverConfig
from giorom.mpm.boundary import walls_of
from giorom.mpm.shapes import lattice
from giorom.mpm.simulate import chosen_substeps

GRAVITY = 9.8
"""Downward acceleration of every benchmark that has one [m/s^2]."""


def block(lower: tuple[float, ...], upper: tuple[float, ...], spacing: float) -> np.ndarray:
    """Centres of equal cells that fill a box exactly along each axis, shape (p, d) [m]."""
    low, high = np.array(lower), np.array(upper)
    return lattice(tuple(high - low), spacing) + 0.5 * (low + high)


def make_scene(
    points: np.ndarray,
    *,
    spacing: float,
    material: Any,
    velocity: np.ndarray | None = None,
    gradient: np.ndarray | None = None,
    bounds: np.ndarray | None = None,
    **others: Any,
) -> Scene:
    """A scene of one material.

    Args:
        points: Positions [m].
        spacing: Distance of neighbours; a particle stands for a cube of that side [m].
        material: Constitutive law.
        velocity: Initial velocities, at rest if left out [m/s].
        gradient: Velocity gradient of every particle [1/s].
        bounds: Lower and upper wall on each axis, a sixteenth from the sides if left out [m].
        others: Fields of ``Scene``: gravity, wall_contact, clamp_plane ...

    Returns:
        The scene.
    """
    count, dimension = points.shape
    at_rest = np.zeros((count, dimension))
    affine = np.zeros((dimension, dimension)) if gradient is None else gradient
    bounds = np.array([[0.0625, 0.9375]] * dimension) if bounds is None else bounds
    return Scene(
        position=torch.from_numpy(points).float(),
        velocity=torch.from_numpy(at_rest if velocity is None else velocity).float(),
        affine_velocity=torch.from_numpy(affine).float().repeat(count, 1, 1),
        volume=torch.full((count,), spacing**dimension),
        particle_type=torch.full((count,), material.particle_type),
        materials=(material,),
        material_index=torch.zeros(count, dtype=torch.int64),
        bounds=torch.from_numpy(bounds).float(),
        **others,
    )


class World:
    """One running scene."""

    def __init__(self, scene: Scene, *, grid_cells: int, frame_dt: float) -> None:
        """Start a scene.

        Args:
            scene: What to simulate.
            grid_cells: Cells per axis.
            frame_dt: Time between measurements [s].
        """
        from giorom.mpm.engine import Engine

        solver = SolverConfig(grid_cells=grid_cells, frame_dt=frame_dt, frames=1)
        self.scene, self.grid_cells, self.frame_dt = scene, grid_cells, frame_dt
        self.walls = walls_of(scene, grid_cells)
        self.substeps = chosen_substeps(scene, solver)
        self.engine = Engine(scene, self.walls, substep_dt=frame_dt / self.substeps, device="cpu")
        self.time = 0.0

    @property
    def mass(self) -> np.ndarray:
        """Mass of each particle [kg]."""
        return self.scene.mass.double().numpy()

    @property
    def position(self) -> np.ndarray:
        """Positions [m]."""
        return self.engine.position().double().numpy()

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s]."""
        return self.engine.velocity().double().numpy()

    @property
    def strain(self) -> torch.Tensor:
        """Strain variable of the first material in float64: ``b`` of a solid, ``J`` of a fluid."""
        return self.engine.strain().double()

    def frames(self, count: int) -> Iterator[float]:
        """Advance frame by frame and give the time, the initial one included [s].

        Raises:
            RuntimeError: If the state is no longer finite.
        """
        yield self.time
        for _ in range(count - 1):
            self.engine.advance(self.substeps)
            self.time += self.frame_dt
            if not np.isfinite(self.velocity).all():
                raise RuntimeError(f"a benchmark blew up at t = {self.time:g} s")
            yield self.time

    def kinetic_energy(self) -> float:
        """Kinetic energy of the particles and of their affine motion ``m dx^2 |C|^2 / 8`` [J]."""
        affine = self.engine.affine_velocity().double().numpy()
        per_mass = (self.velocity**2).sum(1) + (affine**2).sum((1, 2)) / (4 * self.grid_cells**2)
        return float(0.5 * (self.mass * per_mass).sum())

    def elastic_energy(self) -> float:
        """Stored elastic energy above that of the undeformed body [J]."""
        total = 0.0
        for index, law in enumerate(self.scene.materials):
            strain = self.engine.strain(index).double()
            rest = torch.ones(1, dtype=torch.float64)
            if strain.ndim == 3:
                rest = torch.eye(strain.shape[-1], dtype=torch.float64)
            volume = self.scene.volume.double()[self.scene.material_index == index]
            total += float((volume * (law.energy(strain) - law.energy(rest))).sum())
        return total

    def potential_energy(self) -> float:
        """Energy in the field of gravity, zero at the height zero [J]."""
        return float(self.scene.gravity * (self.mass * self.position[:, 1]).sum())
