"""The chart of error against time: ours, every peer and the solver itself, on one system.

Full-order error of a rollout, time of a frame, and what data and training have cost: whatever comes
out is printed, with the number of rollouts after which a model has paid for itself against the
solver at the same error.
"""

import math
from functools import partial
from typing import Any

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.tradeoff import Curve, on_front, pays_back_after, time_at_error
from giorom.reproduce.methods import METHODS
from giorom.reproduce.pareto_picture import draw_pareto
from giorom.reproduce.pareto_runs import (
    full_order_seconds,
    noise_floor,
    run_model,
    run_solver,
    truths,
    without_model,
)
from giorom.reproduce.pareto_words import notes_of
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study, Trial
from giorom.reproduce.tuning import tuned
from giorom.reproduce.workers import one_thread
from giorom.simulator import Simulator

COLUMNS = [
    "method",
    "points",
    "grid_cells",
    "substeps",
    "full_rollout_mse",
    "seconds_per_frame",
    "on_front",
    "diverged",
    "solver_seconds_per_frame",
    "upfront_seconds",
    "seconds_of_100_rollouts",
    "pays_back_after",
]
"""What is printed of each row."""

SHARES = (0.25, 0.5, 1.0, 2.0)
"""Samples of ours over those it was trained with."""

COARSENINGS = (1.0, 1.5, 2.0, 3.0, 4.0)
"""Cells of the full-order grid along a cell of the solver's."""

STEPS = ("rules", "largest")
"""Time steps of the solver: the longest that its rules allow, the longest that are stable."""

SAME_SHARE = 1.25
"""Two numbers of material points that differ by less are not both run."""

TRIVIAL = {
    "static": "holding still",
    "constant_velocity": "constant velocity, stopped at the walls",
    "free_fall": "free fall, stopped at the walls",
}
"""Predictions without a model."""


def run_pareto(study: Study, system: str, methods: list[str]) -> Result:
    """Train what is missing, run everything and put the chart together.

    Args:
        study: Scale, folder and device.
        system: Physical system.
        methods: Names in ``METHODS`` beside ``default``.

    Raises:
        RuntimeError: If every validation rollout of ours diverged, so that there is no field.
    """
    trials = _trained(study, system, methods)
    if study.run_of(trials["default"]) is None:
        raise RuntimeError(
            f"every validation rollout of the default on {system} diverged: there is no field to "
            f"recover the particles with. Choose a larger --scale or another --seed."
        )
    with one_thread():
        base = _base(study, system, trials["default"])
        solver = _solver_rows(study, system, trials["default"], base)
        models = _model_rows(study, system, trials)
    cost = _Cost(study, system, base["full_order_seconds"])
    curve = _curve(solver, base)
    for row in models:
        spent = cost.of(trials[row["name"]])
        row.update(spent | _against(row, curve, spent))
    rows = [*models, *solver, _full_order_row(base), *_trivial_rows(base)]
    _mark_front(rows)
    for row in rows:
        row.update(cost.of_rollouts(row))

    return Result(
        id=f"pareto-{system}",
        title=f"Error against time on {system}: models and the solver",
        columns=COLUMNS,
        rows=rows,
        notes=notes_of(rows, floor=base["noise_floor"], rollout_frames=cost.frames),
        draw=partial(draw_pareto, rows=rows, floor=base["noise_floor"], frames=cost.frames),
    )


def _trained(study: Study, system: str, methods: list[str]) -> dict[str, Trial]:
    """A training of the first seed for every method, with tuned values."""
    names = list(dict.fromkeys(("default", *methods)))
    trials = tuned(study, [Trial(system=system, method=m, seed=study.seed) for m in names])
    study.train_all(trials, score=False)
    return dict(zip(names, trials, strict=True))


def _key(study: Study, system: str, **more: Any) -> dict[str, Any]:
    return {"data": study.dataset(system).name, "device": study.device, **more}


