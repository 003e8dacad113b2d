"""Turn somebody's motion into metres and seconds with axis 1 up, frame by frame.

What a source does not say, or says wrongly, is told here by the person who knows: time between
frames, walls, unit, axes, which frames to keep. ``converted`` gives the same lazy record the
readers give; nothing is read before its frames are asked for.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from giorom.data.metadata import DataError
from giorom.data.readers.source import ForeignTrajectory
from giorom.state import PARTICLE_TYPE_COUNT

__all__ = ["UNITS", "Conversion", "converted"]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in each unit of length."""

SHORTEST, LONGEST = 1e-18, 1e18
"""Times between frames with which velocities and accelerations are numbers of float32 [s]."""

AXES = "xyz"


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """How a source is turned into our data."""

    frame_dt: float | None = None
    """Time between frames of the source [s], in place of what it says."""

    bounds: tuple[float, ...] | None = None
    """Lower and upper wall of each axis in turn [m], after all other changes."""

    particle_type: int | None = None
    """GNS type of every particle, in place of what the source says."""

    stride: int = 1
    """Every how many frames one is kept."""

    skip: int = 0
    """Frames dropped at the beginning."""

    scale: float = 1.0
    """Metres per unit of length of the source."""

    axes: str | None = None
    """Axes of the source that become ours, such as ``x,z,-y``; all in their order by default."""

    def __post_init__(self) -> None:
        """Reject what nothing can be converted with."""
        if self.frame_dt is not None and not 0.0 < self.frame_dt < np.inf:
            raise DataError(f"--frame-dt must be > 0 s, got {self.frame_dt!r}.")
        if not 0.0 < self.scale < np.inf:
            raise DataError(f"--scale must be > 0 metres per unit, got {self.scale!r}.")
        if self.stride < 1:
            raise DataError(f"--stride must be >= 1, got {self.stride!r}.")
        if self.skip < 0:
            raise DataError(f"--skip must be >= 0, got {self.skip!r}.")
        if self.particle_type is not None and not 0 <= self.particle_type < PARTICLE_TYPE_COUNT:
            raise DataError(
                f"--particle-type must lie between 0 and {PARTICLE_TYPE_COUNT - 1} (3: kinematic, "
                f"4: plasticine, 5: water, 6: sand, 7: goop, 8: elastic), got "
                f"{self.particle_type!r}."
            )
        walls = self.walls()
        if walls is not None and not (walls[:, 0] < walls[:, 1]).all():
            raise DataError(f"--bounds must be pairs LOW HIGH with LOW < HIGH, got {self.bounds}.")
        self.axis_map()

    def walls(self) -> np.ndarray | None:
        """The walls as an array, shape (d, 2), if they are given."""
        if self.bounds is None:
            return None
        if len(self.bounds) not in (4, 6):
            raise DataError(
                f"--bounds needs LOW HIGH for each of 2 or 3 axes, got {len(self.bounds)} numbers."
            )
        if not np.isfinite(self.bounds).all():
            raise DataError(f"--bounds must be finite, got {self.bounds}.")
        return np.array(self.bounds, np.float64).reshape(-1, 2)

    def axis_map(self) -> tuple[list[int], np.ndarray] | None:
        """Source axis and sign of each of our axes, if they change."""
        if self.axes is None:
            return None
        words = [word.strip().lower() for word in self.axes.split(",")]
        names = [word.lstrip("+-") for word in words]
        sound = all(re.fullmatch(r"[+-]?[xyz]", word) for word in words)
        if not sound or len(set(names)) != len(names) or len(names) not in (2, 3):
            raise DataError(
                f"--axes must name 2 or 3 different axes of the source, such as x,z,-y, got "
                f"{self.axes!r}."
            )
        signs = np.array([-1.0 if word[0] == "-" else 1.0 for word in words])
        return [AXES.index(name) for name in names], signs

    def notes(self) -> list[str]:
        """What was changed, one sentence each."""
        said = []
        if self.scale != 1.0:
            said.append(f"Lengths were multiplied by {self.scale:g}.")
        if self.axes is not None:
            said.append(f"Our axes are the axes {self.axes} of the source.")
        if self.skip:
            said.append(f"The first {self.skip} frames of each trajectory were dropped.")
        if self.stride > 1:
            said.append(f"Every {self.stride}th frame was kept; frame_dt grew by as much.")
        if self.particle_type is not None:
            said.append(f"Every particle was given the type {self.particle_type}.")
        return said


