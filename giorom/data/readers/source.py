"""What a reader of foreign data gives: motions that are not read yet.

Every reader turns its format into ``ForeignTrajectory`` records whose frames come one at a
time, so that memory does not depend on the size of a file. What a format does not say
(time between frames, walls, units) stays unknown here; ``giorom.data.importing`` fills it in from
the command line, or guesses and says so. Nothing here checks that positions are finite: the report
has to see what is wrong with the data first.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from giorom.data.metadata import DataError

__all__ = ["DataError", "ForeignTrajectory", "Reader"]

MOST_PARTICLES = 100_000_000
"""Most particles a header may announce; more is a damaged or hostile file."""


@dataclass(frozen=True, kw_only=True)
class ForeignTrajectory:
    """One motion in somebody else's file."""

    name: str
    """Where it stands in the source, for messages: ``train.tfrecord[3]``."""

    particle_type: Int[np.ndarray, " p"]
    """GNS particle types, int64; 5 (water) for every particle of a format without types."""

    frames: Callable[[], Iterator[Float[np.ndarray, "p d"]]]
    """Starts reading: positions of one frame after the other, in the source's own unit and
    precision, particles in the same order in every frame. May be called more than once. Raises
    ``DataError`` where the source is damaged, never another exception for what a file holds."""

    frame_count: int | None = None
    """Number of frames where the source says it before it is read."""

    split: str | None = None
    """``train``, ``valid`` or ``test`` where the source says so."""

    frame_dt: float | None = None
    """Time between frames where the source says it [s]."""

    bounds: Float[np.ndarray, "d 2"] | None = None
    """Lower and upper wall of each axis where the source says them."""

    identity_kept: bool | None = None
    """Whether the same row is the same particle in every frame; None: the format does not say,
    the report judges by the motion."""

    notes: tuple[str, ...] = ()
    """What the reader guessed, repaired or left out, one sentence each."""


@dataclass(frozen=True, kw_only=True)
class Reader:
    """One foreign format."""

    name: str
    """Name on the command line, such as ``gns-tfrecord``."""

    title: str
    """Format and origin in a few words."""

    detect: Callable[[Path], bool]
    """Whether a file or folder is of this format: from its content, quickly, never raising."""

    read: Callable[[Path], Iterator[ForeignTrajectory]]
    """The motions of a file or folder, in its order. Raises ``DataError`` in one clear line."""
