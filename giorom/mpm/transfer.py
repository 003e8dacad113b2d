"""Move mass and momentum between particles and grid: the kernels of the simulator.

Explicit MLS-MPM with APIC transfers and quadratic B-splines on a collocated grid of the
unit box. One substep is three kernels: particles to grid (stress fused in), grid update
(gravity and walls), grid to particles (position and strain). Everything is float32 and SI;
the same source runs on the CPU and on CUDA, in two and in three dimensions.

Solids carry ``b = F F^T`` and not ``F``: an isotropic stress depends on ``b`` alone and a
rotation then costs nothing. Fluids carry the scalar ``J``.

Invariants: a transfer conserves mass, momentum and angular momentum (its affine part
included); kinematic particles never move; no index ever leaves the grid.

Source:
    Hu et al., "A Moving Least Squares Material Point Method", SIGGRAPH 2018; Jiang et al.,
    "The Affine Particle-In-Cell Method", SIGGRAPH 2015.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any, no_type_check

# Warp compiles a kernel from its source and resolves names in the module's globals; this
# module is imported only inside the function that simulates.
import warp as wp  # noqa: TID253

wp.config.log_level = wp.LOG_WARNING


@no_type_check
def _solid_law(dimension: int) -> SimpleNamespace:
    """Stress and strain update of the stable neo-Hookean solid; the state is ``b``."""
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    out_of_plane = float(3 - dimension)

    @wp.func
    def stress(b: matrix, parameters: wp.vec3):
        volume_ratio = wp.sqrt(wp.max(wp.determinant(b), 0.0))
        invariant = wp.trace(b) + wp.static(out_of_plane)
        shear = parameters[0] * (1.0 - 1.0 / (invariant + 1.0))
        pressure = parameters[1] * volume_ratio * (volume_ratio - parameters[2])
        return shear * b + pressure * wp.identity(n=dimension, dtype=float)

    @wp.func
    def advance(b: matrix, gradient: matrix, dt: float):
        growth = wp.identity(n=dimension, dtype=float) + dt * gradient
        return growth * b * wp.transpose(growth)

    return SimpleNamespace(state=matrix, stress=stress, advance=advance)


@no_type_check
def _fluid_law(dimension: int) -> SimpleNamespace:
    """Pressure and volume update of the weakly compressible fluid; the state is ``J``."""
    matrix = wp.types.matrix((dimension, dimension), dtype=float)

    @wp.func
    def stress(volume_ratio: float, parameters: wp.vec3):
        pressure = parameters[0] * volume_ratio * (volume_ratio - 1.0)
        return pressure * wp.identity(n=dimension, dtype=float)

    @wp.func
    def advance(volume_ratio: float, gradient: matrix, dt: float):
        return volume_ratio * (1.0 + dt * wp.trace(gradient))

    return SimpleNamespace(state=float, stress=stress, advance=advance)


LAWS = {"stable_neo_hookean": _solid_law, "weakly_compressible_fluid": _fluid_law}
"""Device form of each material of :mod:`giorom.mpm.materials`, by its name."""


@no_type_check
def _stencil(dimension: int) -> SimpleNamespace:
    """Spline weights and node numbers of the 3^d nodes around a particle."""
    vector = wp.types.vector(dimension, dtype=float)
    node_index = wp.types.vector(dimension, dtype=int)
    weights = wp.types.matrix((3, dimension), dtype=float)

    @wp.func
    def base_node(x: vector, cells: int):
        base = node_index()
        for axis in range(dimension):
            # x / dx - 1/2 is positive inside the walls; the clamp keeps a lost particle from
            # reading out of bounds until the guard of the frame reports it.
            base[axis] = wp.clamp(int(x[axis] * float(cells) - 0.5), 0, cells - 3)
        return base

    @wp.func
    def offset(x: vector, base: node_index, cells: int):
        fraction = vector()
        for axis in range(dimension):
            fraction[axis] = wp.clamp(x[axis] * float(cells) - float(base[axis]), 0.5, 1.5)
        return fraction

    @wp.func
    def spline(fraction: vector):
        w = weights()
        for axis in range(dimension):
            f = fraction[axis]
            w[0, axis] = 0.5 * (1.5 - f) * (1.5 - f)
            w[1, axis] = 0.75 - (f - 1.0) * (f - 1.0)
            w[2, axis] = 0.5 * (f - 0.5) * (f - 0.5)
        return w

    return SimpleNamespace(base_node=base_node, offset=offset, spline=spline)


@no_type_check
def _particles_to_grid(dimension: int, law: SimpleNamespace, module: Any) -> Any:
    """The kernel that adds mass and momentum of every particle to its 3^d nodes."""
    vector = wp.types.vector(dimension, dtype=float)
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    node = wp.types.vector(dimension + 1, dtype=float)
    around = _stencil(dimension)
    base_node, offset, spline, stress = around.base_node, around.offset, around.spline, law.stress
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def particles_to_grid(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        affine: wp.array(dtype=matrix),
        state: wp.array(dtype=law.state),
        volume: wp.array(dtype=float),
        held: wp.array(dtype=wp.uint8),
        density: float,
        parameters: wp.vec3,
        dt: float,
        cells: int,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
        if held[p] != wp.uint8(0):
            return  # at rest and unstrained; its mass would drag on nodes above the clamp
        dx = 1.0 / float(cells)
        base = base_node(x[p], cells)
        fraction = offset(x[p], base, cells)
        w = spline(fraction)
        mass = density * volume[p]
        # momentum of node i: w (m v + A (i - f) dx) = w (start + step i)
        step = (mass * dx) * affine[p] - (4.0 * dt * volume[p] / dx) * stress(state[p], parameters)
        start = mass * v[p] - step * fraction
        for i in range(3):
            for j in range(3):
                for k in range(wp.static(layers)):
                    weight = w[i, 0] * w[j, 1]
                    number = (base[0] + i) * cells + base[1] + j
                    where = vector()
                    where[0] = float(i)
                    where[1] = float(j)
                    if wp.static(dimension == 3):
                        weight = weight * w[k, 2]
                        number = number * cells + base[2] + k
                        where[2] = float(k)
                    momentum = weight * (start + step * where)
                    value = node()
                    for axis in range(dimension):
                        value[axis] = momentum[axis]
                    value[dimension] = weight * mass
                    wp.atomic_add(grid, number, value)

    return particles_to_grid


@no_type_check
def _grid_update(dimension: int, module: Any) -> Any:
    """The kernel that turns momentum into velocity and applies gravity and walls."""
    vector = wp.types.vector(dimension, dtype=float)
    node = wp.types.vector(dimension + 1, dtype=float)

    @wp.kernel(module=module, enable_backward=False)
    def grid_update(  # noqa: PLR0917
        grid: wp.array(dtype=node),
        gravity: vector,
        dt: float,
        cells: int,
        lower: wp.vec3i,
        upper: wp.vec3i,
        sticking: int,
        clamp_node: int,
    ):
        number = wp.tid()
        value = grid[number]
        mass = value[dimension]
        if mass > 0.0:
            remainder = number
            stopped = bool(False)  # noqa: UP018  (a constant could not change in a kernel)
            for back in range(dimension):
                axis = dimension - 1 - back
                i = remainder % cells
                remainder = remainder / cells
                speed = value[axis] / mass + dt * gravity[axis]
                if (i <= lower[axis] and speed < 0.0) or (i >= upper[axis] and speed > 0.0):
                    speed = 0.0
                    stopped = True
                value[axis] = speed
            height = number % cells
            if wp.static(dimension == 3):
                height = (number / cells) % cells
            if height <= clamp_node or (stopped and sticking != 0):
                for axis in range(dimension):
                    value[axis] = 0.0
            grid[number] = value

    return grid_update


@no_type_check
def _grid_to_particles(dimension: int, law: SimpleNamespace, module: Any) -> Any:
    """The kernel that reads velocity back and moves and strains every free particle."""
    vector = wp.types.vector(dimension, dtype=float)
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    node = wp.types.vector(dimension + 1, dtype=float)
    around = _stencil(dimension)
    base_node, offset, spline, advance = around.base_node, around.offset, around.spline, law.advance
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def grid_to_particles(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        affine: wp.array(dtype=matrix),
        state: wp.array(dtype=law.state),
        held: wp.array(dtype=wp.uint8),
        dt: float,
        cells: int,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
        if held[p] != wp.uint8(0):
            return
        base = base_node(x[p], cells)
        fraction = offset(x[p], base, cells)
        w = spline(fraction)
        velocity = vector()
        moment = matrix()
        for i in range(3):
            for j in range(3):
                for k in range(wp.static(layers)):
                    weight = w[i, 0] * w[j, 1]
                    number = (base[0] + i) * cells + base[1] + j
                    where = vector()
                    where[0] = float(i)
                    where[1] = float(j)
                    if wp.static(dimension == 3):
                        weight = weight * w[k, 2]
                        number = number * cells + base[2] + k
                        where[2] = float(k)
                    value = grid[number]
                    part = vector()
                    for axis in range(dimension):
                        part[axis] = weight * value[axis]
                    velocity = velocity + part
                    moment = moment + wp.outer(part, where)
        # C = (4 / dx^2) sum w v (i - f)^T dx
        gradient = (4.0 * float(cells)) * (moment - wp.outer(velocity, fraction))
        v[p] = velocity
        affine[p] = gradient
        x[p] = x[p] + dt * velocity
        state[p] = advance(state[p], gradient, dt)

    return grid_to_particles


@cache
@no_type_check
def build_kernels(dimension: int, law_name: str) -> SimpleNamespace:
    """The three kernels of one substep for a dimension and a material.

    Args:
        dimension: 2 (plane strain) or 3.
        law_name: A key of ``LAWS``.

    Returns:
        ``particles_to_grid``, ``grid_update``, ``grid_to_particles`` and ``state``, the
        type of the strain variable.
    """
    law = LAWS[law_name](dimension)
    module = wp.get_module(f"giorom_mpm_{law_name}_{dimension}d")
    return SimpleNamespace(
        particles_to_grid=_particles_to_grid(dimension, law, module),
        grid_update=_grid_update(dimension, module),
        grid_to_particles=_grid_to_particles(dimension, law, module),
        state=law.state,
    )
