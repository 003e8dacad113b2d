"""Checks that every reader makes on positions and particle types before it believes them."""

import numpy as np
from jaxtyping import Int

from giorom.data.metadata import DataError
from giorom.data.readers.lazy_array import LazyArray
from giorom.data.readers.source import MOST_PARTICLES
from giorom.state import PARTICLE_TYPE_COUNT

__all__ = ["check_frames", "checked_types", "types_from"]

MOST_FRAMES = 10_000_000
"""Most frames a header may announce."""


def checked_types(types: np.ndarray, count: int, where: str) -> Int[np.ndarray, " p"]:
    """Particle types as int64, one for each particle.

    Args:
        types: What the file holds: one number, or one for each particle.
        count: Number of particles.
        where: What to name in messages.

    Returns:
        The types.

    Raises:
        DataError: If they are no integers of GNS's range or are not as many as particles.
    """
    if types.dtype.kind not in "iu" or types.size not in (1, count) or types.ndim > 2:
        raise DataError(
            f"{where} has particle types of type {types.dtype} and shape {types.shape}; it must be "
            f"one integer, or one for each of the {count} particles."
        )
    wrong = types[(types < 0) | (types >= PARTICLE_TYPE_COUNT)]
    if wrong.size:
        raise DataError(
            f"{where} has the particle type {int(wrong.flat[0])}; types lie between 0 and "
            f"{PARTICLE_TYPE_COUNT - 1} (GNS convention). It is damaged, of the other byte order, "
            f"or must be renumbered."
        )
    return np.ascontiguousarray(np.broadcast_to(types.reshape(-1).astype(np.int64), (count,)))


def types_from(array: LazyArray, count: int, where: str) -> Int[np.ndarray, " p"]:
    """Particle types of an array that is still in the file.

    Args:
        array: The array.
        count: Number of particles.
        where: What to name in messages.

    Returns:
        The types.

    Raises:
        DataError: As ``checked_types``; an array that is too long is not read.
    """
    if not array.is_integer or array.byte_count > 8 * max(count, 1):
        raise DataError(
            f"{where} has particle types of type {array.dtype} and shape {array.shape}; it must be "
            f"one integer, or one for each of the {count} particles."
        )
    return checked_types(array.read(most_bytes=8 * count), count, where)


def check_frames(frames: int, particles: int, dimension: int, where: str) -> None:
    """Reject counts that no motion has.

    Args:
        frames: Number of frames.
        particles: Number of particles.
        dimension: Axes of space.
        where: What to name in messages.

    Raises:
        DataError: If one is zero or absurd.
    """
    if dimension not in (2, 3):
        raise DataError(f"{where} has {dimension} coordinates per particle; there must be 2 or 3.")
    if not (1 <= frames <= MOST_FRAMES and 1 <= particles <= MOST_PARTICLES):
        raise DataError(
            f"{where} has {frames} frames of {particles} particles; there must be at least one of "
            f"each, and at most {MOST_FRAMES} frames and {MOST_PARTICLES} particles."
        )
