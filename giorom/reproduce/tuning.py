"""Learning rate and noise of every network, chosen by the same small budget.

For each system and method the pairs of the scale are tried in short trainings of one seed; the
validation trajectories decide, the test trajectories are never looked at.
"""

import math
from dataclasses import replace
from typing import Any

from giorom.config import merged
from giorom.reproduce.methods import METHODS
from giorom.reproduce.study import Study, Trial


def tuned(study: Study, trials: list[Trial]) -> list[Trial]:
    """The trials with the learning rate and noise that are best for their system and method.

    Methods that are not tuned (those with a training of their own) stay as they are; values that a
    trial sets itself stay too.

    Args:
        study: Keeps the short trainings.
        trials: What is to be trained.
    """
    pairs = dict.fromkeys((t.system, t.method) for t in trials if METHODS[t.method].is_tuned)
    shorts = {pair: _shorts(study, *pair) for pair in pairs}
    if len(study.scale.candidates) > 1:
        study.train_all([short for found in shorts.values() for short in found], score=False)
    best = {pair: _best(study, found) for pair, found in shorts.items()}
    return [
        replace(trial, changes=merged(best.get((trial.system, trial.method), {}), trial.changes))
        for trial in trials
    ]


def chosen_pair(trial: Trial) -> dict[str, float | None]:
    """Learning rate and noise of a tuned trial, for its row in a table."""
    values = trial.changes.get("training", {})
    return {name: values.get(name) for name in ("learning_rate", "noise_std")}


def _shorts(study: Study, system: str, method: str) -> list[Trial]:
    """A short training for every candidate."""
    return [
        Trial(
            system=system,
            method=method,
            seed=study.seed,
            changes={"training": {"learning_rate": rate, "noise_std": noise}},
            budget=study.scale.tuning_budget,
        )
        for rate, noise in study.scale.candidates
    ]


def _best(study: Study, shorts: list[Trial]) -> dict[str, Any]:
    """Values of the candidate with the smallest validation error; the first of equal ones."""
    if len(shorts) == 1:
        return shorts[0].changes

    def error(short: Trial) -> float:
        found = study.training(short)["best_rollout_mse"]
        return math.inf if found is None else found

    return min(shorts, key=error).changes
