"""Collect trajectories one by one and assemble them into a data set.

Making data takes hours and is interrupted. A *work folder* is the data set's own folder: it holds
``work.json`` (what is being made: preset, seed, material, parameters ...), one finished
trajectory per file ``parts/00012.h5`` and, once assembled, the split files and, last,
``metadata.json``. A part appears whole or not at all, so whoever continues asks
``finished_parts`` and makes the rest. Several processes may add parts at once.

``split_parts`` never puts a trajectory into two splits, and a trajectory keeps its split when
more are added later (but for sets so small that a split would be empty).
"""

import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.atomic import replacing, write_json
from giorom.data.statistics import Statistics, measure_statistics
from giorom.data.trajectory_file import (
    FORMAT_VERSION,
    SPLITS,
    DataError,
    new_trajectory_file,
    opened,
    read_trajectory_file,
    split_path,
    write_trajectory_file,
)
from giorom.state import Trajectory
from giorom.version import __version__

__all__ = [
    "assemble_dataset",
    "finished_parts",
    "open_work_folder",
    "part_path",
    "split_parts",
    "write_part",
]


def open_work_folder(folder: Path, *, identity: Mapping[str, Any]) -> None:
    """Claim a folder for one data set, or recognise it as the one begun earlier.

    Args:
        folder: The data set's folder; made if need be.
        identity: What is being made (preset, seed, material, parameters ...), as JSON values. The
            number of trajectories does not belong here: it may grow. The entries are copied into
            ``metadata.json``.

    Raises:
        DataError: If the folder holds another data set.
    """
    known = _read_identity(folder)
    wanted = json.loads(json.dumps(dict(identity)))
    if known is None:
        present = [name for name in _result_names() if (folder / name).exists()]
        if present:
            raise DataError(
                f"{folder} already holds {', '.join(present)} of another origin; nothing is "
                f"written over it. Choose an empty folder."
            )
        write_json(folder / "work.json", wanted)
        known = _read_identity(folder)
    for key in sorted(
        {*(known or {}), *wanted}, key=lambda k: (isinstance(wanted.get(k), dict), k)
    ):
        ours, theirs = wanted.get(key), (known or {}).get(key)
        if ours != theirs:
            raise DataError(
                f"{folder} holds another data set: {_difference(key, theirs, ours)}. "
                f"Choose another folder or the same settings."
            )


def _difference(key: str, theirs: Any, ours: Any) -> str:
    """What differs between two settings; of groups, only the entries that do."""
    if not (isinstance(theirs, dict) and isinstance(ours, dict)):
        return f"its {key} is {theirs!r}, not {ours!r}"
    names = [name for name in {**theirs, **ours} if theirs.get(name) != ours.get(name)]
    return "; ".join(_difference(f"{key}.{n}", theirs.get(n), ours.get(n)) for n in names)


def write_part(folder: Path, index: int, trajectory: Trajectory) -> Path:
    """Add a finished trajectory to a work folder, atomically.

    Args:
        folder: A folder claimed with ``open_work_folder``.
        index: Number of the trajectory; an existing part of that number is replaced.
        trajectory: What to store.

    Returns:
        The path of the part.

    Raises:
        DataError: If the folder was not claimed.
    """
    if _read_identity(folder) is None:
        raise DataError(f"{folder} has no work.json. Call open_work_folder before write_part.")
    path = part_path(folder, index)
    write_trajectory_file(trajectory, path)
    return path


def part_path(folder: Path, index: int) -> Path:
    """Path of a part, whether or not it exists.

    Args:
        folder: The work folder.
        index: Number of the trajectory.

    Returns:
        The path.
    """
    return folder / "parts" / f"{index:05d}.h5"


def finished_parts(folder: Path) -> list[int]:
    """Numbers of the trajectories that are finished, in rising order.

    Args:
        folder: The work folder.

    Returns:
        The numbers; files still being written are not among them.
    """
    names = (path.name for path in (folder / "parts").glob("*.h5"))
    matches = (re.fullmatch(r"(\d{5,})\.h5", name) for name in names)
    return sorted(int(match[1]) for match in matches if match)


