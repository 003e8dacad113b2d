"""Latent forecasters beside ours end to end: first frames in, all particles of all frames out.

A task of its own (T4 of docs/protocol.md). DINo and CORAL know no particles: they are compared with
the whole of ours, the samples stepped and all particles recovered, and with nothing less.
"""

import itertools
from typing import Any

import torch
from torch import Tensor

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.evaluate import decoded
from giorom.evaluation.metrics import relative_displacement_error, squared_error_per_frame
from giorom.evaluation.rollout import far_outside
from giorom.forecasters import (
    ForecasterConfig,
    ForecasterTrainingConfig,
    LatentForecaster,
    gather_motions,
    train_forecaster,
)
from giorom.reproduce.compare import over_seeds, paired
from giorom.reproduce.drawing import panels_of
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import roll
from giorom.reproduce.study import Study, Trial
from giorom.sampling import sample
from giorom.simulator import Simulator
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
    study.train_all([trial for trials in ours.values() for trial in trials], score=False)
    mine = [
        {"system": s, "seed": t.seed, "trial": study.folder(t).name}
        for s, trials in ours.items()
        for t in trials
    ]
    rolled: dict[str, list[dict[str, Any]]] = {}
    for key, scores in zip(mine, study.kept_all("end to end", mine, score_ours), strict=True):
        rolled.setdefault(key["system"], []).append(scores)
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
        rows += _system_rows(system, rolled[system], {n: found[system, n] for n in FORECASTERS})

    return Result(
        id="latent",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=[*_verdicts(rows), *NOTES],
        draw=panels_of(rows, label="MSE, all particles [m²]"),
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
    samples: Tensor,
    *,
    history: int,
) -> dict[str, Any]:
    """Errors of the forecast of one motion.

    Args:
        forecaster: A trained forecaster.
        trajectory: The motion.
        samples: Which particles are known at the given frames.
        history: Number of given frames.

    Returns:
        What ``score_motion`` gives, and ``floor_mse`` of true frames encoded and decoded.
    """
    position, body, held = trajectory.position, trajectory.position[0], trajectory.kinematic
    found = forecaster.forecast(
        body[samples],
        position[:history, samples],
        body,
        frames=len(position) - history,
        held=held,
    )
    frames = torch.linspace(history, len(position) - 1, 5).round().long().unique().tolist()
    codes = [forecaster.encode(body[samples], position[n - 1 : n + 1, samples]) for n in frames]
    floor = torch.where(held[:, None], body, forecaster.decode(torch.stack(codes), body))
    error = squared_error_per_frame(floor, position[frames])
    return score_motion(found, trajectory, history=history) | {"floor_mse": float(error.mean())}


def score_motion(found: Tensor, trajectory: Trajectory, *, history: int) -> dict[str, Any]:
    """Errors of all particles at all frames, counted as those of a rollout.

    Args:
        found: Positions at the frames after the given ones [m].
        trajectory: The true motion.
        history: Number of given frames.

    Returns:
        ``rollout_mse`` with the given frames, ``relative_error``, ``still_mse`` of a body that
        stays as it was given, and the frame of divergence, if any.
    """
    position, truth = trajectory.position, trajectory.position[history:]
    still = squared_error_per_frame(position[history - 1].expand_as(truth), truth)
    scores = {
        "diverged_at": _diverged(found, trajectory.bounds),
        "still_mse": float(still.sum()) / len(position),
    }
    if scores["diverged_at"] is not None:
        return scores | {"rollout_mse": None, "relative_error": None}
    error, start = squared_error_per_frame(found, truth), position[:1]
    relative = relative_displacement_error(torch.cat([start, found]), torch.cat([start, truth]))
    return scores | {"rollout_mse": float(error.sum()) / len(position), "relative_error": relative}


def score_ours(study: Study, key: dict[str, Any]) -> dict[str, Any]:
    """Roll out one of our models on the test motions and recover all particles.

    Less than ``Study.scores`` measures: no single steps, no distances between clouds.

    Args:
        study: Keeps the models.
        key: ``system`` and ``seed``.
    """
    trial = Trial(system=key["system"], method="default", seed=key["seed"])
    record, scores = study.training(trial), []
    run = study.run_of(trial)
    simulator = None if run is None else Simulator.from_pretrained(run)
    for trajectory in iterate_trajectories(study.dataset(key["system"]), "test"):
        if simulator is None:
            scores.append(
                {"rollout_mse": None, "relative_error": None, "still_mse": None, "diverged_at": 1}
            )
            continue
        history = simulator.config.features.history
        samples = simulator.sample(trajectory.position[0])
        truth, held = trajectory.position[history:], trajectory.kinematic
        rolled = roll(simulator, trajectory, samples=samples, frames=len(truth)).rollout
        decode = simulator.decoder(trajectory.position[0], held, samples=samples)
        found = decoded(decode, rolled.position, held, truth)
        lost = {"rollout_mse": None, "relative_error": None, "diverged_at": rolled.diverged_at}
        scores.append(score_motion(found, trajectory, history=history))
        scores[-1] |= {} if rolled.diverged_at is None else lost
    kept = {name: record[name] for name in ("steps", "seconds", "parameters")}
    return kept | {"per_trajectory": scores}


def _diverged(found: Tensor, bounds: Tensor) -> int | None:
    """First frame that is not finite or has a point further outside than the domain is wide."""
    lost = far_outside(found, bounds) | ~found.isfinite().all(dim=-1)
    lost = lost.any(dim=1).nonzero()
    return int(lost[0]) + 1 if len(lost) else None


def _system_rows(
    system: str, ours: list[dict[str, Any]], found: dict[str, list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Ours, the forecasters, holding still, and what cannot be compared."""
    rows = [{"system": system, "name": "default", "method": "ours, end to end"} | _columns(ours)]
    for name, scores in found.items():
        difference = paired(scores, ours, key="rollout_mse")
        rows.append({"system": system, "name": name, "method": FORECASTERS[name][0]})
        rows[-1] |= _columns(scores) | difference | {"times_ours": _interval(difference)}
    still = [_mean(scores[0], "still_mse") for scores in found.values()]
    rows.append({"system": system, "name": "still", "method": "holding still"})
    rows[-1] |= over_seeds("rollout_mse", still[:1])
    rows.append({"system": system, "name": "colora", "method": "CoLoRA: not applicable"})
    return rows


def _columns(scores: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over trainings, and what each row has to say beside."""
    row: dict[str, Any] = {}
    for column in ("rollout_mse", "relative_error", "floor_mse"):
        row |= over_seeds(column, [_mean(score, column) for score in scores])
    motions = [motion for score in scores for motion in score["per_trajectory"]]
    lost = sum(motion["diverged_at"] is not None for motion in motions)
    return row | {
        "diverged": f"{lost}/{len(motions)}",
        "steps": _average([score["steps"] for score in scores]),
        "seconds": _average([score["seconds"] for score in scores]),
        "parameters": next((s["parameters"] for s in scores if s["parameters"]), None),
    }


def _average(values: list[Any]) -> float | None:
    """Mean of the known ones."""
    return over_seeds("", [None if value is None else float(value) for value in values])[""]


def _mean(score: dict[str, Any], column: str) -> float | None:
    """Mean over the test motions that did not diverge."""
    return _average([motion.get(column) for motion in score["per_trajectory"]])


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
