"""What a work folder remembers beside its trajectories: measurements and failures.

``log/simulate.jsonl`` has one line for each trajectory made: how long it took and how many
particle-substeps that was. Wall times live here and not in the trajectory files, which are the
same, byte for byte, whenever they are made. ``failures.json`` lists the trajectories that could
not be made, and why; it is absent if there are none.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from giorom.data.atomic import LEFTOVER, write_json


def append_entry(folder: Path, name: str, entry: Mapping[str, Any]) -> None:
    """Add a line of JSON to ``log/NAME.jsonl``.

    Args:
        folder: The work folder.
        name: Name of the log; one process writes to it at a time.
        entry: JSON values.
    """
    path = folder / "log" / f"{name}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(dict(entry), allow_nan=False) + "\n")


def read_entries(folder: Path, name: str) -> Iterator[dict[str, Any]]:
    """The lines of a log; one that was cut off by a kill is left out.

    Args:
        folder: The work folder.
        name: Name of the log, which need not exist.

    Yields:
        Each entry, oldest first.
    """
    path = folder / "log" / f"{name}.jsonl"
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except ValueError:
            continue


def keep_failures(folder: Path, failures: Mapping[int, str]) -> None:
    """Write ``failures.json``, or remove it if there are none.

    Args:
        folder: The work folder.
        failures: Reason for each trajectory that could not be made.
    """
    path = folder / "failures.json"
    if not failures:
        path.unlink(missing_ok=True)
        return
    listed = [{"index": index, "reason": failures[index]} for index in sorted(failures)]
    write_json(path, {"failures": listed})


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a work folder.

    Args:
        folder: The work folder; nobody else may be writing to it.
    """
    for place in (folder, folder / "parts"):
        for path in place.glob(".*") if place.is_dir() else ():
            if LEFTOVER.fullmatch(path.name) and path.is_file():
                path.unlink(missing_ok=True)