def split_parts(
    parts: Sequence[int], *, valid_share: float = 0.1, test_share: float = 0.1
) -> dict[str, list[int]]:
    """Divide trajectories among train, valid and test, deterministically.

    Trajectory i goes to the split that lags furthest behind its share of the first i + 1, so
    that the answer for i depends on i and the shares alone. A share above zero gets at least one
    trajectory if there are three.

    Args:
        parts: Numbers of the trajectories, without repeats.
        valid_share: Share for validation, in [0, 1).
        test_share: Share for the test, in [0, 1).

    Returns:
        The numbers of each split, in rising order.

    Raises:
        ValueError: If the shares leave nothing to train on.
    """
    shares = {"train": 1.0 - valid_share - test_share, "valid": valid_share, "test": test_share}
    if min(valid_share, test_share) < 0.0 or not shares["train"] > 0.0:
        raise ValueError(
            f"valid_share and test_share must be >= 0 and add to less than 1, got {valid_share!r} "
            f"and {test_share!r}. Lower them."
        )
    taken = dict.fromkeys(SPLITS, 0)
    split_of = []
    for index in range(max(parts, default=-1) + 1):
        lag = {name: round(shares[name] * (index + 1) - taken[name], 9) for name in SPLITS}
        chosen = max(SPLITS, key=lag.__getitem__)
        taken[chosen] += 1
        split_of.append(chosen)
    split = {name: [i for i in sorted(parts) if split_of[i] == name] for name in SPLITS}
    for name in ("test", "valid"):
        if len(parts) >= 3 and shares[name] > 0.0 and not split[name]:
            largest = max(SPLITS, key=lambda other: len(split[other]))
            split[name].append(split[largest].pop())
    return split


def assemble_dataset(
    folder: Path,
    *,
    radius: float,
    splits: Mapping[str, Sequence[int]] | None = None,
    keep_parts: bool = True,
    statistics: Statistics | None = None,
) -> dict[str, Any]:
    """Make the split files and the metadata from the finished parts.

    Any earlier ``metadata.json`` is removed first and the new one written last, so that an
    interrupted assembly leaves an unfinished data set and not a mixed one.

    Args:
        folder: The work folder.
        radius: Default interaction radius for the metadata [m].
        splits: Numbers of the parts of each split; ``split_parts`` of all parts by default.
        keep_parts: Whether the parts stay, which allows more to be added later.
        statistics: Those of the training split, per frame, where they are known already;
            measured by default.

    Returns:
        The metadata.

    Raises:
        DataError: If there is no training trajectory, a part is damaged, a trajectory is in two
            splits, or the parts differ in dimension, bounds or frame time.
    """
    identity = _read_identity(folder)
    if identity is None:
        raise DataError(f"{folder} has no work.json, so it is no work folder. Check the path.")
    chosen = dict(splits) if splits is not None else split_parts(finished_parts(folder))
    _check_splits(chosen, folder)
    scene = _common_scene(folder, chosen)
    (folder / "metadata.json").unlink(missing_ok=True)
    for name in SPLITS:
        _write_split(folder, name, chosen.get(name, ()))
    if statistics is None:
        training = (read_trajectory_file(part_path(folder, part)) for part in chosen["train"])
        statistics = measure_statistics(training)
    metadata = {
        **scene,
        "default_connectivity_radius": radius,
        **statistics.to_metadata(),
        **_versions(),
    }
    _merge_identity(metadata, identity, folder)
    write_json(folder / "metadata.json", metadata)
    if not keep_parts:
        shutil.rmtree(folder / "parts")
    return metadata


def _result_names() -> tuple[str, ...]:
    """Files that show a folder to hold a data set."""
    return ("metadata.json", "parts", *(f"{name}.h5" for name in SPLITS))