def _base(study: Study, system: str, trial: Trial) -> dict[str, Any]:
    """What every row is compared with: the full-order solver and what needs no model."""
    history = study.experiment(system, trial.method).features.history

    def make() -> dict[str, Any]:
        tests = truths(study, system, "test")
        particles = [len(test.scene.position) for test in tests]
        return {
            "points": round(sum(particles) / len(particles)),
            "grid_cells": tests[0].solver.grid_cells,
            "substeps": tests[0].solver.substeps,
            "dimension": tests[0].scene.position.shape[1],
            "full_order_seconds": full_order_seconds(tests, device=study.device),
            "noise_floor": noise_floor(tests, device=study.device),
            "trivial": without_model(tests, history=history),
        }

    study.report(f"{system}: the solver itself", 0, 0)
    return study.kept("pareto-base", _key(study, system, history=history), make)


def _model_rows(study: Study, system: str, trials: dict[str, Trial]) -> list[dict[str, Any]]:
    """A row for every method, and for ours with every number of samples."""
    wanted = [("default", share) for share in SHARES]
    wanted += [(name, 1.0) for name in trials if name != "default"]
    rows = []
    for done, (name, share) in enumerate(wanted):
        study.report(f"{system}: {name}", done, len(wanted))
        key = _key(study, system, trial=study.folder(trials[name]).name, share=share)
        key["field"] = study.folder(trials["default"]).name
        found = study.kept(
            "pareto-model", key, partial(_run_trained, study, trials, name=name, share=share)
        )
        title = METHODS[name].title
        if name == "default" and share != 1.0:
            title = f"{title}, {share:g} x the samples"
        rows.append({"kind": "model", "name": name, "method": title, "share": share, **found})
    return rows


def _run_trained(
    study: Study, trials: dict[str, Trial], *, name: str, share: float
) -> dict[str, Any]:
    """Run a trained model on the test split; all diverged, where there is none."""
    system = trials[name].system
    tests = [
        trajectory.to(study.device)
        for trajectory in iterate_trajectories(study.dataset(system), "test")
    ]
    run = study.run_of(trials[name])
    if run is None:
        return {
            "full_rollout_mse": None,
            "seconds_per_frame": None,
            "diverged": len(tests),
            "trajectories": len(tests),
        }
    models = [
        Simulator.from_pretrained(path).to(study.device)
        for path in (run, study.run_of(trials["default"]))
        if path is not None
    ]
    return run_model(models[0], models[1], tests, share=share)


def _solver_rows(
    study: Study, system: str, trial: Trial, base: dict[str, Any]
) -> list[dict[str, Any]]:
    """The solver on every grid, with both steps, as many points as ours and as fill the grid."""
    experiment = study.experiment(system)
    ours = experiment.sampling.sample_count(base["points"]) / base["points"]
    wanted = [
        {"coarsening": coarsening, "points": points, "steps": steps}
        for coarsening in COARSENINGS
        for points in point_shares(coarsening, dimension=base["dimension"], ours=ours)
        for steps in STEPS
        if coarsening > 1.0 or steps == "largest"
    ]
    rows = []
    for done, case in enumerate(wanted):
        study.report(f"{system}: solver n/{case['coarsening']:g}", done, len(wanted))
        key = _key(study, system, field=study.folder(trial).name, **case)
        found = study.kept("pareto-solver", key, partial(_run_case, study, trial, base, case))
        rows.append({"kind": "solver", "name": "solver", "method": _name_of(case), **case, **found})
    return _without_copies(rows)


def point_shares(coarsening: float, *, dimension: int, ours: float) -> list[float]:
    """Shares of the particles that are material points of a coarse run.

    As many to a cell as in the full-order run, and as many as ours has samples, if that differs.

    Args:
        coarsening: Cells of the full-order grid along one cell.
        dimension: 2 or 3.
        ours: Samples over particles.
    """
    filling = coarsening**-dimension
    if coarsening == 1.0 or max(ours / filling, filling / ours) < SAME_SHARE:
        return [filling]
    return [filling, ours]


def _run_case(
    study: Study, trial: Trial, base: dict[str, Any], case: dict[str, Any]
) -> dict[str, Any]:
    field = Simulator.from_pretrained(study.folder(trial) / "run").to(study.device)
    return run_solver(
        field,
        truths(study, trial.system, "test"),
        truths(study, trial.system, "valid")[0],
        floor=base["noise_floor"] or 0.0,
        device=study.device,
        **case,
    )


