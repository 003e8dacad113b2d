"""The grid stepper's substep as NVIDIA Warp kernels: the fast path where no gradient is needed.

The same arithmetic as ``grid_stepper.py`` in plain tensors, which stays the reference, in three
kernels without temporaries; the law is in ``law_kernels.py``. Imported when the first rollout
without gradients starts, and only where Warp is installed.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp  # noqa: TID253
from torch import Tensor

from giorom.layers.law_kernels import law_functions
from giorom.layers.learned_law import Strain
from giorom.layers.spline_grid import MARGIN, SplineGrid
from giorom.warp_start import start_warp

wp.config.log_level = wp.LOG_WARNING


@no_type_check
def _stencil(dimension: int) -> SimpleNamespace:  # noqa: C901  (counts the functions inside)
    """First node, place in its cells and weights of a sample."""
    vector = wp.types.vector(dimension, dtype=float)
    whole = wp.types.vector(dimension, dtype=int)
    weights = wp.types.matrix((3, dimension), dtype=float)

    @wp.func
    def base_node(x: vector, origin: vector, spacing: float, shape: whole):
        base = whole()
        for axis in range(dimension):
            place = wp.floor((x[axis] - origin[axis]) / spacing - 0.5)
            # A lost sample must not write outside the grid: not a number becomes the first node.
            base[axis] = wp.clamp(int(wp.clamp(place, 0.0, float(shape[axis]))), 0, shape[axis] - 3)
        return base

    @wp.func
    def fraction(x: vector, origin: vector, spacing: float, base: whole):
        f = vector()
        for axis in range(dimension):
            place = (x[axis] - origin[axis]) / spacing - float(base[axis])
            f[axis] = wp.clamp(place, 0.5, 1.5)
        return f

    @wp.func
    def spline(f: vector):
        w = weights()
        for axis in range(dimension):
            w[0, axis] = 0.5 * (1.5 - f[axis]) * (1.5 - f[axis])
            w[1, axis] = 0.75 - (f[axis] - 1.0) * (f[axis] - 1.0)
            w[2, axis] = 0.5 * (f[axis] - 0.5) * (f[axis] - 0.5)
        return w

    @wp.func
    def entry(i: int, j: int, k: int):
        """Offsets of a node from the first one."""
        where = whole()
        where[0] = i
        where[1] = j
        if wp.static(dimension == 3):
            where[2] = k
        return where

    @wp.func
    def number(base: whole, where: whole, shape: whole):
        result = 0
        for axis in range(dimension):
            result = result * shape[axis] + base[axis] + where[axis]
        return result

    return SimpleNamespace(
        vector=vector,
        whole=whole,
        base_node=base_node,
        fraction=fraction,
        spline=spline,
        entry=entry,
        number=number,
    )


@no_type_check
def _to_grid(dimension: int, law: SimpleNamespace, around: SimpleNamespace, module: Any) -> Any:
    """The kernel that gives mass, momentum and force of every sample to its nodes."""
    matrix, constants, vector, whole = law.matrix, law.constants, around.vector, around.whole
    base_node, fraction, spline = around.base_node, around.fraction, around.spline
    entry, number, stress = around.entry, around.number, law.stress
    node = wp.types.vector(2 * dimension + 1, dtype=float)
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def to_grid(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        gradient: wp.array(dtype=matrix),
        b: wp.array(dtype=matrix),
        ratio: wp.array(dtype=float),
        kind: wp.array(dtype=wp.int64),
        scene: wp.array(dtype=wp.int64),
        volume: wp.array(dtype=float),
        mass: wp.array(dtype=float),
        table: wp.array(dtype=constants),
        origin: vector,
        spacing: float,
        shape: whole,
        nodes: int,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
        base = base_node(x[p], origin, spacing, shape)
        f = fraction(x[p], origin, spacing, base)
        w = spline(f)
        type_of = int(kind[p])
        tau = stress(b[p], ratio[p], type_of, table[type_of])
        push = (-4.0 * volume[p] / (spacing * spacing)) * tau
        first = int(scene[p]) * nodes
        for i in range(3):
            for j in range(3):
                for k in range(wp.static(layers)):
                    where = entry(i, j, k)
                    offset = spacing * (vector(where) - f)
                    weight = w[i, 0] * w[j, 1]
                    if wp.static(dimension == 3):
                        weight = weight * w[k, 2]
                    share = weight * mass[p]
                    momentum = share * (v[p] + gradient[p] * offset)
                    force = weight * (push * offset)
                    value = node()
                    for axis in range(dimension):
                        value[axis] = momentum[axis]
                        value[dimension + axis] = force[axis]
                    value[2 * dimension] = share
                    wp.atomic_add(grid, first + number(base, where, shape), value)

    return to_grid


@no_type_check
def _on_grid(dimension: int, around: SimpleNamespace, module: Any) -> Any:
    """The kernel that turns momentum and force into velocities and stops them at walls."""
    vector, whole = around.vector, around.whole
    node = wp.types.vector(2 * dimension + 1, dtype=float)

    @wp.kernel(module=module, enable_backward=False)
    def on_grid(  # noqa: PLR0917
        grid: wp.array(dtype=node),
        gravity: vector,
        dt: float,
        shape: whole,
        nodes: int,
        upper: whole,
        sticks: int,
        lightest: float,
    ):
        i = wp.tid()
        value = grid[i]
        mass = value[2 * dimension]
        if mass > 0.0:
            mass = wp.max(mass, lightest)
            rest = i % nodes
            hit = 0
            for step in range(dimension):
                axis = dimension - 1 - step
                place = rest % shape[axis]
                rest = rest / shape[axis]
                before = value[axis] / mass
                after = before + dt * (value[dimension + axis] / mass + gravity[axis])
                if (place <= wp.static(MARGIN) and after < 0.0) or (
                    place >= upper[axis] and after > 0.0
                ):
                    after = 0.0
                    hit = 1
                value[axis] = before
                value[dimension + axis] = after
            if hit == 1 and sticks == 1:
                for axis in range(dimension):
                    value[dimension + axis] = 0.0
            grid[i] = value

    return on_grid


@no_type_check
def _to_samples(dimension: int, law: SimpleNamespace, around: SimpleNamespace, module: Any) -> Any:
    """The kernel that moves every sample with its nodes and lets its strain flow."""
    matrix, constants, vector, whole = law.matrix, law.constants, around.vector, around.whole
    base_node, fraction, spline = around.base_node, around.fraction, around.spline
    entry, number, returned = around.entry, around.number, law.returned
    node = wp.types.vector(2 * dimension + 1, dtype=float)
    layers = 3 if dimension == 3 else 1

    @wp.kernel(module=module, enable_backward=False)
    def to_samples(  # noqa: PLR0917
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        gradient: wp.array(dtype=matrix),
        b: wp.array(dtype=matrix),
        ratio: wp.array(dtype=float),
        kind: wp.array(dtype=wp.int64),
        scene: wp.array(dtype=wp.int64),
        held: wp.array(dtype=wp.bool),
        table: wp.array(dtype=constants),
        own_share: float,
        dt: float,
        origin: vector,
        spacing: float,
        shape: whole,
        nodes: int,
        low: vector,
        high: vector,
        grid: wp.array(dtype=node),
    ):
        p = wp.tid()
        base = base_node(x[p], origin, spacing, shape)
        f = fraction(x[p], origin, spacing, base)
        w = spline(f)
        smooth = vector()
        change = vector()
        slope = matrix()
        first = int(scene[p]) * nodes
        for i in range(3):
            for j in range(3):
                for k in range(wp.static(layers)):
                    where = entry(i, j, k)
                    weight = w[i, 0] * w[j, 1]
                    if wp.static(dimension == 3):
                        weight = weight * w[k, 2]
                    value = grid[first + number(base, where, shape)]
                    after = vector()
                    for axis in range(dimension):
                        after[axis] = weight * value[dimension + axis]
                        change[axis] = change[axis] - weight * value[axis]
                    smooth = smooth + after
                    slope = slope + wp.outer(after, spacing * (vector(where) - f))
        change = change + smooth
        slope = (4.0 / (spacing * spacing)) * slope
        kept = v[p] + change
        if held[p]:
            smooth = v[p]
        moved = x[p] + dt * smooth
        for axis in range(dimension):
            moved[axis] = wp.clamp(moved[axis], low[axis], high[axis])
        x[p] = moved
        if not held[p]:
            v[p] = smooth + own_share * (kept - smooth)
        gradient[p] = slope
        growth = wp.identity(n=dimension, dtype=float) + dt * slope
        bulge = wp.clamp(wp.determinant(growth), 0.2, 5.0)
        growth = wp.pow(bulge, -1.0 / float(dimension)) * growth
        trial = growth * b[p] * wp.transpose(growth)
        trial = 0.5 * (trial + wp.transpose(trial))
        ratio[p] = ratio[p] * bulge
        type_of = int(kind[p])
        b[p] = returned(trial, ratio[p], type_of, table[type_of], dt)

    return to_samples


@cache
def build_kernels(dimension: int) -> SimpleNamespace:
    """The three kernels of a substep and the types of their arguments.

    Args:
        dimension: Space dimension, 2 or 3.
    """
    law, around = law_functions(dimension), _stencil(dimension)
    module = wp.get_module(f"{__name__}.d{dimension}")
    return SimpleNamespace(
        to_grid=_to_grid(dimension, law, around, module),
        on_grid=_on_grid(dimension, around, module),
        to_samples=_to_samples(dimension, law, around, module),
        vector=around.vector,
        whole=around.whole,
        matrix=law.matrix,
        constants=law.constants,
        node=wp.types.vector(2 * dimension + 1, dtype=float),
    )


def advance_samples(
    grid: SplineGrid,
    *,
    position: Tensor,
    velocity: Tensor,
    gradient: Tensor,
    strain: Strain,
    particle_type: Tensor,
    batch: Tensor,
    held: Tensor,
    volume: Tensor,
    mass: Tensor,
    table: Tensor,
    gravity: Tensor,
    bounds: Tensor,
    own_share: float,
    sticks: bool,
    beyond: float,
    lightest: float,
    scenes: int,
    substeps: int,
    dt: float,
) -> None:
    """Advance samples by some substeps, in place; every tensor float32 and contiguous.

    Args:
        grid: The background grid.
        position: Positions [m].
        velocity: Velocities, of held samples the prescribed one [m/s].
        gradient: Velocity gradients [1/s].
        strain: Elastic strain.
        particle_type: GNS types.
        batch: Scene of each sample.
        held: Prescribed samples.
        volume: Particles each sample stands for.
        mass: The same, larger for held samples.
        table: Constants of the law, ``LearnedLaw.table``.
        gravity: Gravity [m/s^2].
        bounds: Walls [m].
        own_share: Share of its own velocity that a sample keeps.
        sticks: Whether walls stop sliding.
        beyond: How far a sample may be pressed beyond a wall [m].
        lightest: Smallest mass a velocity is divided by.
        scenes: Scenes of the batch.
        substeps: How many.
        dt: Time of each [s].
    """
    device = str(position.device)
    start_warp(device)
    kernels = build_kernels(grid.dimension)
    vector, whole = kernels.vector, kernels.whole
    motion = [
        wp.from_torch(position, dtype=vector),
        wp.from_torch(velocity, dtype=vector),
        wp.from_torch(gradient, dtype=kernels.matrix),
        wp.from_torch(strain.isochoric, dtype=kernels.matrix),
        wp.from_torch(strain.volume_ratio),
        wp.from_torch(particle_type),
        wp.from_torch(batch),
    ]
    constants = wp.from_torch(table, dtype=kernels.constants)
    nodes = wp.zeros(scenes * grid.node_count, dtype=kernels.node, device=device)
    shape, origin = whole(*grid.shape), vector(*grid.origin.tolist())
    low, high = (bounds[:, 0] - beyond).tolist(), (bounds[:, 1] + beyond).tolist()
    box = [origin, grid.spacing, shape, grid.node_count]
    upper = whole(*(n - 1 - MARGIN for n in grid.shape))
    given = [*motion, wp.from_torch(volume), wp.from_torch(mass), constants, *box, nodes]
    on_nodes = [nodes, vector(*gravity.tolist()), dt, shape, grid.node_count, upper]
    on_nodes += [int(sticks), lightest]
    back = [*motion, wp.from_torch(held), constants, own_share, dt, *box]
    back += [vector(*low), vector(*high), nodes]
    launches: list[tuple[Any, int, list[Any]]] = [
        (kernels.to_grid, len(position), given),
        (kernels.on_grid, len(nodes), on_nodes),
        (kernels.to_samples, len(position), back),
    ]
    for _ in range(substeps):
        nodes.zero_()
        for kernel, size, arguments in launches:
            wp.launch(kernel, dim=size, inputs=arguments, device=device)
