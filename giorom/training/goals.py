"""When a run reached stated rollout errors: how two recipes are compared."""

import json
from pathlib import Path
from typing import Any


def time_to(
    history: list[dict[str, Any]], goals: list[float], *, unit: str, earlier: float = 0.0
) -> dict[str, float | None]:
    """Seconds of training until a validation rollout was at least as good as each goal.

    Args:
        history: Validations in order: ``seconds``, ``rollout_mse``, ``static_mse``; None stands for
            a rollout that diverged.
        goals: Rollout errors, as ``unit`` says.
        unit: ``static``: in units of the error of holding still; ``m^2``: as they are.
        earlier: Seconds before those of the history that count as training.

    Returns:
        Seconds for each goal, None where it was not reached; the first validation that reached it
        counts. Keys are the goal with its unit.
    """
    result: dict[str, float | None] = {}
    for goal in goals:
        reached = None
        for entry in history:
            bound = goal * entry["static_mse"] if unit == "static" else goal
            if entry["rollout_mse"] is not None and entry["rollout_mse"] <= bound:
                reached = earlier + entry["seconds"]
                break
        result[f"{goal:g} {'x static' if unit == 'static' else unit}"] = reached
    return result


def seconds_of_stage(log: Path, stage: str) -> float:
    """Seconds that the last entry of a stage in a log states; none without such an entry."""
    if not log.is_file():
        return 0.0
    entries = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return next((e["seconds"] for e in reversed(entries) if e["stage"] == stage), 0.0)