def _read_identity(folder: Path) -> dict[str, Any] | None:
    """What the folder was claimed for, or None if it was not."""
    path = folder / "work.json"
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, TypeError, ValueError) as error:
        raise DataError(f"{path} is not readable JSON ({error}). Choose another folder.") from None


def _check_splits(splits: Mapping[str, Sequence[int]], folder: Path) -> None:
    """Reject unknown splits, leaks and an empty training split."""
    unknown = sorted(set(splits) - set(SPLITS))
    if unknown:
        raise DataError(f"there is no split {unknown[0]!r}; choose among {', '.join(SPLITS)}.")
    parts = [part for name in SPLITS for part in splits.get(name, ())]
    repeated = sorted({part for part in parts if parts.count(part) > 1})
    if repeated:
        raise DataError(
            f"trajectory {repeated[0]} is used twice; each may be in one split only, or the test "
            f"measures memory. Repair the splits."
        )
    if not splits.get("train"):
        raise DataError(f"{folder} has no finished training trajectory. Make some first.")


def _common_scene(folder: Path, splits: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """Metadata every part must agree on, and the counts."""
    reference, frame_counts, particles = None, {}, 0
    for name in SPLITS:
        frame_counts[name] = []
        for path in (part_path(folder, part) for part in splits.get(name, ())):
            scene, shape = _part_scene(path)
            reference = reference or scene
            if scene != reference:
                key = next(key for key in scene if scene[key] != reference[key])
                raise DataError(
                    f"{path} has {key}={scene[key]!r}, the others have {reference[key]!r}; the "
                    f"trajectories of a data set share it. Remove the odd one."
                )
            frame_counts[name].append(shape[0])
            particles = max(particles, shape[1])
    shortest = {name: min(counts, default=0) for name, counts in frame_counts.items()}
    return {
        **(reference or {}),
        "sequence_length": shortest["train"] - 1,
        "num_particles_max": particles,
        "periodic_boundary_conditions": [False] * 3,
        **{f"num_trajs_{name}": len(frame_counts[name]) for name in SPLITS},
        **{f"sequence_length_{name}": shortest[name] for name in SPLITS},
    }


def _part_scene(path: Path) -> tuple[dict[str, Any], tuple[int, ...]]:
    """Bounds, dimension and frame time of a part, and the shape of its positions."""
    with opened(path) as file:
        group = file["00000"]
        shape = tuple(int(length) for length in group["position"].shape)
        scene = {
            "bounds": [list(_decimals(pair)) for pair in group.attrs["bounds"]],
            "dim": shape[2],
            "dt": float(group.attrs["frame_dt"]),
        }
    return scene, shape


def _decimals(numbers: Any) -> Iterator[float]:
    """Shortest decimals that give the stored numbers back: 0.1, not 0.10000000149."""
    return (float(str(np.float32(number))) for number in numbers)


def _write_split(folder: Path, name: str, parts: Sequence[int]) -> None:
    """Copy the compressed parts of one split into its file."""
    with replacing(split_path(folder, name)) as temporary, new_trajectory_file(temporary) as file:
        for position, part in enumerate(parts):
            with opened(part_path(folder, part)) as source:
                source.copy("00000", file, name=f"{position:05d}")
            file[f"{position:05d}"].attrs["part"] = part


def _versions() -> dict[str, Any]:
    """What the reader of the metadata must know about the program and the units."""
    return {
        "format_version": FORMAT_VERSION,
        "giorom_version": __version__,
        "units": {"length": "m", "time": "s", "statistics": "m/frame and m/frame^2"},
    }


def _merge_identity(metadata: dict[str, Any], identity: dict[str, Any], folder: Path) -> None:
    """Add what the data set is, keeping the keys that other loaders read."""
    clash = sorted(set(metadata) & set(identity))
    if clash:
        raise DataError(f"{folder}/work.json may not name {clash[0]!r}: the metadata defines it.")
    metadata.update(identity)
