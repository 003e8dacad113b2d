"""Latent forecasters beside ours end to end: first frames in, all particles of all frames out.

A task of its own (T4 of docs/protocol.md). DINo and CORAL know no particles: they are compared with
the whole of ours, the samples stepped and all particles recovered, and with nothing less.
"""

import itertools
from typing import Any

import torch

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.metrics import relative_displacement_error, squared_error_per_frame
from giorom.forecasters import (
    ForecasterConfig,
    ForecasterTrainingConfig,
    LatentForecaster,
    gather_motions,
    train_forecaster,
)
from giorom.reproduce.compare import over_seeds, paired
from giorom.reproduce.drawing import draw_systems
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study, Trial
from giorom.sampling import sample
from giorom.state import Trajectory

TITLE = "Latent forecasters from the first frames, beside ours end to end"

SYSTEMS = ("elastic3d", "plasticine3d", "sand3d", "water3d", "water2d")
"""Physical systems."""

TINY_SYSTEMS = SYSTEMS[:2]
"""The same where it shall only be shown that all works."""

FORECASTERS = {
    "dino": ("DINo-like: auto-decoded filter network, latent equation", "dino", False),
    "coral": ("CORAL-like: modulated sines, codes by gradient steps", "coral", False),
    "dino-published": ("DINo-like, published size", "dino", True),
    "coral-published": ("CORAL-like, published size", "coral", True),
}
"""By name: title, kind, whether it has the published size."""

BODIES, POINTS, FRAMES = 32, 512, 24
"""Most training motions, and how many points and frames of each are used."""

COLUMNS = [
    "system",
    "method",
    "rollout_mse",
    "relative_error",
    "times_ours",
    "floor_mse",
    "diverged",
    "steps",
    "seconds",
    "parameters",
]


def run(study: Study) -> Result:
    """Train and score the forecasters and ours on every system."""
    systems = TINY_SYSTEMS if study.scale.name == "tiny" else SYSTEMS
    ours = {s: [Trial(system=s, method="default", seed=n) for n in study.seeds] for s in systems}
    study.train_all([trial for trials in ours.values() for trial in trials])
    keys = [
        {
            "system": system,
            "data": study.dataset(system).name,
            "name": name,
            "seed": seed,
            "budget": vars(study.scale.budget),
        }
        for system in systems
        for name, (_, _, published) in FORECASTERS.items()
        for seed in (study.seeds[:1] if published else study.seeds)
    ]
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for key, scores in zip(keys, study.kept_all("forecaster", keys, score_forecaster), strict=True):
        found.setdefault((key["system"], key["name"]), []).append(scores)
    rows: list[dict[str, Any]] = []
    for system in systems:
        mine = [study.scores(trial) for trial in ours[system]]
        rows += _system_rows(system, mine, {n: found[system, n] for n in FORECASTERS})

    def draw(figure: Any) -> None:
        draw_systems(figure, rows, value="rollout_mse", label="MSE, all particles [m²]")

    return Result(
        id="latent",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=[*_verdicts(rows), *NOTES],
        draw=draw,
    )


def score_forecaster(study: Study, key: dict[str, Any]) -> dict[str, Any]:
    """Train one forecaster and forecast the test motions.

    Args:
        study: Scale and data.
        key: ``system``, ``name`` in ``FORECASTERS``, ``seed``.
    """
    experiment, folder = study.experiment(key["system"]), study.dataset(key["system"])
    _, kind, published = FORECASTERS[key["name"]]
    config = ForecasterConfig.published(kind) if published else ForecasterConfig(kind=kind)
    torch.manual_seed(key["seed"])
    forecaster = LatentForecaster(config, dimension=experiment.scene.dimension)
    history = experiment.features.history
    motions = gather_motions(
        list(itertools.islice(iterate_trajectories(folder, "train"), BODIES)),
        first=history - 1,
        points=POINTS,
        frames=FRAMES,
        seed=key["seed"],
    )
    result = train_forecaster(
        forecaster,
        motions,
        ForecasterTrainingConfig(),
        seed=key["seed"],
        steps=study.scale.budget.steps,
        minutes=study.scale.budget.minutes,
    )
    forecaster.requires_grad_(False)
    scores = []
    for trajectory in iterate_trajectories(folder, "test"):
        samples = sample(trajectory.position[0], experiment.sampling)
        scores.append(score_forecast(forecaster, trajectory, samples, history=history))
    parameters = sum(p.numel() for p in forecaster.parameters())
    return result | {"parameters": parameters, "per_trajectory": scores}


def score_forecast(
    forecaster: LatentForecaster,
    trajectory: Trajectory,
    samples: torch.Tensor,
    *,
    history: int,
) -> dict[str, Any]:
    """Errors of the forecast of one motion, counted as those of a rollout.

    Args:
        forecaster: A trained forecaster.
        trajectory: The motion.
        samples: Which particles are known at the given frames.
        history: Number of given frames.

    Returns:
        ``rollout_mse`` with the given frames, ``relative_error``, ``floor_mse`` of the true frames
        encoded and decoded, and the frame of divergence, if any.
    """
    position, body = trajectory.position, trajectory.position[0]
    truth, held = position[history:], trajectory.kinematic
    found = forecaster.forecast(
        body[samples], position[:history, samples], body, frames=len(truth), held=held
    )
    frames = torch.linspace(history, len(position) - 1, 5).round().long().unique().tolist()
    codes = [forecaster.encode(body[samples], position[n - 1 : n + 1, samples]) for n in frames]
    floor = torch.where(held[:, None], body, forecaster.decode(torch.stack(codes), body))
    scores = {
        "floor_mse": float(squared_error_per_frame(floor, position[frames]).mean()),
        "diverged_at": _diverged(found, trajectory.bounds),
    }
    if scores["diverged_at"] is not None:
        return scores | {"rollout_mse": None, "relative_error": None}
    error = squared_error_per_frame(found, truth)
    start = position[:1]
    relative = relative_displacement_error(torch.cat([start, found]), torch.cat([start, truth]))
    return scores | {
        "rollout_mse": float(error.sum()) / len(position),
        "relative_error": relative,
    }


