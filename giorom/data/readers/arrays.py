"""The way in for people with their own loader: an iterator of arrays becomes a foreign trajectory.

    motion = from_arrays(my_frames, frame_dt=0.01)      # my_frames(): yields arrays (p, d)

Exceptions of the caller's own iterator pass through; what it yields is checked.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from giorom.data.readers.source import DataError, ForeignTrajectory
from giorom.state import PARTICLE_TYPE_COUNT, WATER

__all__ = ["from_arrays"]


def from_arrays(
    frames: Iterable[Any] | Callable[[], Iterable[Any]],
    *,
    particle_type: Any | None = None,
    frame_dt: float | None = None,
    bounds: Any | None = None,
    name: str = "arrays",
) -> ForeignTrajectory:
    """Make a trajectory of positions that the caller has or makes.

    Args:
        frames: Positions of shape (p, d) frame after frame: an array of shape (t, p, d), a list,
            anything that can be iterated again, or a function that starts a new iteration. An
            iterator or generator is read once; reading it again is an error. The same row must be
            the same particle in every frame.
        particle_type: GNS types, one per particle; water (5) for all by default.
        frame_dt: Time between frames [s], if known.
        bounds: Lower and upper wall of each axis, shape (d, 2), if known.
        name: What messages call it.

    Returns:
        The motion. The first frame is read at once.

    Raises:
        DataError: If there is no frame, or a shape or a type is wrong.
    """
    first, start = _opened(frames, name)
    if first is None:
        raise DataError(f"{name} has no frames; a motion needs at least one.")
    first = _checked(first, None, name, 0)
    types = np.full(len(first), WATER) if particle_type is None else np.asarray(particle_type)
    if types.shape != (len(first),) or types.dtype.kind not in "iu":
        raise DataError(
            f"{name}: particle_type is {types.dtype} of shape {types.shape}; it must be one whole "
            f"number for each of the {len(first)} particles."
        )
    if types.min() < 0 or types.max() >= PARTICLE_TYPE_COUNT:
        raise DataError(
            f"{name}: particle_type goes from {types.min()} to {types.max()}; types lie between 0 "
            f"and {PARTICLE_TYPE_COUNT - 1} (GNS convention). Renumber them."
        )
    walls = None if bounds is None else np.asarray(bounds, dtype=np.float64)
    if walls is not None and walls.shape != (first.shape[1], 2):
        raise DataError(
            f"{name}: bounds has shape {walls.shape}; it must be one [lower, upper] for each of "
            f"the {first.shape[1]} axes."
        )
    if frame_dt is not None and not frame_dt > 0.0:
        raise DataError(f"{name}: frame_dt is {frame_dt!r}; it must be a time > 0 s.")

    def read() -> Iterator[np.ndarray]:
        for index, frame in enumerate(start()):
            yield _checked(frame, first.shape, name, index)

    return ForeignTrajectory(
        name=name,
        particle_type=types.astype(np.int64),
        frames=read,
        frame_count=len(frames) if isinstance(frames, list | tuple | np.ndarray) else None,
        frame_dt=None if frame_dt is None else float(frame_dt),
        bounds=walls,
    )


def _opened(
    frames: Iterable[Any] | Callable[[], Iterable[Any]], name: str
) -> tuple[Any | None, Callable[[], Iterator[Any]]]:
    """The first frame, and a function that starts an iteration over all of them."""
    if not isinstance(frames, Iterator):

        def restart() -> Iterator[Any]:
            return iter(frames() if callable(frames) else frames)

        return next(restart(), None), restart

    held = list(itertools.islice(frames, 1))
    used = False

    def start() -> Iterator[Any]:
        nonlocal used
        if used:
            raise DataError(
                f"{name} was given as an iterator, which can be read once, and has been read. Give "
                f"a function that starts a new one: from_arrays(lambda: make_frames())."
            )
        used = True
        return _rest(held, frames)

    return held[0] if held else None, start


def _rest(held: list[Any], frames: Iterator[Any]) -> Iterator[Any]:
    """The frame that was looked at, then the others; nothing is held any longer."""
    while held:
        yield held.pop()
    yield from frames


def _checked(frame: Any, shape: tuple[int, ...] | None, name: str, index: int) -> np.ndarray:
    """One frame as an array of floating-point numbers of the right shape."""
    try:
        position = np.asarray(frame)
    except (ValueError, TypeError) as error:
        raise DataError(f"{name}: frame {index} is no array ({error}). Yield arrays.") from None
    if position.dtype.kind not in "fiu" or position.ndim != 2 or position.shape[1] not in (2, 3):
        raise DataError(
            f"{name}: frame {index} is {position.dtype} of shape {position.shape}; it must be "
            f"numbers of shape (particles, 2 or 3)."
        )
    if not len(position):
        raise DataError(f"{name}: frame {index} has no particles; it needs at least one.")
    if shape is not None and position.shape != shape:
        raise DataError(
            f"{name}: frame {index} has shape {position.shape}, the first frame {shape}; a motion "
            f"needs the same particles in every frame (inlets and outlets are not supported). Keep "
            f"only the particles that are in every frame, or resample."
        )
    if position.dtype.kind != "f":
        return position.astype(np.float64)
    return position