def converted(source: ForeignTrajectory, conversion: Conversion) -> ForeignTrajectory:
    """The same motion in our units, axes and frames.

    Args:
        source: A motion as its reader gives it.
        conversion: What to change.

    Raises:
        DataError: If the axes do not exist, or the time between frames or the walls are absurd.
    """
    kind = source.particle_type
    if conversion.particle_type is not None:
        kind = np.full_like(kind, conversion.particle_type)
    frame_dt = source.frame_dt if conversion.frame_dt is None else conversion.frame_dt
    if frame_dt is not None and frame_dt > 0.0 and not SHORTEST <= frame_dt <= LONGEST:
        raise DataError(
            f"{source.name}: frames {frame_dt:g} s apart make velocities that no float32 holds; "
            f"the time must lie between {SHORTEST:g} and {LONGEST:g} s. Give it with --frame-dt."
        )
    count = source.frame_count
    if count is not None:
        count = max(0, -(-(count - conversion.skip) // conversion.stride))
    bounds = conversion.walls()
    if bounds is None and source.bounds is not None:
        bounds = _moved_bounds(source.bounds.astype(np.float64), conversion, source.name)
    if bounds is not None and not (np.abs(bounds) <= np.finfo(np.float32).max).all():
        raise DataError(
            f"{source.name} has walls at {bounds.tolist()} m, which are no places. Give the right "
            f"ones with --bounds LOW HIGH for each axis."
        )
    return replace(
        source,
        particle_type=kind,
        frames=lambda: _frames(source, conversion),
        frame_count=count,
        frame_dt=None if frame_dt is None else frame_dt * conversion.stride,
        bounds=bounds,
        notes=(*source.notes, *_replaced_time(source.frame_dt, conversion.frame_dt)),
    )


def _replaced_time(said: float | None, given: float | None) -> list[str]:
    """A note where the time between frames that was given is not the one the source says [s]."""
    if said is None or given is None or abs(given - said) <= 1e-3 * said:
        return []
    return [f"--frame-dt {given:g} replaces the {said:g} s between frames that the source says."]


def _frames(source: ForeignTrajectory, conversion: Conversion) -> Iterator[np.ndarray]:
    """The kept frames [m]; those that need no change keep their precision."""
    axes = conversion.axis_map()
    for frame in islice(source.frames(), conversion.skip, None, conversion.stride):
        if conversion.scale == 1.0 and axes is None:
            yield frame
            continue
        changed = frame.astype(np.float64) * conversion.scale
        if axes is not None:
            _check_axes(axes[0], frame.shape[1], source.name)
            changed = changed[:, axes[0]] * axes[1]
        yield changed


def _moved_bounds(bounds: np.ndarray, conversion: Conversion, name: str) -> np.ndarray:
    """The walls of the source in our unit and axes."""
    bounds = bounds * conversion.scale
    axes = conversion.axis_map()
    if axes is None:
        return bounds
    _check_axes(axes[0], len(bounds), name)
    return np.sort(bounds[axes[0]] * axes[1][:, None], axis=1)


def _check_axes(chosen: list[int], dimension: int, name: str) -> None:
    if max(chosen) >= dimension:
        raise DataError(
            f"{name} has {dimension} axes, so --axes cannot use {AXES[max(chosen)]!r}. Name others."
        )
