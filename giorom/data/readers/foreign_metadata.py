"""The ``metadata.json`` that stands beside GNS, LagrangeBench and MPM-Verse data.

Foreign metadata are used where they make sense and left alone where they do not: only the frame
time, the walls, the dimension and whether the box is periodic are taken, never the statistics.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError

__all__ = ["ForeignMetadata", "read_foreign_metadata"]

MOST_BYTES = 1 << 20
"""Longest metadata file."""


@dataclass(frozen=True, kw_only=True)
class ForeignMetadata:
    """What is taken from the metadata."""

    frame_dt: float | None = None
    """Time between frames [s]."""

    bounds: Float[np.ndarray, "d 2"] | None = None
    """Walls of each axis."""

    dimension: int | None = None
    """Axes of space."""

    notes: tuple[str, ...] = ()
    """What is missing or special."""


def read_foreign_metadata(folder: Path) -> ForeignMetadata:
    """Read ``metadata.json`` of a folder of foreign data, if there is one.

    Args:
        folder: Where the data lie.

    Returns:
        What it says; everything unknown if it does not exist.

    Raises:
        DataError: If it exists and is no JSON object, or holds impossible values.
    """
    path = folder / "metadata.json"
    if not path.is_file():
        return ForeignMetadata(notes=("No metadata.json stands beside the data.",))
    raw = _read_object(path)
    blocks = [raw[key] for key in ("train", "rollout") if isinstance(raw.get(key), dict)]
    values = raw if "bounds" in raw or not blocks else {**raw, **blocks[0]}
    notes = []
    if any(_list_of(values.get("periodic_boundary_conditions"))):
        notes.append(
            "The box is periodic; positions are taken as they stand and jump at its faces."
        )
    bounds = _bounds(values, path)
    dimension = values.get("dim", None if bounds is None else len(bounds))
    if dimension not in (None, 2, 3):
        raise DataError(f"{path} says dim={str(dimension)[:40]!r}; it must be 2 or 3. Correct it.")
    return ForeignMetadata(
        frame_dt=_frame_dt(values, path), bounds=bounds, dimension=dimension, notes=tuple(notes)
    )


def _read_object(path: Path) -> dict[str, Any]:
    """The JSON object of a file."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise DataError(f"{path} is longer than any metadata. Remove it.")
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} is no readable JSON. Correct or remove it.") from None
    if not isinstance(raw, dict):
        raise DataError(f"{path} must hold a JSON object. Correct or remove it.")
    return raw


def _frame_dt(values: dict[str, Any], path: Path) -> float | None:
    """Time between frames; LagrangeBench's ``dt`` is the solver's step."""
    if values.get("dt") is None:
        return None
    step, every = _number(values["dt"], path), _number(values.get("write_every", 1), path)
    if not step * every > 0.0:
        raise DataError(f"{path} says dt={step!r}; a frame time must be > 0 s. Correct it.")
    return step * every


def _bounds(values: dict[str, Any], path: Path) -> Float[np.ndarray, "d 2"] | None:
    """Walls, checked."""
    if values.get("bounds") is None:
        return None
    pairs = _list_of(values["bounds"])
    if len(pairs) not in (2, 3) or any(len(_list_of(pair)) != 2 for pair in pairs):
        raise DataError(f"{path}: bounds must be [lower, upper] for each of 2 or 3 axes.")
    bounds = np.array([[_number(value, path) for value in pair] for pair in pairs])
    if not (bounds[:, 0] < bounds[:, 1]).all():
        raise DataError(f"{path}: each lower bound must lie below the upper one. Correct it.")
    return bounds


def _list_of(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _number(value: Any, path: Path) -> float:
    """A finite number."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
        number = float(value)
        if math.isfinite(number):
            return number
    raise DataError(f"{path} holds {str(value)[:40]!r} where a number must stand. Correct it.")