def _name_of(case: dict[str, Any]) -> str:
    grid = "n" if case["coarsening"] == 1.0 else f"n/{case['coarsening']:g}"
    steps = {"rules": "steps by its rules", "largest": "largest stable steps"}[case["steps"]]
    return f"solver on {grid}, {steps}"


def _without_copies(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of which none repeats another: where the largest stable step is that of the rules."""
    kept: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        place = (row["coarsening"], row["points"], row.get("substeps"))
        if place in kept:
            kept[place]["method"] += ", the largest stable"
        else:
            kept[place] = row
    return list(kept.values())


def _full_order_row(base: dict[str, Any]) -> dict[str, Any]:
    """The full-order solver; it is the truth, and so has no error but the noise floor."""
    return {
        "kind": "truth",
        "name": "full-order",
        "method": "the full-order solver; its error is the noise floor",
        "points": base["points"],
        "grid_cells": base["grid_cells"],
        "substeps": base["substeps"],
        "full_rollout_mse": base["noise_floor"],
        "seconds_per_frame": base["full_order_seconds"],
        "diverged": 0,
    }


def _trivial_rows(base: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "kind": "trivial",
            "name": name,
            "method": title,
            "full_rollout_mse": base["trivial"][name],
        }
        for name, title in TRIVIAL.items()
    ]


def _curve(solver: list[dict[str, Any]], base: dict[str, Any]) -> Curve:
    """Error and time of the solver: coarse runs that all held, and the full-order one."""
    known = [
        (row["full_rollout_mse"], row["seconds_per_frame"])
        for row in solver
        if row["full_rollout_mse"] is not None and row.get("diverged") == 0
    ]
    return [*known, (base["noise_floor"] or 0.0, base["full_order_seconds"])]


def _against(row: dict[str, Any], curve: Curve, cost: dict[str, Any]) -> dict[str, Any]:
    """What the solver takes for the error of a model, and when the model has paid for itself."""
    error, seconds = row["full_rollout_mse"], row["seconds_per_frame"]
    if error is None or seconds is None:
        return {"solver_seconds_per_frame": None, "pays_back_after": None}
    reference = time_at_error(curve, error)
    count = pays_back_after(
        upfront=cost["upfront_seconds"],
        reference=reference * cost["rollout_frames"],
        seconds=seconds * cost["rollout_frames"],
    )
    return {
        "solver_seconds_per_frame": reference,
        "pays_back_after": count if math.isfinite(count) else "never",
    }


def _mark_front(rows: list[dict[str, Any]]) -> None:
    """Say of every row that can be compared whether another beats it."""
    known = [
        row
        for row in rows
        if row["full_rollout_mse"] is not None
        and row.get("seconds_per_frame") is not None
        and row.get("diverged") == 0
    ]
    points = [(row["full_rollout_mse"], row["seconds_per_frame"]) for row in known]
    for row, best in zip(known, on_front(points), strict=True):
        row["on_front"] = best


class _Cost:
    """What data, training and tuning of the models of a system have taken."""

    def __init__(self, study: Study, system: str, full_order_seconds: float) -> None:
        self._study = study
        self.frames = study.experiment(system).solver.frames - 1
        count = study.scale.systems[system].trajectories
        self._data = count * self.frames * full_order_seconds

    def of(self, trial: Trial) -> dict[str, Any]:
        """Seconds of one training and of what it needs."""
        training = self._study.training(trial)["seconds"] or 0.0
        budget = self._study.scale.tuning_budget
        tuning = 0.0
        if METHODS[trial.method].is_tuned and len(self._study.scale.candidates) > 1:
            tuning = len(self._study.scale.candidates) * 60.0 * (budget.minutes or 0.0)
        return {
            "data_seconds": self._data,
            "training_seconds": training,
            "tuning_seconds": tuning,
            "upfront_seconds": self._data + training + tuning,
            "rollout_frames": self.frames,
        }

    def of_rollouts(self, row: dict[str, Any], *, count: int = 100) -> dict[str, Any]:
        """Seconds of a hundred rollouts, with what had to be paid before."""
        seconds = row.get("seconds_per_frame")
        if seconds is None:
            return {"seconds_of_100_rollouts": None}
        upfront = row.get("upfront_seconds", 0.0)
        return {"seconds_of_100_rollouts": upfront + count * self.frames * seconds}
