"""The report: ``docs/results/accuracy.md``, from the ``metrics.json`` of every model.

No number and no word of praise is written here by hand. What is not met is listed with its reason
from ``notes.json``, and with the lack of one where none has been written down.
"""

import json
from pathlib import Path
from typing import Any

from benchmarks.accuracy.requirements import Verdict, verdicts
from benchmarks.accuracy.sections import (
    Models,
    against_paper,
    against_paper_preset,
    against_trivial,
    discretisation,
    distributions,
    floors,
    number,
    stability,
    swings,
    table,
)

NOTES = Path(__file__).parent / "notes.json"
"""Reasons of what is not met: model, then requirement, then text."""

MOST_BYTES_ALL = 40_000_000
"""Largest size of all models together."""

HEAD = """# Accuracy of the pretrained models

Written by `python -m benchmarks.accuracy` from the `metrics.json` of each model; no number is
typed by hand. Every model is scored on {trajectories} scenes that were made for it by the
functions of `giorom simulate` with a seed that no training data has, and
`giorom evaluate --pretrained NAME` gives the same score again. Errors are mean squared distances
in m^2, summed over axes; a rollout's is the mean over all its frames, those it is given (without
error) included, as the paper counts. "±" is the standard deviation over trajectories. All
baselines stop at the walls and start from the frames that the model is given. Rollouts that
diverge are left out of the means and are counted; a requirement on a mean with any left out is
not met.

The systems have the paper's names and laws, but their bodies, sizes and mostly their numbers of
frames are ours: the paper's numbers are a scale and not a like-for-like comparison. Its two tables
do not agree with each other on every system.

{machines}
"""


def write_report(pretrained: Path, out: Path, noise_floors: dict[str, Any]) -> list[str]:
    """Write the report of all models that have been scored.

    Args:
        pretrained: Folder of the models.
        out: File to write.
        noise_floors: By preset, as ``measure_noise_floor`` gives them.

    Returns:
        What is not met, a line each.
    """
    models, judged = {}, {}
    for directory in sorted(path.parent for path in pretrained.glob("*/metrics.json")):
        metrics = json.loads((directory / "metrics.json").read_text(encoding="utf-8"))
        config = json.loads((directory / "config.json").read_text(encoding="utf-8"))
        size = (directory / "model.safetensors").stat().st_size
        models[directory.name] = metrics | {"bytes": size}
        judged[directory.name] = verdicts(metrics, scene=config["scene"], size=size)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page(models, judged, noise_floors, notes=_notes()), encoding="utf-8")
    return [
        f"{name}: {verdict.requirement}: {verdict.word}"
        for name, rows in judged.items()
        for verdict in rows
        if not verdict.met
    ]


def page(
    models: Models,
    judged: dict[str, list[Verdict]],
    noise_floors: dict[str, Any],
    *,
    notes: dict[str, dict[str, str]],
) -> str:
    """The report as Markdown."""
    trajectories = sorted({metrics["trajectories"] for metrics in models.values()})
    counts = " or ".join(str(count) for count in trajectories)
    parts = [
        HEAD.format(trajectories=counts, machines=_machines(models)),
        _required(judged, models),
        against_paper(models),
        against_paper_preset(models),
        against_trivial(models),
        distributions(models),
        swings(models),
        stability(models),
        discretisation(models),
        floors(noise_floors),
        _shortfalls(judged, notes),
        _commands(models),
    ]
    return "\n".join(part for part in parts if part)


def _required(judged: dict[str, list[Verdict]], models: Models) -> str:
    rows = [
        [name, v.requirement, number(v.value), v.asked, _outcome(v)]
        for name, found in judged.items()
        for v in found
    ]
    total = sum(metrics["bytes"] for metrics in models.values())
    size = Verdict(requirement="bytes of all weights", value=float(total), bound=MOST_BYTES_ALL)
    rows.append(["all", size.requirement, number(size.value), size.asked, _outcome(size)])
    met = sum(v.met for found in judged.values() for v in found) + size.met
    text = (
        f"## Requirements\n\n{met} of {len(rows)} are met. Ratios are the smaller of those on the "
        f"samples and on all particles.\n\n"
    )
    return text + table(["model", "requirement", "found", "bound", "outcome"], rows)


def _outcome(verdict: Verdict) -> str:
    """Met, or in bold what else, why a value cannot count, and what has to be known."""
    word = verdict.word if verdict.met else f"**{verdict.word}**"
    more = "; ".join(text for text in (verdict.unsound, verdict.remark) if text)
    return f"{word} ({more})" if more else word


def _shortfalls(judged: dict[str, list[Verdict]], notes: dict[str, dict[str, str]]) -> str:
    lines = []
    for name, found in judged.items():
        for verdict in found:
            if verdict.met:
                continue
            reason = notes.get(name, {}).get(verdict.requirement, "no reason written down yet")
            lines.append(
                f"* **{name}**, {verdict.requirement}: {verdict.word}; found "
                f"{number(verdict.value)}, asked {verdict.asked}. "
                f"{reason[:1].upper()}{reason[1:].rstrip('.')}."
            )
    return "\n".join(["## What falls short", "", *lines, ""]) if lines else ""


def _commands(models: Models) -> str:
    lines = ["## Commands", ""]
    for name, metrics in models.items():
        for command in [*metrics.get("commands", []), f"giorom evaluate --pretrained {name}"]:
            lines.append(f"    {command}")
        lines.append("")
    return "\n".join([*lines, "    python -m benchmarks.accuracy", ""])


def _machines(models: Models) -> str:
    """Machine and versions behind the scores, a line for each that differs."""
    lines: dict[str, list[str]] = {}
    for name, metrics in models.items():
        machine = metrics.get("machine")
        if machine is None:
            lines.setdefault("Machine not recorded", []).append(name)
            continue
        versions = ", ".join(f"{k} {v}" for k, v in machine["versions"].items() if v)
        seed = metrics.get("held_out", {}).get("seed")
        text = f"{machine['processor']}, {machine['cores']} cores; {versions}; data seed {seed}"
        lines.setdefault(text, []).append(name)
    return "\n".join(f"{text} ({', '.join(names)})." for text, names in lines.items())


def _notes() -> dict[str, dict[str, str]]:
    return json.loads(NOTES.read_text(encoding="utf-8")) if NOTES.is_file() else {}
