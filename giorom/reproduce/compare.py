"""What is said about several trainings: means over seeds, paired differences, intervals."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import Any

import torch

RESAMPLES = 2000
"""Bootstrap samples of an interval."""

COVERAGE = 0.95
"""Share of the bootstrap samples inside an interval."""


def over_seeds(name: str, values: Sequence[float | int | None]) -> dict[str, float | int | None]:
    """Mean and range of a number over trainings: ``name``, ``name_min``, ``name_max``.

    Args:
        name: Name of the column.
        values: One for each training; none where it has no such number.
    """
    known = [value for value in values if value is not None]
    if not known:
        return dict.fromkeys((name, f"{name}_min", f"{name}_max"))
    return {name: fmean(known), f"{name}_min": min(known), f"{name}_max": max(known)}


def with_ratio(value: float | None, paper: float | None) -> dict[str, float | None]:
    """A number of the paper, and ours in units of it.

    Args:
        value: Ours; none where there is none.
        paper: The paper's, likewise.
    """
    known = value is not None and paper
    return {"paper": paper, "ratio": value / paper if known else None}


def score_columns(
    scores: list[dict[str, Any]], names: dict[str, tuple[str, str]]
) -> dict[str, Any]:
    """Some scores of several trainings as columns, and what each row has to say beside.

    Args:
        scores: What ``Study.scores`` gave for each training.
        names: Column, then where (``sparse`` or ``full``) and name of the score.
    """
    row: dict[str, Any] = {}
    for column, (where, key) in names.items():
        row |= over_seeds(column, [None if s[where] is None else s[where][key] for s in scores])
    row["diverged"] = (
        f"{sum(s['diverged'] for s in scores)}/{sum(s['trajectories'] for s in scores)}"
    )
    row["lasted"] = _lasted(scores)
    row |= over_seeds("steps", [s["steps"] for s in scores])
    row["parameters"] = next((s["parameters"] for s in scores if s["parameters"]), None)
    row["edges"] = next((s["edges"] for s in scores if s["edges"] is not None), None)
    row["seconds"] = over_seeds("seconds", [s["seconds"] for s in scores])["seconds"]
    row["trials"] = [s["trial"] for s in scores]
    return row


def _lasted(scores: list[dict[str, Any]]) -> float | None:
    """Frames that a rollout was inside the box and finite, mean over all; none without a model."""
    entries = [entry for score in scores for entry in score["per_trajectory"]]
    if not entries:
        return None
    return fmean((e["diverged_at"] or e["frames"] + 1) - 1.0 for e in entries)


def paired(
    these: list[dict[str, Any]], those: list[dict[str, Any]], *, key: str = "sparse_rollout_mse"
) -> dict[str, float | int | None]:
    """How much larger the error of one method is than that of another, trajectory by trajectory.

    Of each test trajectory the mean over the trainings whose rollout did not diverge is compared;
    the interval is a bootstrap over trajectories.

    Args:
        these: Scores of the trainings of one method.
        those: Scores of the trainings of the method it is compared with.
        key: Which error, in ``per_trajectory``.

    Returns:
        ``difference`` [m^2] and ``times``, the geometric mean of the ratio, with their bounds
        ``_low`` and ``_high``, and the number of ``pairs``.
    """
    one, other = _means(these, key), _means(those, key)
    common = sorted(set(one) & set(other))
    names = [f"{value}{end}" for value in ("difference", "times") for end in ("", "_low", "_high")]
    if not common:
        return dict.fromkeys(names) | {"pairs": 0}
    differences = [one[i] - other[i] for i in common]
    ratios = [math.log(max(one[i], 1e-300) / max(other[i], 1e-300)) for i in common]
    low, high = bootstrap_interval(differences)
    least, most = bootstrap_interval(ratios)
    bounds = (fmean(differences), low, high, *map(math.exp, (fmean(ratios), least, most)))
    return dict(zip(names, bounds, strict=True)) | {"pairs": len(common)}


def bootstrap_interval(values: list[float], *, seed: int = 0) -> tuple[float, float]:
    """Interval of the mean of some values: percentiles of the means of samples drawn of them."""
    known = torch.tensor(values, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(len(known), (RESAMPLES, len(known)), generator=generator)
    means = known[drawn].mean(dim=1)
    tail = torch.tensor([(1.0 - COVERAGE) / 2.0, (1.0 + COVERAGE) / 2.0], dtype=torch.float64)
    low, high = means.quantile(tail).tolist()
    return low, high


def _means(scores: list[dict[str, Any]], key: str) -> dict[int, float]:
    """Mean error of each trajectory over the trainings in which its rollout did not diverge."""
    found: dict[int, list[float]] = {}
    for score in scores:
        for number, entry in enumerate(score["per_trajectory"]):
            if entry["diverged_at"] is None and entry.get(key) is not None:
                found.setdefault(number, []).append(entry[key])
    return {number: fmean(values) for number, values in found.items()}
