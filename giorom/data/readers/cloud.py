"""The points of one frame, and the checks that every parser of points shares.

A parser hands positions and named numbers per point to ``cloud_of``, which tells identities and
types by their names. Sizes that a file announces are compared with the size of the file before
anything is allocated; what damaged bytes cause becomes a ``DataError`` in ``reading``.
"""

import lzma
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers.expat import ExpatError

import numpy as np
from jaxtyping import Float, Int, Integer

from giorom.data.readers.source import MOST_PARTICLES, DataError
from giorom.state import PARTICLE_TYPE_COUNT, WATER

__all__ = [
    "Cloud",
    "check_byte_order",
    "check_count",
    "cloud_of",
    "reading",
    "role_of",
    "text_lines",
]

ROLES = {
    "id": "identity",
    "ids": "identity",
    "globalpointids": "identity",
    "particle_id": "identity",
    "particleid": "identity",
    "idp": "identity",
    "particle_type": "type",
    "type": "type",
}
"""What a number per point means, by its name in lower case; ``idp`` is DualSPHysics's."""

LINE_BYTES = 1 << 20
"""Longest line of a text file; a longer one is no text."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """The points of one file."""

    position: Float[np.ndarray, "p d"]
    """Positions in the file's order, unit and precision."""

    identity: Integer[np.ndarray, " p"] | None = None
    """A number that names each particle for good."""

    particle_type: Int[np.ndarray, " p"] | None = None
    """GNS particle types."""

    time: float | None = None
    """Time of the frame, if the file says it [s]."""

    topology: str | None = None
    """A digest of the faces; the same in every frame of a mesh that keeps its vertices."""

    notes: tuple[str, ...] = ()
    """What was guessed or left out."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what a parser meets in a damaged file into a ``DataError``.

    Args:
        path: The file, for the message.

    Raises:
        DataError: Instead of the exceptions that bytes can cause.
    """
    if not path.is_file():
        raise DataError(f"{path} is no file. Check the path.")
    try:
        with np.errstate(all="ignore"):
            yield
    except DataError:
        raise
    except (
        OSError,
        ValueError,
        ArithmeticError,
        LookupError,
        MemoryError,
        EOFError,
        struct.error,
        zlib.error,
        lzma.LZMAError,
        ExpatError,
    ) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"{path} is damaged or truncated ({reason[:200]}). Copy it again or remake it."
        ) from None


def role_of(name: str) -> str | None:
    """What a number per point means, told from its name.

    Args:
        name: Its name in the file.

    Returns:
        ``identity``, ``type``, or None if the name says nothing to us.
    """
    return ROLES.get(name.strip().lower())


def check_count(count: int, room: int, size: int, *, path: Path, what: str = "points") -> None:
    """Refuse a number of points that a file cannot hold, before anything is allocated.

    Args:
        count: What the header announces.
        room: Bytes left in the file.
        size: Fewest bytes that each takes.
        path: The file, for the message.
        what: What is counted.

    Raises:
        DataError: If there are none, too many, or more than fit into the file.
    """
    if count < 1:
        raise DataError(f"{path} holds {count} {what}; a frame needs at least one. Remove it.")
    if count > MOST_PARTICLES:
        raise DataError(
            f"{path} announces {count} {what}, more than the {MOST_PARTICLES} that are read. "
            f"Check the file."
        )
    if count * size > room:
        raise DataError(
            f"{path} announces {count} {what}, which take at least {count * size} bytes, but "
            f"{room} are left in the file. It is truncated or damaged; copy it again."
        )


def check_byte_order(position: np.ndarray, *, path: Path) -> None:
    """Refuse numbers that only make sense with their bytes in the other order.

    Args:
        position: What was read.
        path: The file, for the message.

    Raises:
        DataError: If less than half of the numbers have a usual size and turning the bytes
            round gives it to nearly all.
    """
    if position.dtype.kind != "f" or _usual_share(position) >= 0.5:
        return
    if _usual_share(position.byteswap()) > 0.9:
        raise DataError(
            f"{path} has its numbers in the other byte order than its header says. Correct the "
            f"header, or write the file with a current program."
        )


