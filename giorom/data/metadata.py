"""The metadata of a data set: what a reader must know before it opens a trajectory.

``metadata.json`` carries GNS's keys and LagrangeBench's, so that their loaders open the data, and
ours. It is written last; a data set without it is unfinished. Lengths are metres, times
seconds, and the four statistics (``vel_mean`` ...) are per frame, as in GNS.
"""

import json
from pathlib import Path
from typing import Any

__all__ = ["FORMAT_VERSION", "DataError", "read_metadata"]

FORMAT_VERSION = 1
"""Version of the layout; a reader refuses files of a later one."""

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
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(
            f"{folder} has no metadata.json, so it is no finished data set: that file is "
            f"written last. Run the command that makes the data again; it continues."
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} is not readable JSON ({error}). Restore or remake it.") from None
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
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise DataError(
            f"{path} has format version {str(version)[:40]}, this program reads up to "
            f"{FORMAT_VERSION}. Install a newer giorom."
        )
    bounds = metadata["bounds"] if isinstance(metadata["bounds"], list) else []
    if metadata["dim"] not in (2, 3) or len(bounds) != metadata["dim"]:
        raise DataError(
            f"{path} says dim={metadata['dim']!r} with {len(bounds)} bounds; dim must be 2 or 3 "
            f"with one [lower, upper] per axis."
        )
