"""Hold the particles of a run on a device and advance them by whole frames.

The only module that launches the kernels of ``transfer.py``; imported when a simulation
starts. Particles are kept sorted by material (held ones last within each), so that every law
runs on a contiguous range; what is read back is in the order of the scene. The substeps of a
frame are recorded once and replayed where the device allows it.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp  # noqa: TID253  (only imported by a running simulation)
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.boundary import Walls
from giorom.mpm.device_laws import FAMILIES, LAW_CONSTANTS, Constants
from giorom.mpm.materials import Material
from giorom.mpm.scene import Scene
from giorom.mpm.transfer import build_grid_kernels, build_law_kernels
from giorom.warp_start import start_warp

MOST_RECORDED = 100
"""Most substeps recorded together: recording one costs the time of some, replaying nothing."""


@dataclass(kw_only=True)
class _Group:
    """The particles of one material, a contiguous range of the sorted ones."""

    start: int
    stop: int
    moving: int
    """How many of them move; they come first."""

    kernels: Any
    constants: Any
    state: Any
    volume_correction: Any


class Engine:
    """State of one running simulation; float32 on ``device``."""

    def __init__(self, scene: Scene, walls: Walls, *, substep_dt: float, device: str) -> None:
        self.substep_dt = substep_dt
        self._count, self._dimension = scene.position.shape
        self._cells = walls.grid_cells
        self._device = _open_device(device)
        self._kernels = build_grid_kernels(self._dimension)
        self._load_kernels(scene)
        self._graphs: dict[int, Any] = {}
        self._walls = self._wall_arguments(walls)
        self._gravity = [-scene.gravity if axis == 1 else 0.0 for axis in range(self._dimension)]
        self._order = torch.argsort(2 * scene.material_index + scene.kinematic.long(), stable=True)
        self._place = torch.argsort(self._order)
        self._allocate(scene)
        self._groups = [self._group(scene, index) for index in range(len(scene.materials))]
        self._launches = self._plan()

    @property
    def attributes(self) -> dict[str, Any]:
        """What ran: engine version and device."""
        return {"warp_version": wp.config.version, "device": self._device.alias}

    def position(self) -> Float[Tensor, "p d"]:
        """Copy of the positions, on the CPU [m]."""
        return torch.from_numpy(self._x.numpy())[self._place]

    def velocity(self) -> Float[Tensor, "p d"]:
        """Copy of the velocities, on the CPU [m/s]."""
        return torch.from_numpy(self._v.numpy())[self._place]

    def affine_velocity(self) -> Float[Tensor, "p d d"]:
        """Copy of the affine velocities C, on the CPU [1/s]."""
        return torch.from_numpy(self._affine.numpy())[self._place]

    def strain(self, material_index: int = 0) -> Float[Tensor, "m *shape"]:
        """Copy of the strain variable of one material's particles, in the order of the scene.

        Args:
            material_index: Index into the scene's materials.

        Returns:
            ``b`` of a solid (its elastic part), ``J`` of a fluid.
        """
        return torch.from_numpy(self._groups[material_index].state.numpy())[
            self._group_place(material_index)
        ]

    def volume_correction(self, material_index: int = 0) -> Float[Tensor, " m"]:
        """Logarithm of the volume gained by the particles of one material; zero but in sand."""
        group = self._groups[material_index]
        if not group.kernels.remembers_volume:
            return torch.zeros(group.stop - group.start)
        return torch.from_numpy(group.volume_correction.numpy())[self._group_place(material_index)]

    def grid(self) -> Float[Tensor, "n k"]:
        """Copy of the grid: d components of velocity and the mass of each node."""
        return torch.from_numpy(self._grid.numpy()).clone()

    def advance(self, substeps: int) -> None:
        """Advance by a number of substeps.

        Args:
            substeps: How many; recorded in groups of up to ``MOST_RECORDED``.
        """
        whole, rest = divmod(substeps, MOST_RECORDED)
        for count in [MOST_RECORDED] * whole + [rest] * (rest > 0):
            self._replay(count)

    def _replay(self, substeps: int) -> None:
        """Advance by a number of substeps that is recorded when it is first asked for."""
        if substeps not in self._graphs:
            self._graphs[substeps] = self._record(substeps)
        graph = self._graphs[substeps]
        if graph is None:
            self._run(substeps)
        else:
            wp.capture_launch(graph)

    def switch(self, material_index: int, material: Material) -> None:
        """Let the particles of one material follow another law from now on.

        Args:
            material_index: Index into the scene's materials.
            material: Law that carries the same strain variable.
        """
        group = self._groups[material_index]
        self._adopt(group, material)
        self._graphs.clear()
        self._launches = self._plan()

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

    def _load_kernels(self, scene: Scene) -> None:
        """Compile before the first launch, so that a run's clock measures the run alone."""
        modules = {self._kernels.module: None}
        for law in scene.laws:
            if law.name not in FAMILIES:
                raise ValueError(
                    f"there is no kernel for the material {law.name!r}; it cannot be simulated. "
                    f"Materials that can: {', '.join(FAMILIES)}."
                )
            modules[build_law_kernels(FAMILIES[law.name], self._dimension).module] = None
        for module in modules:
            wp.load_module(module, device=self._device)

    def _allocate(self, scene: Scene) -> None:
        """Copy the particles to the device, sorted, and make room for the grid."""
        d = self._dimension
        vector, matrix = wp.types.vector(d, dtype=float), wp.types.matrix((d, d), dtype=float)
        node = wp.types.vector(d + 1, dtype=float)
        self._x = self._array(scene.position[self._order], vector)
        self._v = self._array(scene.velocity[self._order], vector)
        self._affine = self._array(scene.affine_velocity[self._order], matrix)
        self._stress = self._array(torch.zeros(self._count, d, d), matrix)
        self._volume = self._array(scene.volume[self._order], float)
        self._mass = self._array(scene.mass[self._order], float)
        self._grid = wp.zeros(self._cells**d, dtype=node, device=self._device)

    def _group(self, scene: Scene, index: int) -> _Group:
        """The range of one material, at rest."""
        own, d = scene.material_index == index, self._dimension
        count, start = int(own.sum()), int((scene.material_index < index).sum())
        rest = torch.ones(count)
        if scene.materials[index].state == "b":
            rest = torch.eye(d).expand(count, d, d)
        group = _Group(
            start=start,
            stop=start + count,
            moving=int((own & ~scene.kinematic).sum()),
            kernels=None,
            constants=None,
            state=None,
            volume_correction=None,
        )
        kernels = build_law_kernels(FAMILIES[scene.materials[index].name], d)
        group.state = self._array(rest, kernels.state)
        self._adopt(group, scene.materials[index])
        return group

    def _adopt(self, group: _Group, material: Material) -> None:
        """Give a group its law, and its particles the stress that the law gives their strain."""
        group.kernels = build_law_kernels(FAMILIES[material.name], self._dimension)
        given = material.law_constants(self._dimension)
        group.constants = Constants(*given, *[0.0] * (LAW_CONSTANTS - len(given)))
        room = group.stop - group.start if group.kernels.remembers_volume else 1
        group.volume_correction = wp.zeros(room, dtype=float, device=self._device)
        if group.moving == 0:
            return
        stress = self._stress[group.start : group.start + group.moving]
        arguments = [stress, group.state, group.volume_correction, group.constants]
        wp.launch(group.kernels.settle, dim=group.moving, inputs=arguments, device=self._device)

    def _plan(self) -> list[tuple[Any, int, list[Any]]]:
        """Kernels of one substep with their sizes and arguments, in order."""
        grid = [self.substep_dt, self._cells, self._grid]
        gravity = wp.types.vector(self._dimension, dtype=float)(*self._gravity)
        to_grid, to_particles = [], []
        for group in self._groups:
            if group.moving == 0:
                continue
            own = slice(group.start, group.start + group.moving)
            moving = [each[own] for each in (self._x, self._v, self._affine, self._stress)]
            weight = [self._volume[own], self._mass[own]]
            law = [group.state, group.volume_correction, group.constants]
            to_grid.append(
                (self._kernels.particles_to_grid, group.moving, [*moving, *weight, *grid])
            )
            to_particles.append(
                (group.kernels.grid_to_particles, group.moving, [*moving, *law, *grid])
            )
        update = (
            self._kernels.grid_update,
            self._cells**self._dimension,
            [self._grid, gravity, self.substep_dt, self._cells, *self._walls],
        )
        return [*to_grid, update, *to_particles]

    def _group_place(self, material_index: int) -> Tensor:
        """Where the particles of a material are within its range, in the order of the scene."""
        group = self._groups[material_index]
        return torch.argsort(self._order[group.start : group.stop])

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
    """Start Warp and find a device.

    Raises:
        ValueError: If there is no such device.
    """
    start_warp(name)
    try:
        return wp.get_device(name)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"there is no device {name!r} to simulate on ({error}). Use 'cpu', or 'cuda' on a "
            f"machine with an NVIDIA GPU."
        ) from error