def _usual_share(values: np.ndarray) -> float:
    """Share of the numbers that are zero or between 1e-9 and 1e9 in size."""
    with np.errstate(invalid="ignore"):
        size = np.abs(values)
        usual = (size == 0) | ((size > 1e-9) & (size < 1e9))
    return float(usual.mean())


def text_lines(stream: Any, *, path: Path) -> Iterator[bytes]:
    """Lines of a text file without their ends, one at a time.

    Args:
        stream: The file, open for reading bytes.
        path: The file, for the message.

    Yields:
        Each line.

    Raises:
        DataError: If a line is too long to be text.
    """
    while line := stream.readline(LINE_BYTES):
        if len(line) == LINE_BYTES:
            raise DataError(
                f"{path} has a line of more than {LINE_BYTES} bytes; it is no text file or a "
                f"damaged one. Copy it again."
            )
        yield line.rstrip(b"\r\n")


def cloud_of(
    position: np.ndarray,
    fields: Mapping[str, np.ndarray],
    *,
    path: Path,
    time: float | None = None,
    topology: str | None = None,
    notes: tuple[str, ...] = (),
) -> Cloud:
    """Put points and their numbers together, by the meaning of the names.

    Args:
        position: Positions, shape (p, d), any number type.
        fields: Numbers per point by name; names without a known role are left out.
        path: The file, for messages.
        time: Time of the frame [s].
        topology: Digest of the faces.
        notes: What the parser has to say.

    Returns:
        The points.

    Raises:
        DataError: If a field has another length, or an identity or a type is impossible.
    """
    check_count(len(position), len(position), 0, path=path)
    if position.dtype.kind != "f" or position.dtype.itemsize < 4:
        position = position.astype(np.float64)
    identity, kind, kind_name = None, None, ""
    for name in ROLES:
        for key, values in fields.items():
            if key.strip().lower() != name:
                continue
            if values.shape != (len(position),):
                raise DataError(
                    f"{path}: '{key}' has shape {values.shape}; it must be one number for each "
                    f"of the {len(position)} points. Remake the file."
                )
            if ROLES[name] == "identity" and identity is None:
                identity = _whole(values, key, path)
            elif ROLES[name] == "type" and kind is None:
                kind, kind_name = values, key
    if kind is not None:
        foreign = any(key.strip().lower() == "idp" for key in fields)
        kind, more = _types(kind, kind_name, path, foreign=foreign)
        notes = (*notes, *more)
    return Cloud(
        position=position.astype(position.dtype.newbyteorder("="), copy=False),
        identity=identity,
        particle_type=kind,
        time=time,
        topology=topology,
        notes=notes,
    )


def _whole(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    """Values as whole numbers, or a ``DataError``."""
    if values.dtype.kind in "iu":
        return values.astype(values.dtype.newbyteorder("="), copy=False)
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(values) < 2.0**53) | (values != np.rint(values))
    if wrong.any():
        raise DataError(
            f"{path}: '{name}' of point {int(wrong.argmax())} is {values[wrong.argmax()]:g}; it "
            f"must be a whole number below 2^53. Rename or remake that field."
        )
    return values.astype(np.int64)


def _types(
    values: np.ndarray, name: str, path: Path, *, foreign: bool
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """GNS types of a field, or nothing and why."""
    if foreign:
        return None, (
            f"'{name}' stands beside 'Idp' and so holds DualSPHysics's numbers, which are not the "
            f"GNS types; it is left out and every particle is taken for type {WATER} (water).",
        )
    exact = name.strip().lower() == "particle_type"
    try:
        kind = _whole(values, name, path)
        outside = (kind < 0) | (kind >= PARTICLE_TYPE_COUNT)
        found = int(kind[outside.argmax()]) if outside.any() else None
    except DataError:
        if exact:
            raise
        kind, found = values, values[0]
    if found is None:
        return kind.astype(np.int64), (f"'{name}' is taken for the GNS particle type.",)
    if exact:
        raise DataError(
            f"{path}: '{name}' holds {found}; types lie between 0 and {PARTICLE_TYPE_COUNT - 1} "
            f"(GNS convention). Renumber them."
        )
    return None, (
        f"'{name}' holds {found}, which is no GNS type (0 to {PARTICLE_TYPE_COUNT - 1}); it is "
        f"left out and every particle is taken for type {WATER} (water).",
    )
