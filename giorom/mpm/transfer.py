# Warp needs float(0.0) to declare a variable that is assigned again.
# ruff: noqa: UP018
"""Move mass and momentum between particles and grid: the kernels of the simulator.

Explicit MLS-MPM with APIC transfers and quadratic B-splines on a collocated grid of the
unit box. One substep is three kinds of kernel: particles to grid, grid update (gravity and
walls), grid to particles (position, strain and stress). The last kind is made for each law of
``device_laws.py`` and launched on the particles of that law, so that none of them asks which
material it is. Everything is float32 and SI; the same source runs on the CPU and on CUDA, in
two and in three dimensions.

Solids carry ``b = F F^T`` and not ``F``: an isotropic stress depends on ``b`` alone and a
rotation then costs nothing. Fluids carry the scalar ``J``. The stress of a substep is found
where its strain is, after the return map, and kept for the next particles to grid.

Invariants: a transfer conserves mass, momentum and angular momentum (its affine part
included); no index ever leaves the grid. Kinematic particles are not launched on at all.

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

from giorom.mpm.device_laws import Constants, build_law

wp.config.log_level = wp.LOG_WARNING


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
def _particles_to_grid(dimension: int, module: Any) -> Any:
    """The kernel that adds mass and momentum of every particle to its 3^d nodes."""
    vector = wp.types.vector(dimension, dtype=float)
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    node = wp.types.vector(dimension + 1, dtype=float)
    around = _stencil(dimension)
    base_node, offset, spline = around.base_node, around.offset, around.spline
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def particles_to_grid(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        affine: wp.array(dtype=matrix),
        stress: wp.array(dtype=matrix),
        volume: wp.array(dtype=float),
        masses: wp.array(dtype=float),
        dt: float,
        cells: int,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
        dx = 1.0 / float(cells)
        base = base_node(x[p], cells)
        fraction = offset(x[p], base, cells)
        w = spline(fraction)
        mass = masses[p]
        # momentum of node i: w (m v + A (i - f) dx) = w (start + step i)
        step = (mass * dx) * affine[p] - (4.0 * dt * volume[p] / dx) * stress[p]
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
            stopped = bool(False)
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
    base_node, offset, spline = around.base_node, around.offset, around.spline
    transport, respond, remembers_volume = law.transport, law.respond, law.remembers_volume
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def grid_to_particles(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        affine: wp.array(dtype=matrix),
        stress: wp.array(dtype=matrix),
        state: wp.array(dtype=law.state),
        volume_correction: wp.array(dtype=float),
        constants: Constants,
        dt: float,
        cells: int,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
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
        correction = float(0.0)
        if wp.static(remembers_volume):
            correction = volume_correction[p]
        kept, correction, tau = respond(
            transport(state[p], gradient, dt), correction, constants, dt
        )
        state[p] = kept
        stress[p] = tau
        if wp.static(remembers_volume):
            volume_correction[p] = correction

    return grid_to_particles


@no_type_check
def _settle(law: SimpleNamespace, module: Any) -> Any:
    """The kernel that makes the stress of a state that a law is given, at the start or later."""
    matrix, respond, remembers_volume = law.stress, law.respond, law.remembers_volume

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        stress: wp.array(dtype=matrix),
        state: wp.array(dtype=law.state),
        volume_correction: wp.array(dtype=float),
        constants: Constants,
    ):
        p = wp.tid()
        correction = float(0.0)
        if wp.static(remembers_volume):
            correction = volume_correction[p]
        kept, correction, tau = respond(state[p], correction, constants, 0.0)
        state[p] = kept
        stress[p] = tau
        if wp.static(remembers_volume):
            volume_correction[p] = correction

    return settle


@cache
@no_type_check
def build_grid_kernels(dimension: int) -> SimpleNamespace:
    """The kernels of a substep that know no material.

    Args:
        dimension: 2 (plane strain) or 3.

    Returns:
        ``particles_to_grid``, ``grid_update`` and their ``module``.
    """
    module = wp.get_module(f"giorom_mpm_grid_{dimension}d")
    return SimpleNamespace(
        particles_to_grid=_particles_to_grid(dimension, module),
        grid_update=_grid_update(dimension, module),
        module=module,
    )


@cache
@no_type_check
def build_law_kernels(family: str, dimension: int) -> SimpleNamespace:
    """The kernels of one constitutive law.

    Args:
        family: A value of ``device_laws.FAMILIES``.
        dimension: 2 (plane strain) or 3.

    Returns:
        ``grid_to_particles``, ``settle``, their ``module``, ``state``, the type of the strain
        variable, and ``remembers_volume``.
    """
    law = build_law(family, dimension)
    module = wp.get_module(f"giorom_mpm_{family}_{dimension}d")
    return SimpleNamespace(
        grid_to_particles=_grid_to_particles(dimension, law, module),
        settle=_settle(law, module),
        module=module,
        state=law.state,
        remembers_volume=law.remembers_volume,
    )
