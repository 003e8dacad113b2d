"""What is suspicious about data, one line each: what was found, what it means, what to do.

Each rule looks at the measured motions and the facts of the report and says nothing where all is
well. The remedies are options of ``giorom import``.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from giorom.data.measure import MotionSummary, SetMeasure

__all__ = ["GRAVITY", "find_suspicions"]

GRAVITY = 9.81
"""What falls freely on Earth [m/s^2]."""

TURNS = {"x": "-y,x,z", "-x": "y,-x,z", "-y": "-x,-y,z", "z": "x,z,-y", "-z": "x,-z,y"}
"""Axes that turn each direction into y without mirroring."""

GRAVITY_TOLERANCE = 0.15
"""Relative deviation from it that is let pass."""

ROUNDING_SHARE = 0.1
"""Largest share of rounding in the size of the accelerations that is let pass."""

STILL_SHARE = 1e-4
"""Accelerations along an axis below this share of the largest axis count as none."""

STATISTICS_FACTOR = 1.25
"""Largest factor between statistics of a file and measured ones that is let pass."""

SHORTEST = 8
"""Frames below which hardly a training window fits."""


def find_suspicions(
    measure: SetMeasure, facts: dict[str, Any], *, complete: bool = True
) -> list[str]:
    """Everything odd, the gravest first.

    Args:
        measure: The measured motions.
        facts: The facts of the report.
        complete: Whether all of the source was read; its own statistics are compared only then.
    """
    motions = measure.motions
    found = [
        *_not_finite(motions),
        *_identity(motions),
        *_time(motions, facts),
        *_gravity(facts),
        *_flat(facts),
        *_repeated(motions),
        *_outside(motions),
        *_rounding(motions, facts),
        *_particles(motions, facts),
        *_sizes(motions, facts),
    ]
    return [*found, *_file_statistics(facts)] if complete else found


def _not_finite(motions: list[MotionSummary]) -> Iterator[str]:
    bad = [m for m in motions if m.bad_at is not None]
    if bad:
        frame, particle = bad[0].bad_at
        yield (
            f"{len(bad)} of {len(motions)} trajectories hold coordinates that are not finite, the "
            f"first in {bad[0].name} at frame {frame}, particle {particle}. Leave them out with "
            f"--drop-bad-trajectories."
        )


def _identity(motions: list[MotionSummary]) -> Iterator[str]:
    shuffled = [m for m in motions if m.shuffled or m.identity_kept is False]
    if shuffled:
        yield (
            f"in {len(shuffled)} of {len(motions)} trajectories ({shuffled[0].name} ...) a row is "
            f"not the same particle in every frame: neighbouring rows move as unlike as strangers. "
            f"Velocities are meaningless; write the frames again sorted by particle number, "
            f"or (PLY, VTK, CSV) with a whole number 'id' for each particle."
        )
    jumps = [m for m in motions if m.jump_at is not None and not m.shuffled]
    if jumps:
        frame, particle = jumps[0].jump_at
        yield (
            f"{sum(m.jumps for m in jumps)} times a particle jumps over many others in one frame "
            f"and moves on quietly (first: {jumps[0].name}, frame {frame}, particle {particle}): "
            f"periodic walls, an inlet or swapped rows. Unwrap periodic coordinates before the "
            f"import, or keep particle numbers."
        )


def _time(motions: list[MotionSummary], facts: dict[str, Any]) -> Iterator[str]:
    if facts["frame_dt"] is None:
        known = sorted({m.frame_dt for m in motions if m.frame_dt is not None})
        said = f"differs ({', '.join(f'{t:g}' for t in known[:3])} s)" if known else "is not known"
        yield f"the time between frames {said}. Give it with --frame-dt SECONDS."


def _gravity(facts: dict[str, Any]) -> Iterator[str]:
    gravity = np.array(facts["gravity"] or [])
    if not np.any(gravity):
        return
    axis, strength = int(np.abs(gravity).argmax()), float(np.linalg.norm(gravity))
    up = ("-" if gravity[axis] > 0.0 else "") + "xyz"[axis]
    if up != "y":
        down = ("+" if gravity[axis] > 0.0 else "-") + "xyz"[axis]
        axes = TURNS[up] if len(gravity) == 3 else TURNS[up].removesuffix(",z")
        yield (
            f"things fall along {down}, but y (axis 1) is up here: walls, turning and the "
            f"free-fall baseline would be wrong. Import with --axes={axes}."
        )
    ratio = strength / GRAVITY
    if abs(ratio - 1.0) <= GRAVITY_TOLERANCE:
        return
    frame_dt = facts["frame_dt"]
    unit = {100.0: "cm", 1000.0: "mm"}
    for factor, word in unit.items():
        if abs(ratio / factor - 1.0) <= GRAVITY_TOLERANCE:
            yield (
                f"gravity measures {strength:.4g}, {factor:g} times {GRAVITY} m/s^2: lengths look "
                f"like {word}. Import with --unit {word}."
            )
            return
    yield (
        f"gravity measures {strength:.4g} m/s^2, {ratio:.3g} times {GRAVITY}: if lengths are "
        f"metres, the frames are {frame_dt * math.sqrt(ratio):.4g} s apart and not {frame_dt:g} s "
        f"(--frame-dt); if the time is right, one unit is {1.0 / ratio:.4g} m (--scale). Leave it "
        f"if the scene has another gravity."
    )


def _flat(facts: dict[str, Any]) -> Iterator[str]:
    spread = facts["statistics"].get("acc_std", [])
    least = STILL_SHARE * max(_acceleration_sizes(facts), default=0.0)
    still = ["xyz"[axis] for axis, value in enumerate(spread) if value <= least]
    moving = ["xyz"[axis] for axis, value in enumerate(spread) if value > least]
    if still and not moving and least > 0.0:
        yield (
            "all particles accelerate alike in every frame, as in free fall: there is nothing to "
            "learn. Take motions that meet walls or each other."
        )
    if still and moving:
        remedy = f"Import with --axes {','.join(moving)}" if len(moving) == 2 else "Leave it out"
        yield (
            f"nothing accelerates along {', '.join(still)}, so accelerations cannot be normalised "
            f"there. {remedy} if the motion is plane."
        )


def _acceleration_sizes(facts: dict[str, Any]) -> list[float]:
    """Root mean square of the accelerations along each axis [m/frame^2]."""
    statistics = facts["statistics"]
    pairs = zip(statistics.get("acc_mean", []), statistics.get("acc_std", []), strict=True)
    return [math.hypot(*pair) for pair in pairs]


def _repeated(motions: list[MotionSummary]) -> Iterator[str]:
    standing = [m for m in motions if m.standing_start]
    if standing:
        most = max(m.standing_start for m in standing)
        yield (
            f"{len(standing)} of {len(motions)} trajectories begin with up to {most} repeated "
            f"frames, whose velocities are zero though the motion goes on. Drop them with --skip "
            f"{most} if the motion does not start from rest."
        )
    repeated = [m for m in motions if m.repeated]
    if repeated:
        times, frames = sum(m.repeated for m in repeated), sum(m.frames for m in repeated)
        stride = max(2, round(frames / max(1, frames - times)))
        remedy = (
            f"Keep every {stride}th with --stride {stride}" if 4 * times > frames else "Remove them"
        )
        yield (
            f"{times} of {frames} frames repeat the one before ({repeated[0].name} ...): "
            f"velocities drop to zero there. {remedy}."
        )


def _outside(motions: list[MotionSummary]) -> Iterator[str]:
    outside = [m for m in motions if m.outside]
    if outside:
        low = np.min([m.extent[:, 0] for m in outside], axis=0)
        high = np.max([m.extent[:, 1] for m in outside], axis=0)
        reach = " ".join(f"{a:.4g} {b:.4g}" for a, b in zip(low, high, strict=True))
        yield (
            f"{sum(m.outside for m in outside)} particles of {len(outside)} trajectories leave the "
            f"given bounds. If the bounds are wrong, give those the particles reach: --bounds "
            f"{reach}."
        )


def _rounding(motions: list[MotionSummary], facts: dict[str, Any]) -> Iterator[str]:
    grids = [m.grid for m in motions if m.grid is not None]
    sizes = _acceleration_sizes(facts)
    sizes = [size for size in sizes if size > STILL_SHARE * max(sizes)]
    if not grids or not sizes:
        return
    coarsest = max(grids, key=lambda grid: grid.step)
    size = math.sqrt(sum(value**2 for value in sizes) / len(sizes))
    share = coarsest.acceleration_noise / size
    if share > ROUNDING_SHARE:
        stride = max(2, math.ceil(math.sqrt(share / ROUNDING_SHARE)))
        yield (
            f"positions lie on a grid of {coarsest.step:.2g} ({coarsest.name}), and rounding alone "
            f"makes {100.0 * min(share, 1.0):.0f} % of the size of the accelerations. Export "
            f"with more digits, or try --stride {stride}."
        )
        return
    rounding = float(np.spacing(np.float32(max(grid.typical for grid in grids)))) / math.sqrt(2.0)
    if coarsest.name == "float64" and rounding > 0.01 * min(sizes):
        yield (
            f"storing these float64 positions as float32 makes {100.0 * rounding / min(sizes):.2g}"
            f" % of noise in the smallest accelerations. Move the origin nearer to the particles, "
            f"or try --stride."
        )


def _particles(motions: list[MotionSummary], facts: dict[str, Any]) -> Iterator[str]:
    if facts["frozen"]:
        yield (
            f"{facts['frozen']} particles never move and are not kinematic: they count as free in "
            f"statistics and loss. If they are walls, import with --frozen-kinematic."
        )
    if facts["duplicates"]:
        first = next(m for m in motions if m.duplicates)
        yield (
            f"{facts['duplicates']} particles begin at the place of another one ({first.name} "
            f"...): they stay together for ever. Remove the doubles from the source."
        )
    if not facts["statistics"]:
        yield "no free particle has three frames, so nothing can be learnt from these data."


def _sizes(motions: list[MotionSummary], facts: dict[str, Any]) -> Iterator[str]:
    if facts["points_min"] != facts["points"]:
        yield (
            f"particle counts differ between trajectories ({facts['points_min']} to "
            f"{facts['points']}). Train with sampling.reduction and not sampling.count, so that "
            f"samples are equally far apart."
        )
    if facts["frames"] < SHORTEST:
        yield (
            f"the shortest trajectory has {facts['frames']} frames; a training window of six given "
            f"frames and one to predict needs 7. Store more frames or lower features.velocities."
        )
    if len(motions) < 3:
        held = "is 1 trajectory" if len(motions) == 1 else f"are {len(motions)} trajectories"
        yield (
            f"there {held}; training needs at least three, so that one "
            f"can validate and one can test. Add some."
        )
    step = facts["largest_step"]["over_radius"]
    if step is not None and step > 1.0:
        yield (
            f"a particle moves {step:.3g} graph radii in one frame, past neighbours it never sees. "
            f"Store frames more often, or use a larger graph.radius."
        )


def _file_statistics(facts: dict[str, Any]) -> Iterator[str]:
    file = facts["statistics"].get("file")
    if file is None:
        return
    factor = {}
    for key in ("vel_std", "acc_std"):
        ours = float(np.linalg.norm(facts["statistics"][key]))
        factor[key] = float(np.linalg.norm(file[key])) / ours if ours > 0.0 else 1.0
    velocity, acceleration = factor["vel_std"], factor["acc_std"]
    limit = math.log(STATISTICS_FACTOR)
    if max(_logarithm(velocity), _logarithm(acceleration)) <= limit:
        return
    frame_dt, reason = facts["frame_dt"], ""
    if frame_dt is not None and _logarithm(velocity * frame_dt) < limit:
        reason = " (they look like numbers per second and not per frame)"
    yield (
        f"the statistics in the file contradict the measured ones: its velocity spread is "
        f"{velocity:.3g} and its acceleration spread {acceleration:.3g} times ours{reason}. The "
        f"measured ones are used; take the file's only for a model that was trained with them."
    )


def _logarithm(factor: float) -> float:
    """Size of the logarithm of a factor; finite for a file that says zero."""
    return abs(math.log(max(factor, 1e-300)))
