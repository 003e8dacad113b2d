"""Hold the particles of a run on a device and advance them by whole frames.

The only module that launches the kernels of ``transfer.py``; imported when a simulation
starts. The substeps of a frame are recorded once and replayed where the device allows it.
"""

import os
from typing import Any

import torch
import warp as wp  # noqa: TID253  (only imported by a running simulation)
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.boundary import Walls
from giorom.mpm.scenes import Scene
from giorom.mpm.transfer import build_kernels


class Engine:
    """State of one running simulation; float32 on ``device``."""

    def __init__(self, scene: Scene, walls: Walls, *, substep_dt: float, device: str) -> None:
        self.substep_dt = substep_dt
        self._count, self._dimension = scene.position.shape
        self._cells = walls.grid_cells
        self._material = scene.material
        self._device = _open_device(device)
        self._kernels = build_kernels(self._dimension, scene.material.name)
        # Compiled here and not by the first launch, so that a run's clock measures the run alone.
        wp.load_module(self._kernels.particles_to_grid.module, device=self._device)
        self._graphs: dict[int, Any] = {}
        self._walls = self._wall_arguments(walls)
        self._gravity = [-scene.gravity if axis == 1 else 0.0 for axis in range(self._dimension)]
        self._allocate(scene)

    @property
    def attributes(self) -> dict[str, Any]:
        """What ran: engine version and device."""
        return {"warp_version": wp.config.version, "device": self._device.alias}

    def position(self) -> Float[Tensor, "p d"]:
        """Copy of the positions, on the CPU [m]."""
        return torch.from_numpy(self._x.numpy()).clone()

    def velocity(self) -> Float[Tensor, "p d"]:
        """Copy of the velocities, on the CPU [m/s]."""
        return torch.from_numpy(self._v.numpy()).clone()

    def affine_velocity(self) -> Float[Tensor, "p d d"]:
        """Copy of the affine velocities C, on the CPU [1/s]."""
        return torch.from_numpy(self._affine.numpy()).clone()

    def strain(self) -> Float[Tensor, "p *shape"]:
        """Copy of the strain variable: ``b`` of a solid, ``J`` of a fluid."""
        return torch.from_numpy(self._strain.numpy()).clone()

    def grid(self) -> Float[Tensor, "n k"]:
        """Copy of the grid: d components of velocity and the mass of each node."""
        return torch.from_numpy(self._grid.numpy()).clone()

    def advance(self, substeps: int) -> None:
        """Advance by a number of substeps.

        Args:
            substeps: How many; each number is recorded once.
        """
        if substeps not in self._graphs:
            self._graphs[substeps] = self._record(substeps)
        graph = self._graphs[substeps]
        if graph is None:
            self._run(substeps)
        else:
            wp.capture_launch(graph)

    def _record(self, substeps: int) -> Any:
        """Record the launches of some substeps; ``None`` where the device cannot."""
        try:
            with wp.ScopedCapture(device=self._device) as capture:
                self._run(substeps)
        except (RuntimeError, NotImplementedError):
            return None
        return capture.graph

    def _run(self, substeps: int) -> None:
        for _ in range(substeps):
            self._grid.zero_()
            for kernel, size, arguments in self._launches:
                wp.launch(kernel, dim=size, inputs=arguments, device=self._device)

    def _allocate(self, scene: Scene) -> None:
        """Copy the scene to the device and fix the arguments of the three launches."""
        d, device = self._dimension, self._device
        vector, matrix = wp.types.vector(d, dtype=float), wp.types.matrix((d, d), dtype=float)
        node = wp.types.vector(d + 1, dtype=float)
        self._x = self._array(scene.position, vector)
        self._v = self._array(scene.velocity, vector)
        self._affine = self._array(scene.affine_velocity, matrix)
        volume = self._array(scene.volume, float)
        held = wp.array(scene.kinematic.numpy().astype("uint8"), dtype=wp.uint8, device=device)
        rest = torch.ones(self._count)
        if self._kernels.state is not float:
            rest = torch.eye(d).expand(self._count, d, d)
        self._strain = self._array(rest, self._kernels.state)
        self._grid = wp.zeros(self._cells**d, dtype=node, device=device)
        dt, cells, density = self.substep_dt, self._cells, self._material.density
        constants = wp.vec3(*self._material.law_constants)
        particles = [self._x, self._v, self._affine, self._strain]
        kernels = self._kernels
        self._launches = [
            (
                kernels.particles_to_grid,
                self._count,
                [*particles, volume, held, density, constants, dt, cells, self._grid],
            ),
            (
                kernels.grid_update,
                cells**d,
                [self._grid, vector(*self._gravity), dt, cells, *self._walls],
            ),
            (kernels.grid_to_particles, self._count, [*particles, held, dt, cells, self._grid]),
        ]

    def _array(self, values: Tensor, dtype: Any) -> Any:
        return wp.array(values.float().contiguous().numpy(), dtype=dtype, device=self._device)

    def _wall_arguments(self, walls: Walls) -> tuple[Any, Any, int, int]:
        padding = (0,) * (3 - self._dimension)
        return (
            wp.vec3i(*walls.lower, *padding),
            wp.vec3i(*walls.upper, *padding),
            int(walls.sticking),
            walls.clamp_node,
        )


def _open_device(name: str) -> Any:
    """Start Warp, without its complaint about a missing GPU where none is asked for.

    Raises:
        ValueError: If there is no such device.
    """
    if name == "cpu":
        complaints = os.dup(2)
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(complaints, 2)
            os.close(complaints)
    try:
        return wp.get_device(name)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"there is no device {name!r} to simulate on ({error}). Use 'cpu', or 'cuda' on a "
            f"machine with an NVIDIA GPU."
        ) from error
