"""The metadata of a data set: what a reader must know before it opens a trajectory.

``metadata.json`` carries GNS's keys and LagrangeBench's, so that their loaders open the data, and
ours. It is written last; a data set without it is unfinished. Lengths are metres, times
seconds, and the four statistics (``vel_mean`` ...) are per frame, as in GNS.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

__all__ = ["FORMAT_VERSION", "DataError", "read_metadata"]

FORMAT_VERSION = 1
"""Version of the layout; a reader refuses files of a later one."""

MOST_BYTES = 16 << 20
"""Longest metadata file that is read."""

REQUIRED_KEYS = ("bounds", "sequence_length", "default_connectivity_radius", "dim", "dt")
"""Metadata a data set cannot be used without (GNS's names)."""


class DataError(ValueError):
    """A data file is missing, damaged, foreign or does not fit the others."""


def read_metadata(folder: Path) -> dict[str, Any]:
    """Read and check ``metadata.json`` of a data set.

    Args:
        folder: The data set.

    Returns:
        GNS's keys (``dt`` [s] is the real time between frames; velocities and accelerations
        are per frame), LagrangeBench's, and ours.

    Raises:
        DataError: If the file is missing, is not JSON, lacks a key, or is of a later format.
    """
    path = folder / "metadata.json"
    if not os.path.exists(path):
        raise DataError(
            f"{folder} has no metadata.json, so it is no finished data set: that file is "
            f"written last. Run the command that makes the data again; it continues."
        )
    if not os.path.isfile(path) or os.path.getsize(path) > MOST_BYTES:
        raise DataError(
            f"{path} is no file of at most {MOST_BYTES} bytes, as metadata are. Restore or remake "
            f"it."
        )
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        reason = str(error)[:200]
        raise DataError(f"{path} is not readable JSON ({reason}). Restore or remake it.") from None
    _check_metadata(metadata, path)
    return metadata


def _check_metadata(metadata: Any, path: Path) -> None:
    """Reject metadata that no reader could use."""
    if not isinstance(metadata, dict):
        raise DataError(f"{path} must hold a JSON object, not a {type(metadata).__name__}.")
    missing = [key for key in REQUIRED_KEYS if key not in metadata]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}. It is no metadata of a data set.")
    version = metadata.get("format_version", 0)
    if type(version) is not int or version > FORMAT_VERSION:
        raise DataError(
            f"{path} has format version {_short(version)}, this program reads up to "
            f"{FORMAT_VERSION}. Install a newer giorom, or remake the data."
        )
    if metadata["dim"] not in (2, 3) or not _are_walls(metadata["bounds"], metadata["dim"]):
        raise DataError(
            f"{path} says dim={_short(metadata['dim'])} and bounds={_short(metadata['bounds'])}; "
            f"dim must be 2 or 3, with one [lower, upper] of finite numbers per axis. Restore it."
        )
    if not (_is_number(metadata["dt"]) and metadata["dt"] > 0.0):
        raise DataError(f"{path} says dt={_short(metadata['dt'])}; it must be > 0 s. Restore it.")


def _are_walls(bounds: Any, dimension: int) -> bool:
    """Whether there is a lower and an upper number for each axis."""
    return (
        isinstance(bounds, list)
        and len(bounds) == dimension
        and all(isinstance(pair, list) and len(pair) == 2 for pair in bounds)
        and all(_is_number(number) for pair in bounds for number in pair)
    )


def _is_number(value: Any) -> bool:
    """Whether a value is a number that float64 holds."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= sys.float_info.max


def _short(value: Any) -> str:
    """A value as a message shows it."""
    return repr(value)[:80]
