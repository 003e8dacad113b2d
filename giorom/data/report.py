"""What is known of a data set after one look at every frame: for people and for programs.

``giorom import`` and ``giorom inspect`` make the same report from a ``SetMeasure``. Lengths are
metres, times seconds; the four statistics are per frame, as in ``metadata.json``, and once more per
second. What is odd is said by ``giorom.data.suspicions``, with the remedy.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from giorom.data.measure import SetMeasure
from giorom.data.published import PUBLISHED, PublishedDataset
from giorom.data.statistics import Statistics, StatisticsAccumulator
from giorom.data.suggestion import Suggestion, suggest
from giorom.data.suspicions import GRAVITY, find_suspicions
from giorom.data.trajectory_file import SPLITS
from giorom.state import KINEMATIC

__all__ = ["Origin", "Report", "make_report"]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where the data come from and what is said about them elsewhere."""

    format: str
    """Name of the format."""

    source: str
    """File or folder, as the user named it."""

    file_statistics: Statistics | None = None
    """Per-frame statistics of the source's own metadata, in our units."""

    notes: tuple[str, ...] = ()
    """What was guessed, repaired, changed or left out."""

    complete: bool = True
    """Whether all of the source was read, every frame of it."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """The report of a data set."""

    facts: dict[str, Any]
    """Everything measured, as JSON values."""

    suspicious: list[str]
    """What is odd, each with its remedy."""

    notes: list[str]
    """What was guessed, repaired, changed or left out."""

    suggestion: Suggestion
    """Samples and radius."""

    splits: dict[str, list[int]] = field(default_factory=dict)
    """Trajectories of each part, where the data are divided."""

    def as_json(self) -> dict[str, Any]:
        """Facts, suspicions and notes together."""
        return {**self.facts, "suspicious": self.suspicious, "notes": self.notes}


def make_report(
    measure: SetMeasure,
    origin: Origin,
    *,
    bounds: np.ndarray | None = None,
    splits: dict[str, list[int]] | None = None,
) -> Report:
    """Put what was measured into words and numbers.

    Args:
        measure: The measured motions, at least one.
        origin: Where they come from.
        bounds: Walls of the data set [m]; by default those of the source, if they agree.
        splits: Numbers of the trajectories of each part; by default what the source says.
    """
    motions = measure.motions
    if splits is None:
        splits = {s: [i for i, m in enumerate(motions) if m.split == s] for s in SPLITS}
    training = splits["train"] or range(len(motions))
    total = StatisticsAccumulator()
    for index in training:
        total.merge(motions[index].statistics)
    suggestion = suggest(measure.beginnings)
    frame_dt = _common([m.frame_dt for m in motions])
    facts: dict[str, Any] = {
        "format": origin.format,
        "source": origin.source,
        "trajectories": len(motions),
        "splits": {name: len(parts) for name, parts in splits.items()},
        **_sizes(measure),
        "frame_dt": frame_dt,
        **_space(measure, bounds, frame_dt=frame_dt),
        **_particles(measure),
        "identity": _identity(measure),
        "largest_step": _largest_step(measure, suggestion),
        "statistics": _statistics(total, frame_dt=frame_dt, file=origin.file_statistics),
        "suggested": {
            "sparse_points": suggestion.sparse_points,
            "radius": suggestion.radius,
            "neighbors": _rounded(suggestion.neighbors.mean()) if suggestion.radius else None,
            "why": suggestion.text,
        },
    }
    facts["published"] = published_like(facts)
    notes = [*origin.notes, *dict.fromkeys(note for m in motions for note in m.notes)]
    return Report(
        facts=facts,
        suspicious=find_suspicions(measure, facts, complete=origin.complete),
        notes=notes,
        suggestion=suggestion,
        splits=splits,
    )


def _sizes(measure: SetMeasure) -> dict[str, Any]:
    particles = [m.particles for m in measure.motions]
    frames = [m.frames for m in measure.motions]
    return {
        "points": max(particles),
        "points_min": min(particles),
        "points_mean": _rounded(np.mean(particles)),
        "frames": min(frames),
        "frames_max": max(frames),
    }


def _space(
    measure: SetMeasure, bounds: np.ndarray | None, *, frame_dt: float | None
) -> dict[str, Any]:
    """Walls, extent, spacing, gravity, and what unit these suggest."""
    motions = measure.motions
    extent = np.stack(
        [
            np.min([m.extent[:, 0] for m in motions], axis=0),
            np.max([m.extent[:, 1] for m in motions], axis=0),
        ],
        axis=1,
    )
    given = [m.bounds for m in motions]
    agree = all(b is not None and np.array_equal(b, given[0]) for b in given)
    if bounds is None and agree:
        bounds = given[0]
    fallen = [m.gravity for m in motions if m.gravity is not None]
    per_frame = np.median(fallen, axis=0) if fallen else None
    gravity = None if per_frame is None or frame_dt is None else per_frame / frame_dt**2
    return {
        "dimension": len(extent),
        "bounds": None if bounds is None else _rounded(bounds),
        "bounds_given": agree,
        "extent": _rounded(extent),
        "spacing": _rounded(np.median([m.spacing for m in motions])),
        "gravity": None if gravity is None else _rounded(gravity),
        "units": _units(gravity, extent),
    }


def _units(gravity: np.ndarray | None, extent: np.ndarray) -> str:
    """What length and time seem to be measured in."""
    size = float((extent[:, 1] - extent[:, 0]).max())
    about = f"largest extent {size:.3g}"
    if gravity is None:
        return f"{about}; no frame in which everything falls freely, so gravity is not known"
    strength = float(np.linalg.norm(gravity))
    if abs(strength / GRAVITY - 1.0) < 0.15:
        return f"{about}, gravity {strength:.3g} m/s^2: looks like metres and seconds"
    return f"{about}, gravity {strength:.3g} in place of {GRAVITY}: not metres and seconds"


def _particles(measure: SetMeasure) -> dict[str, Any]:
    """Counts of what particles are and do."""
    motions = measure.motions
    types: Counter[int] = Counter()
    for motion in motions:
        types.update(motion.particle_type)
    return {
        "types": {str(kind): count for kind, count in sorted(types.items())},
        "kinematic": types[KINEMATIC],
        "moving_kinematic": sum(m.moving_kinematic for m in motions),
        "frozen": sum(m.frozen for m in motions),
        "duplicates": sum(m.duplicates for m in motions),
        "not_finite": sum(m.bad for m in motions),
    }


def _identity(measure: SetMeasure) -> str:
    """Whether a row is the same particle in every frame, as far as source and motion tell."""
    motions = measure.motions
    shuffled = sum(m.shuffled is True for m in motions)
    denied = sum(m.identity_kept is False for m in motions)
    jumps = sum(m.jumps for m in motions)
    if shuffled or denied:
        return f"lost in {max(shuffled, denied)} of {len(motions)} trajectories"
    if jumps:
        return f"doubtful: {jumps} jumps of single particles"
    if all(m.identity_kept for m in motions):
        return "kept, as the source says"
    if all(m.shuffled is None for m in motions):
        return "nothing moves, so the motion does not tell"
    return "kept, by the motion: neighbours move alike"


def _largest_step(measure: SetMeasure, suggestion: Suggestion) -> dict[str, Any]:
    """The longest way of a free particle in one frame, and beside what it is long."""
    motion = max(measure.motions, key=lambda m: m.largest_step)
    step, radius = motion.largest_step, suggestion.radius
    frame, particle = motion.largest_at
    return {
        "metres": _rounded(step),
        "over_spacing": _rounded(step / motion.spacing) if motion.spacing else None,
        "over_radius": _rounded(step / radius) if radius else None,
        "trajectory": motion.name,
        "frame": frame,
        "particle": particle,
    }


def _statistics(
    total: StatisticsAccumulator, *, frame_dt: float | None, file: Statistics | None
) -> dict[str, Any]:
    """The four statistics per frame, per second, and as the source says them."""
    if total.velocity.count == 0 or total.acceleration.count == 0:
        return {}
    measured = total.statistics()
    result: dict[str, Any] = measured.to_metadata()
    result["si"] = None if frame_dt is None else measured.in_si(frame_dt=frame_dt).to_metadata()
    result["file"] = None if file is None else file.to_metadata()
    return result


def published_like(facts: dict[str, Any]) -> list[dict[str, Any]]:
    """Published data sets of the same dimension, frame time, walls and types."""
    return [
        {
            "name": row.name,
            "frames": row.frames,
            "most_particles": row.most_particles,
            "statistics": None if row.statistics is None else row.statistics.to_metadata(),
            "source": row.source,
        }
        for row in PUBLISHED.values()
        if _is_like(row, facts)
    ]


def _is_like(row: PublishedDataset, facts: dict[str, Any]) -> bool:
    frame_dt, bounds = facts["frame_dt"], facts["bounds"]
    if row.dimension != facts["dimension"] or frame_dt is None:
        return False
    if abs(frame_dt / row.frame_dt - 1.0) > 0.01 or row.statistics is None:
        return False
    if {int(kind) for kind in facts["types"]} != set(row.particle_types):
        return False
    return row.bounds is None or bounds is None or bool(np.allclose(row.bounds, bounds, atol=1e-3))


def _common(values: list[Any]) -> Any:
    """The value all share, or None."""
    return values[0] if all(value == values[0] for value in values) else None


def _rounded(value: Any) -> Any:
    """Nested lists of numbers with six digits; what is not finite becomes None."""
    if isinstance(value, np.ndarray | list):
        return [_rounded(item) for item in value]
    number = float(value)
    return float(f"{number:.6g}") if math.isfinite(number) else None
