# Warp needs float(0.0) where a loop changes a variable; laws share one signature.
# ruff: noqa: UP018, RUF046, ARG001
"""The constitutive laws as the simulator's kernels run them, in float32.

Each law is two device functions: ``transport`` carries the strain variable along with the flow
of a substep, ``respond`` brings the trial state back to what the material bears (return map)
and gives its Kirchhoff stress. The references are ``materials`` and ``return_maps``.

Principal stretches come from a symmetric eigen-solve of ``b``: one Jacobi rotation in the
plane, which is its closed form, and at most four cyclic sweeps in space. Equal eigenvalues
need no special case: a rotation is then by the angle zero. SI units; strains have no unit.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

# Warp compiles a kernel from its source and resolves names in the module's globals; this
# module is imported only inside the function that simulates.
import warp as wp  # noqa: TID253

from giorom.mpm.return_maps import SMALLEST_STRETCH

wp.config.log_level = wp.LOG_WARNING

LAW_CONSTANTS = 5
"""Room for the constants of a law."""

Constants = wp.types.vector(LAW_CONSTANTS, dtype=float)
"""Constants of a law, see ``law_constants`` of each material."""

SWEEPS = 4
"""Most cyclic sweeps of the eigen-solve; each squares the error."""

OFF_DIAGONAL = 1e-8
"""Sum of the off-diagonal elements, relative to the trace, that counts as none."""

SQUARE_FLOOR = SMALLEST_STRETCH**2
TINY = 1e-20


@wp.func
@no_type_check
def _rotation(first: float, second: float, coupling: float):
    """Tangent, cosine and sine of the turn that decouples two axes of a symmetric matrix."""
    apart = second - first
    root = wp.sqrt(apart * apart + 4.0 * coupling * coupling)
    tangent = 2.0 * coupling / (wp.abs(apart) + root + TINY)
    if apart < 0.0:
        tangent = -tangent
    cosine = 1.0 / wp.sqrt(1.0 + tangent * tangent)
    return tangent, cosine, tangent * cosine


@wp.func
@no_type_check
def eigen_plane(b: wp.mat22):
    """Eigenvalues and axes (columns) of a symmetric 2 x 2 matrix."""
    t, c, s = _rotation(b[0, 0], b[1, 1], b[0, 1])
    values = wp.vec2(b[0, 0] - t * b[0, 1], b[1, 1] + t * b[0, 1])
    return values, wp.mat22(c, s, -s, c)


@wp.func
@no_type_check
def _turned(first: wp.vec3, second: wp.vec3, cosine: float, sine: float):
    """Two axes after a turn in their plane."""
    return cosine * first - sine * second, sine * first + cosine * second


@wp.func
@no_type_check
def eigen_space(b: wp.mat33):
    """Eigenvalues and axes (columns) of a symmetric 3 x 3 matrix."""
    xx, yy, zz = b[0, 0], b[1, 1], b[2, 2]
    xy, xz, yz = b[0, 1], b[0, 2], b[1, 2]
    first = wp.vec3(1.0, 0.0, 0.0)
    second = wp.vec3(0.0, 1.0, 0.0)
    third = wp.vec3(0.0, 0.0, 1.0)
    none = OFF_DIAGONAL * (wp.abs(xx) + wp.abs(yy) + wp.abs(zz))
    sweep = int(0)
    while sweep < SWEEPS and wp.abs(xy) + wp.abs(xz) + wp.abs(yz) > none:
        t, c, s = _rotation(xx, yy, xy)
        xx, yy, xy = xx - t * xy, yy + t * xy, float(0.0)
        xz, yz = c * xz - s * yz, s * xz + c * yz
        first, second = _turned(first, second, c, s)
        t, c, s = _rotation(xx, zz, xz)
        xx, zz, xz = xx - t * xz, zz + t * xz, float(0.0)
        xy, yz = -s * yz, c * yz
        first, third = _turned(first, third, c, s)
        t, c, s = _rotation(yy, zz, yz)
        yy, zz, yz = yy - t * yz, zz + t * yz, float(0.0)
        xy, xz = c * xy - s * xz, s * xy + c * xz
        second, third = _turned(second, third, c, s)
        sweep = sweep + 1
    return wp.vec3(xx, yy, zz), wp.matrix_from_cols(first, second, third)


@no_type_check
def _spectral(dimension: int) -> SimpleNamespace:
    """Eigen-solve, logarithmic strains and matrices of given principal values."""
    vector = wp.types.vector(dimension, dtype=float)
    matrix = wp.types.matrix((dimension, dimension), dtype=float)

    @wp.func
    def strains(squares: vector):
        result = vector()
        for axis in range(dimension):
            result[axis] = 0.5 * wp.log(wp.max(squares[axis], SQUARE_FLOOR))
        return result

    @wp.func
    def trace_of(values: vector):
        total = float(0.0)
        for axis in range(dimension):
            total = total + values[axis]
        return total

    @wp.func
    def assemble(values: vector, axes: matrix):
        scaled = matrix()
        for i in range(dimension):
            for j in range(dimension):
                scaled[i, j] = axes[i, j] * values[j]
        return scaled * wp.transpose(axes)

    @wp.func
    def replace_strains(b: matrix, squares: vector, strain: vector, axes: matrix):
        # Only the change is added, so that a state that stays does so to the last bit.
        change = vector()
        for axis in range(dimension):
            change[axis] = wp.exp(2.0 * strain[axis]) - squares[axis]
        return b + assemble(change, axes)

    return SimpleNamespace(
        vector=vector,
        matrix=matrix,
        eigen=eigen_plane if dimension == 2 else eigen_space,
        strains=strains,
        trace_of=trace_of,
        assemble=assemble,
        replace_strains=replace_strains,
    )


@no_type_check
def _transport(dimension: int):
    """``b <- (I + dt C) b (I + dt C)^T``."""
    matrix = wp.types.matrix((dimension, dimension), dtype=float)

    @wp.func
    def transport(b: matrix, gradient: matrix, dt: float):
        growth = wp.identity(n=dimension, dtype=float) + dt * gradient
        grown = growth * b * wp.transpose(growth)
        # The eigen-solve reads one triangle; rounding in the other would grow unseen.
        return 0.5 * (grown + wp.transpose(grown))

    return transport


@no_type_check
def _solid(dimension: int, respond, *, remembers_volume: bool = False) -> SimpleNamespace:
    return SimpleNamespace(
        state=wp.types.matrix((dimension, dimension), dtype=float),
        transport=_transport(dimension),
        respond=respond,
        stress=wp.types.matrix((dimension, dimension), dtype=float),
        remembers_volume=remembers_volume,
    )


@no_type_check
def _neo_hookean(dimension: int) -> SimpleNamespace:
    """Stable neo-Hookean solid; constants ``mu_S, lambda_S, a``."""
    matrix = wp.types.matrix((dimension, dimension), dtype=float)
    out_of_plane = float(3 - dimension)

    @wp.func
    def respond(b: matrix, volume: float, constants: Constants, dt: float):
        volume_ratio = wp.sqrt(wp.max(wp.determinant(b), 0.0))
        invariant = wp.trace(b) + wp.static(out_of_plane)
        shear = constants[0] * (1.0 - 1.0 / (invariant + 1.0))
        pressure = constants[1] * volume_ratio * (volume_ratio - constants[2])
        return b, volume, shear * b + pressure * wp.identity(n=dimension, dtype=float)

    return _solid(dimension, respond)


@no_type_check
def _corotated(dimension: int) -> SimpleNamespace:
    """Fixed corotated solid; constants ``mu, lambda``."""
    parts = _spectral(dimension)
    vector, matrix, eigen, assemble = parts.vector, parts.matrix, parts.eigen, parts.assemble

    @wp.func
    def respond(b: matrix, volume: float, constants: Constants, dt: float):
        squares, axes = eigen(b)
        volume_ratio = float(1.0)
        principal = vector()
        for axis in range(dimension):
            stretch = wp.sqrt(wp.max(squares[axis], SQUARE_FLOOR))
            volume_ratio = volume_ratio * stretch
            principal[axis] = 2.0 * constants[0] * (squares[axis] - stretch)
        pressure = constants[1] * volume_ratio * (volume_ratio - 1.0)
        for axis in range(dimension):
            principal[axis] = principal[axis] + pressure
        return b, volume, assemble(principal, axes)

    return _solid(dimension, respond)


@no_type_check
def _yielding(dimension: int) -> SimpleNamespace:
    """Plasticine and goop; constants ``mu, lambda, yield strain, relaxation time``."""
    parts = _spectral(dimension)
    vector, matrix, eigen, assemble = parts.vector, parts.matrix, parts.eigen, parts.assemble
    strains, trace_of, replace_strains = parts.strains, parts.trace_of, parts.replace_strains

    @wp.func
    def respond(b: matrix, volume: float, constants: Constants, dt: float):
        squares, axes = eigen(b)
        strain = strains(squares)
        trace = trace_of(strain)
        mean = trace / float(dimension)
        square = float(0.0)
        for axis in range(dimension):
            square = square + (strain[axis] - mean) * (strain[axis] - mean)
        excess = wp.sqrt(square) - constants[2]
        kept = b
        if excess > 0.0:
            share = (dt + TINY) / (dt + TINY + constants[3])
            factor = 1.0 - share * excess / (excess + constants[2])
            for axis in range(dimension):
                strain[axis] = mean + factor * (strain[axis] - mean)
            kept = replace_strains(b, squares, strain, axes)
        principal = vector()
        for axis in range(dimension):
            principal[axis] = 2.0 * constants[0] * strain[axis] + constants[1] * trace
        return kept, volume, assemble(principal, axes)

    return _solid(dimension, respond)


@no_type_check
def _sand(dimension: int) -> SimpleNamespace:
    """Sand; constants ``mu, lambda, cone slope, cohesion strain, 1 if volume is kept``."""
    parts = _spectral(dimension)
    vector, matrix, eigen, assemble = parts.vector, parts.matrix, parts.eigen, parts.assemble
    strains, trace_of, replace_strains = parts.strains, parts.trace_of, parts.replace_strains

    @wp.func
    def respond(b: matrix, volume: float, constants: Constants, dt: float):
        squares, axes = eigen(b)
        strain = strains(squares)
        before = trace_of(strain)
        mean = (before + volume) / float(dimension)
        beyond = float(dimension) * (mean - constants[3])
        square = float(0.0)
        for axis in range(dimension):
            strain[axis] = strain[axis] + volume / float(dimension)
            square = square + (strain[axis] - mean) * (strain[axis] - mean)
        length = wp.sqrt(square)
        factor = float(1.0)
        if beyond >= 0.0:
            factor = 0.0
            mean = constants[3]
        elif length + constants[2] * beyond > 0.0:
            factor = -constants[2] * beyond / length
        moved = factor != 1.0 or volume != 0.0
        principal = vector()
        after = float(dimension) * mean
        middle = (before + volume) / float(dimension)
        for axis in range(dimension):
            strain[axis] = mean + factor * (strain[axis] - middle)
            principal[axis] = 2.0 * constants[0] * strain[axis] + constants[1] * after
        kept = b
        if moved:
            kept = replace_strains(b, squares, strain, axes)
        gained = constants[4] * (volume + before - after)
        return kept, gained, assemble(principal, axes)

    return _solid(dimension, respond, remembers_volume=True)


@no_type_check
def _fluid(dimension: int) -> SimpleNamespace:
    """Weakly compressible fluid; constant ``K``, the state is ``J``."""
    matrix = wp.types.matrix((dimension, dimension), dtype=float)

    @wp.func
    def transport(volume_ratio: float, gradient: matrix, dt: float):
        return volume_ratio * (1.0 + dt * wp.trace(gradient))

    @wp.func
    def respond(volume_ratio: float, volume: float, constants: Constants, dt: float):
        pressure = constants[0] * volume_ratio * (volume_ratio - 1.0)
        return volume_ratio, volume, pressure * wp.identity(n=dimension, dtype=float)

    return SimpleNamespace(
        state=float, transport=transport, respond=respond, stress=matrix, remembers_volume=False
    )


FAMILIES = {
    "stable_neo_hookean": "neo_hookean",
    "fixed_corotated": "corotated",
    "weakly_compressible_fluid": "fluid",
    "drucker_prager_sand": "sand",
    "von_mises_plasticine": "yielding",
    "viscoplastic_goop": "yielding",
}
"""Which device law a material of :mod:`giorom.mpm.materials` runs, by its name."""

_BUILDERS = {
    "neo_hookean": _neo_hookean,
    "corotated": _corotated,
    "fluid": _fluid,
    "sand": _sand,
    "yielding": _yielding,
}


@cache
@no_type_check
def build_law(family: str, dimension: int) -> SimpleNamespace:
    """Device functions of a law.

    Args:
        family: A value of ``FAMILIES``.
        dimension: 2 (plane strain) or 3.

    Returns:
        ``state``, the type of the strain variable; ``transport``; ``respond``; and
        ``remembers_volume``, whether the law carries a volume correction.
    """
    return _BUILDERS[family](dimension)
