"""Time-steppers side by side: the machinery of Table 3 and of the peers it lacks.

All start from the same given frames of the same samples and forecast these samples (task T2 of
docs/protocol.md): equal time of training for each, then equal steps, as many as the slowest of the
networks reached.
"""

from dataclasses import dataclass, replace
from typing import Any

from giorom.reproduce.compare import over_seeds, paired, score_columns, with_ratio
from giorom.reproduce.methods import METHODS
from giorom.reproduce.study import Study, Trial
from giorom.reproduce.tuning import chosen_pair, tuned
from giorom.training.training_config import Budget

COLUMNS = [
    "system",
    "method",
    "rollout_mse",
    "paper",
    "ratio",
    "times_ours",
    "diverged",
    "lasted",
    "steps",
    "equal_steps_mse",
    "equal_steps",
    "parameters",
    "edges",
]
"""What is printed of each row."""

MORE = ("sinkhorn_divergence", "kinetic_energy_error", "relative_displacement_error")
"""Other scores of the samples, for CSV and JSON."""

TRIVIAL = {
    "static_mse": "holding still",
    "constant_velocity_mse": "constant velocity, stopped at the walls",
    "free_fall_mse": "free fall, stopped at the walls",
    "frozen_shape_mse": "oracle: true centroid, frozen shape",
}
"""Predictions without a model, by the name of their score."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Which time-steppers are compared on what."""

    systems: tuple[str, ...]
    """Physical systems."""

    methods: tuple[str, ...]
    """Names in ``METHODS``; ``default`` is compared with beside them."""

    paper: dict[str, dict[str, float]]
    """Numbers of the paper: system, then method."""

    seeds: list[int]
    """Seeds of the trainings at equal time; those at equal steps have the first."""


def compare_steppers(study: Study, comparison: Comparison) -> list[dict[str, Any]]:
    """Train and score all, and put the rows together; those of a system follow each other."""
    asked = {
        (system, method): [Trial(system=system, method=method, seed=s) for s in comparison.seeds]
        for system in comparison.systems
        for method in dict.fromkeys(("default", *comparison.methods))
    }
    chosen = tuned(study, [trial for trials in asked.values() for trial in trials])
    found = iter(chosen)
    trials = {pair: [next(found) for _ in listed] for pair, listed in asked.items()}
    study.train_all(chosen, full=False)
    equal = {
        system: _equal_steps(study, {m: t for (s, m), t in trials.items() if s == system})
        for system in comparison.systems
    }
    study.train_all([t for short in equal.values() for t in short.values()], full=False)
    rows: list[dict[str, Any]] = []
    for system in comparison.systems:
        mine = {method: t for (name, method), t in trials.items() if name == system}
        rows += _system_rows(study, system, mine, equal[system], comparison.paper.get(system, {}))
    return rows


def _equal_steps(study: Study, trials: dict[str, list[Trial]]) -> dict[str, Trial]:
    """A training of every network with the steps of the slowest, which needs no other one.

    A method that is trained by a search, not by steps of an optimiser, has none.
    """
    first = {method: found[0] for method, found in trials.items() if METHODS[method].is_network}
    steps = {method: study.training(trial)["steps"] for method, trial in first.items()}
    known = {method: count for method, count in steps.items() if count}
    if not known:
        return {}
    least = min(known.values())
    return {
        method: trial if known.get(method) == least else replace(trial, budget=Budget(steps=least))
        for method, trial in first.items()
    }


def _system_rows(
    study: Study,
    system: str,
    trials: dict[str, list[Trial]],
    equal: dict[str, Trial],
    paper: dict[str, float],
) -> list[dict[str, Any]]:
    """A row for every method, then those without a model."""
    scores = {m: [study.scores(t, full=False) for t in found] for m, found in trials.items()}
    ours = scores["default"]
    rows = []
    for method, found in scores.items():
        row = {"system": system, "method": METHODS[method].title, "name": method}
        row |= score_columns(found, {"rollout_mse": ("sparse", "rollout_mse")})
        for key in MORE:
            row |= over_seeds(key, [_of(score, key) for score in found])
        against = paired(found if method != "default" else [], ours)
        row |= {relative(key): value for key, value in against.items()}
        row |= _equal_columns(study, equal.get(method)) | chosen_pair(trials[method][0])
        row |= with_ratio(row["rollout_mse"], paper.get(method))
        rows.append(row)
    return rows + _trivial_rows(system, ours[0])


def ranks(rows: list[dict[str, Any]], *, column: str = "rollout_mse") -> list[str]:
    """A sentence for every system: the place of our default, and what is before it."""
    lines = []
    for system in dict.fromkeys(row["system"] for row in rows):
        mine = [r for r in rows if r["system"] == system and r["name"] in METHODS]
        known = sorted((r for r in mine if r[column] is not None), key=lambda r: r[column])
        names = [row["name"] for row in known]
        if "default" not in names:
            lines.append(f"{system}: every rollout of ours diverged.")
            continue
        place = names.index("default")
        before = ", ".join(f"`{name}`" for name in names[:place]) or "none"
        lines.append(
            f"{system}: ours is number {place + 1} of {len(mine)} at equal time of training; "
            f"before it: {before}."
        )
    return lines


def _of(score: dict[str, Any], key: str) -> float | None:
    return None if score["sparse"] is None else score["sparse"].get(key)


def relative(key: str) -> str:
    """Column of a paired comparison with ours: ``times_low`` becomes ``times_ours_low``."""
    first, *rest = key.split("_")
    return "_".join([first, "ours", *rest])


def _equal_columns(study: Study, trial: Trial | None) -> dict[str, Any]:
    """The score at equal steps."""
    if trial is None:
        return {"equal_steps": None, "equal_steps_mse": None, "equal_steps_diverged": None}
    score = study.scores(trial, full=False)
    return {
        "equal_steps": score["steps"],
        "equal_steps_mse": _of(score, "rollout_mse"),
        "equal_steps_diverged": f"{score['diverged']}/{score['trajectories']}",
    }


def _trivial_rows(system: str, score: dict[str, Any]) -> list[dict[str, Any]]:
    """Predictions without a model, on the same trajectories."""
    return [
        {
            "system": system,
            "method": title,
            "name": key.removesuffix("_mse"),
            "rollout_mse": _of(score, key),
            "parameters": 0,
        }
        for key, title in TRIVIAL.items()
    ]