def _diverged(found: torch.Tensor, bounds: torch.Tensor) -> int | None:
    """First frame that is not finite or has a point further outside than the domain is wide."""
    extent = bounds[:, 1] - bounds[:, 0]
    inside = (found >= bounds[:, 0] - extent) & (found <= bounds[:, 1] + extent)
    lost = (~inside.flatten(1).all(dim=1)).nonzero()
    return int(lost[0]) + 1 if len(lost) else None


def _system_rows(
    system: str, ours: list[dict[str, Any]], found: dict[str, list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Ours, the forecasters, holding still, and what cannot be compared."""
    rows = [_our_row(system, ours)]
    for name, scores in found.items():
        rows.append({"system": system, "name": name, "method": FORECASTERS[name][0]})
        sound = [s for score in scores for s in score["per_trajectory"]]
        for column in ("rollout_mse", "relative_error", "floor_mse"):
            rows[-1] |= over_seeds(column, [_mean(score, column) for score in scores])
        lost = sum(s["diverged_at"] is not None for s in sound)
        rows[-1] |= {
            "diverged": f"{lost}/{len(sound)}",
            "steps": over_seeds("steps", [float(s["steps"]) for s in scores])["steps"],
            "seconds": over_seeds("seconds", [s["seconds"] for s in scores])["seconds"],
            "parameters": scores[0]["parameters"],
        }
        difference = paired(scores, ours, key="rollout_mse")
        rows[-1] |= difference | {"times_ours": _interval(difference)}
    still = [s["full"]["static_mse"] for s in ours if s["full"] is not None]
    rows.append({"system": system, "name": "still", "method": "holding still"})
    rows[-1] |= over_seeds("rollout_mse", still)
    rows.append({"system": system, "name": "colora", "method": "CoLoRA: not applicable"})
    return rows


def _our_row(system: str, ours: list[dict[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {"system": system, "name": "default", "method": "ours, end to end"}
    names = {"rollout_mse": "rollout_mse", "relative_error": "relative_displacement_error"}
    for column, key in names.items():
        values = [None if s["full"] is None else s["full"][key] for s in ours]
        row |= over_seeds(column, values)
    lost, count = sum(s["diverged"] for s in ours), sum(s["trajectories"] for s in ours)
    return row | {
        "diverged": f"{lost}/{count}",
        "steps": _average([s["steps"] for s in ours]),
        "seconds": _average([s["seconds"] for s in ours]),
        "parameters": next((s["parameters"] for s in ours if s["parameters"]), None),
    }


def _average(values: list[Any]) -> float | None:
    """Mean of the known ones."""
    return over_seeds("", [None if value is None else float(value) for value in values])[""]


def _mean(score: dict[str, Any], column: str) -> float | None:
    """Mean over the test motions that did not diverge."""
    return _average([s[column] for s in score["per_trajectory"]])


def _interval(difference: dict[str, Any]) -> str | None:
    """The ratio with its interval."""
    if difference["times"] is None:
        return None
    low, high = difference["times_low"], difference["times_high"]
    return f"{difference['times']:.3g} ({low:.3g} to {high:.3g})"


def _verdicts(rows: list[dict[str, Any]]) -> list[str]:
    """Who is best on each system."""
    notes = []
    for system in dict.fromkeys(row["system"] for row in rows):
        known = [r for r in rows if r["system"] == system and r.get("rollout_mse") is not None]
        if known:
            best = min(known, key=lambda row: row["rollout_mse"])
            notes.append(f"{system}: least error by {best['method']} ({best['rollout_mse']:.2g}).")
    return notes


NOTES = [
    "All start from the same given frames of the same samples and are scored on all particles at "
    "all frames of the same test motions. `rollout_mse` [m²] counts the given frames, as in the "
    "paper; in brackets the range over seeds. The published sizes were trained with one seed.",
    "`times ours`: error over that of ours, geometric mean over test motions, with the 95 % "
    "interval of a bootstrap over them. Motions that diverged are in no mean.",
    "`floor mse`: true frames encoded from the samples and decoded at all particles; what a "
    "perfect latent equation would leave.",
    "Training: the time of a time-stepper's training, half for the coded field and half for the "
    "equation of the codes. A code describes displacement and velocity of a frame, so that one "
    "frame determines the next; the equation also sees where the undeformed body is and how large. "
    "Frequencies are lower than published, which are for images.",
    "CoLoRA maps a physical parameter and the time to the field. No physical parameter is varied "
    "in these data, and an initial velocity and a shape are not one: there is nothing to compare.",
]
"""How the columns are counted."""
