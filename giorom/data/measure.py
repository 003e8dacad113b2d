"""Measure a motion while its frames go by: one pass, memory independent of its length.

``MotionMeasure`` sees the frames of one trajectory and ends in a ``MotionSummary``; ``SetMeasure``
collects the summaries of a data set. What the report says of data is computed here and nowhere
else. Lengths are metres, velocities and accelerations are per frame: the time between frames may
be unknown.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int

from giorom.data.motion_checks import (
    MOST_DRAWN,
    Grid,
    Neighbors,
    common_acceleration,
    grid_of,
    jumping_rows,
    nearest_neighbors,
    rows_are_shuffled,
)
from giorom.data.statistics import StatisticsAccumulator
from giorom.data.thinned import Thinned
from giorom.state import KINEMATIC

__all__ = ["MotionMeasure", "MotionSummary", "SetMeasure"]

SHEET_MOTIONS = 6
"""Trajectories whose pictures are kept: the first ones."""

SUGGESTION_MOTIONS = 4
"""Trajectories whose first frames suggest samples and radius."""

SUGGESTION_POINTS = 20_000
"""Most particles such a first frame keeps, drawn at random."""

WALL_TOLERANCE = 1e-5
"""How far beyond a wall, relative to the domain, rounding may put a particle."""

PRESSED = 1.0
"""How far beyond a wall pressure may put the middle of a particle [spacing]."""

FLIGHT_FRAMES = 40
"""Frames at the beginning all of which are asked whether everything falls."""

HISTOGRAM_ROWS = 256
"""Particles drawn from a frame for the histograms."""


@dataclass(frozen=True, kw_only=True)
class MotionSummary:
    """What one trajectory turned out to be."""

    name: str
    split: str | None
    frame_dt: float | None
    bounds: Float[np.ndarray, "d 2"] | None
    frames: int
    particle_type: dict[int, int]
    """Number of particles of each type."""
    extent: Float[np.ndarray, "d 2"]
    """Lowest and highest coordinate on each axis [m]."""
    statistics: StatisticsAccumulator
    spacing: float
    """Median distance to the nearest particle in the first frame [m]; zero for one particle."""
    largest_step: float
    """Largest displacement of a free particle in one frame [m]."""
    largest_at: tuple[int, int]
    """Frame it leads to, and the particle."""
    bad: int
    """Coordinates that are not finite."""
    bad_at: tuple[int, int] | None
    """First frame with one, and the particle."""
    frozen: int
    """Free particles that never move, where others do."""
    moving_kinematic: int
    duplicates: int
    """Particles at the place of another one in the first frame."""
    standing_start: int
    """Frames at the beginning that repeat the first, where motion follows."""
    repeated: int
    """Other frames that repeat the one before, between frames that differ."""
    shuffled: bool | None
    identity_kept: bool | None
    """What the source says."""
    jumps: int
    jump_at: tuple[int, int] | None
    gravity: Float[np.ndarray, " d"] | None
    """Median acceleration of frames in free flight [m/frame^2]."""
    grid: Grid | None
    outside: int
    """Free particles that go beyond the given walls."""
    notes: tuple[str, ...] = ()

    @property
    def particles(self) -> int:
        """Number of particles."""
        return sum(self.particle_type.values())


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """The first frame of one motion, for suggestions."""

    position: Float[np.ndarray, "n d"]
    """Positions of all particles, of some where there are very many [m]."""
    particles: int
    """Number of particles of the motion."""


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """Some frames of one motion, for pictures."""

    name: str
    particle_type: Int[np.ndarray, " n"]
    frames: list[tuple[int, np.ndarray, np.ndarray]]
    """Frame number, positions [m] and steps of the particles drawn [m/frame]."""


@dataclass(kw_only=True)
class SetMeasure:
    """What a data set turned out to be, trajectory by trajectory."""

    motions: list[MotionSummary] = field(default_factory=list)
    sheets: list[Sheet] = field(default_factory=list)
    beginnings: list[Beginning] = field(default_factory=list)
    """First frames of a few motions."""
    steps: Thinned = field(default_factory=Thinned)
    """Displacements per frame of some free particles [m]."""
    changes: Thinned = field(default_factory=Thinned)
    """Second differences of some free particles [m]."""

    def begin(
        self, name: str, particle_type: Int[np.ndarray, " p"], bounds: np.ndarray | None
    ) -> "MotionMeasure":
        """A measure for the next trajectory."""
        return MotionMeasure(name=name, particle_type=particle_type, bounds=bounds, into=self)


class MotionMeasure:
    """Takes the frames of one trajectory, in order.

    Args:
        name: Where it stands, for messages.
        particle_type: GNS particle types.
        bounds: Walls [m], if known.
        into: The measure of the whole set.
    """

    def __init__(
        self,
        *,
        name: str,
        particle_type: Int[np.ndarray, " p"],
        bounds: np.ndarray | None,
        into: SetMeasure,
    ) -> None:
        self.name, self.particle_type, self.bounds, self.into = name, particle_type, bounds, into
        count = len(particle_type)
        self.free, self.sound = particle_type != KINEMATIC, np.ones(count, bool)
        self.moved, self.beyond = np.zeros(count, bool), np.zeros(count, bool)
        self.statistics = StatisticsAccumulator()
        self.frame_count = self.bad = self.jumps = self.duplicates = 0
        self.standing_start = self.repeated = self._standing = 0
        self.bad_at: tuple[int, int] | None = None
        self.jump_at: tuple[int, int] | None = None
        self.largest, self.largest_at = 0.0, (0, 0)
        self.shuffled: bool | None = None
        self.grid: Grid | None = None
        self.neighbors: Neighbors | None = None
        self._flight: list[np.ndarray] = []
        self._first = self._last = self._step = np.empty((0, 0))
        self._lengths: list[np.ndarray] = [np.zeros(count)]
        self._draw = np.random.default_rng(0)
        shown = np.sort(self._draw.permutation(count)[:MOST_DRAWN])
        self._shown = shown if len(into.sheets) < SHEET_MOTIONS else None
        self._sheet = Thinned(most=16)
        self._steps, self._changes = Thinned(), Thinned()
        self._beginning: list[Beginning] = []

    def add(self, frame: Float[np.ndarray, "p d"]) -> None:
        """Take in the next frame [m]."""
        position = frame.astype(np.float64)
        self._check_finite(position)
        if self.frame_count == 0:
            self._begin(position)
        else:
            self._follow(position)
        rows = position if self.bad == 0 else position[self.sound]
        self.low = np.minimum(self.low, rows.min(axis=0, initial=np.inf))
        self.high = np.maximum(self.high, rows.max(axis=0, initial=-np.inf))
        if self.bounds is not None:
            spacing = 0.0 if self.neighbors is None else self.neighbors.spacing
            slack = WALL_TOLERANCE * (self.bounds[:, 1] - self.bounds[:, 0]) + PRESSED * spacing
            low, high = self.bounds[:, 0] - slack, self.bounds[:, 1] + slack
            self.beyond |= self.sound & ((position < low) | (position > high)).any(axis=1)
        if self._shown is not None:
            place, speed = position[self._shown].astype(np.float32), self._lengths[-1][self._shown]
            self._sheet.add((self.frame_count, place, speed))
            if self.frame_count == 1:
                start = self._sheet.items[0]
                self._sheet.items[0] = (*start[:2], speed)
        self._last = position
        self.frame_count += 1

    def _check_finite(self, position: np.ndarray) -> None:
        """Note what float32 cannot hold; a particle that was bad once counts no more."""
        finite = np.abs(position) <= np.finfo(np.float32).max
        if finite.all():
            return
        wrong = ~finite.all(axis=1)
        self.bad += int((~finite).sum())
        self.bad_at = self.bad_at or (self.frame_count, int(wrong.argmax()))
        self.sound &= ~wrong
        position[~self.sound] = 0.0

    def _begin(self, position: np.ndarray) -> None:
        """What the first frame tells."""
        dimension = position.shape[1]
        self.low, self.high = np.full(dimension, np.inf), np.full(dimension, -np.inf)
        rows = np.flatnonzero(self.sound)
        self.neighbors = nearest_neighbors(position[rows])
        if self.neighbors is not None and len(rows) < len(position):
            found = self.neighbors
            self.neighbors = Neighbors(
                particle=rows[found.particle], nearest=rows[found.nearest], spacing=found.spacing
            )
        self.duplicates = len(rows) - len(np.unique(position[rows], axis=0))
        self._first = position
        if len(self.into.beginnings) < SUGGESTION_MOTIONS:
            chosen = rows
            if len(rows) > SUGGESTION_POINTS:
                chosen = self._draw.choice(rows, SUGGESTION_POINTS, replace=False)
            start = position[chosen].astype(np.float32)
            self._beginning = [Beginning(position=start, particles=len(position))]

    def _follow(self, position: np.ndarray) -> None:
        """What a later frame tells, seen from those before."""
        step = position - self._last
        step[~self.sound] = 0.0
        length = np.sqrt(np.einsum("pd,pd->p", step, step))
        counted = self.free & self.sound
        self._note_rest(bool((length > 0.0).any()))
        self.moved |= length > 0.0
        self._note_largest(np.where(counted, length, 0.0))
        rows = step[counted]
        self.statistics.velocity.add(torch.from_numpy(rows))
        drawn = self._draw.integers(max(1, len(rows)), size=min(len(rows), HISTOGRAM_ROWS))
        self._steps.add(rows[drawn])
        if self.shuffled is None and self.neighbors is not None:
            self.shuffled = rows_are_shuffled(step, self.neighbors)
        if self.frame_count.bit_count() == 1:
            self._note_grid(position)
        if self.frame_count >= 2:
            change = rows - self._step[counted]
            self.statistics.acceleration.add(torch.from_numpy(change))
            self._changes.add(change[drawn])
            self._note_flight(change)
        self._step = step

    def _note_flight(self, change: np.ndarray) -> None:
        """Keep the acceleration that all share; of later frames every eighth is asked."""
        if self.frame_count > FLIGHT_FRAMES and self.frame_count % 8:
            return
        noise = 0.0 if self.grid is None else self.grid.acceleration_noise
        falling = common_acceleration(change, noise=noise)
        if falling is not None:
            self._flight.append(falling)

    def _note_rest(self, moving: bool) -> None:
        """Count frames that repeat the one before them, at the beginning and later."""
        if not moving:
            self._standing += 1
            return
        if self.moved.any():
            self.repeated += self._standing
        else:
            self.standing_start = self._standing
        self._standing = 0

    def _note_largest(self, length: np.ndarray) -> None:
        """Keep the longest step, and count jumps of the step before this one."""
        longest = int(length.argmax()) if len(length) else 0
        if len(length) and length[longest] > self.largest:
            self.largest, self.largest_at = float(length[longest]), (self.frame_count, longest)
        self._lengths = [*self._lengths[-2:], length]
        if len(self._lengths) < 3 or self.neighbors is None:
            return
        jumped = jumping_rows(*self._lengths, spacing=self.neighbors.spacing)
        if jumped.any():
            self.jumps += int(jumped.sum())
            self.jump_at = self.jump_at or (self.frame_count - 1, int(jumped.argmax()))

    def _note_grid(self, position: np.ndarray) -> None:
        """Keep the finest grid that coordinates of moving particles were seen on."""
        rows = (position != self._first) & self.sound[:, None]
        found = grid_of(position[rows])
        if found is not None and (self.grid is None or found.step < self.grid.step):
            self.grid = found

    def finish(
        self,
        *,
        split: str | None = None,
        frame_dt: float | None = None,
        identity_kept: bool | None = None,
        notes: tuple[str, ...] = (),
    ) -> MotionSummary:
        """Close the trajectory and hand its summary to the measure of the set."""
        types, counts = np.unique(self.particle_type, return_counts=True)
        still = self.free & self.sound & ~self.moved
        summary = MotionSummary(
            name=self.name,
            split=split,
            frame_dt=frame_dt,
            bounds=self.bounds,
            frames=self.frame_count,
            particle_type={int(t): int(n) for t, n in zip(types, counts, strict=True)},
            extent=np.stack([self.low, self.high], axis=1),
            statistics=self.statistics,
            spacing=0.0 if self.neighbors is None else self.neighbors.spacing,
            largest_step=self.largest,
            largest_at=self.largest_at,
            bad=self.bad,
            bad_at=self.bad_at,
            frozen=int(still.sum()) if self.moved.any() else 0,
            moving_kinematic=int((self.moved & ~self.free).sum()),
            duplicates=self.duplicates,
            standing_start=self.standing_start,
            repeated=self.repeated,
            shuffled=self.shuffled,
            identity_kept=identity_kept,
            jumps=self.jumps,
            jump_at=self.jump_at,
            gravity=np.median(self._flight, axis=0) if self._flight else None,
            grid=self.grid,
            outside=int((self.beyond & self.free).sum()),
            notes=notes,
        )
        self.into.motions.append(summary)
        self.into.beginnings += self._beginning
        self.into.steps.extend(self._steps.items)
        self.into.changes.extend(self._changes.items)
        if self._shown is not None:
            kinds = self.particle_type[self._shown]
            self.into.sheets.append(
                Sheet(name=self.name, particle_type=kinds, frames=self._sheet.items)
            )
        return summary
