"""Table 11: the radius of the graph at inference as a knob of viscosity.

A network that averages over neighbours smooths velocities, and over more neighbours more. The
paper calls the outcome viscosity and measures it by how near particles get and how fast they move.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.evaluation.mechanics import smallest_distance
from giorom.evaluation.stage_speed import connect_at
from giorom.reproduce.compare import over_seeds
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import (
    Case,
    first_test_trajectory,
    joined_components,
    roll,
    train_tuned,
    trained_model,
)
from giorom.reproduce.study import Study, Trial

TITLE = "Table 11: radius at inference against viscosity, water in two dimensions"

PAPER: dict[float, tuple[float, float]] = {
    0.015: (6.06e-5, 1.7e-2),
    0.020: (6.32e-5, 8.1e-3),
    0.025: (6.40e-5, 7.6e-3),
    0.030: (6.42e-5, 6.6e-3),
    0.035: (6.51e-5, 5.7e-3),
    0.040: (6.58e-5, 5.0e-3),
    0.045: (6.71e-5, 4.6e-3),
    0.050: (7.04e-5, 4.2e-3),
}
"""Mean smallest distance and mean largest speed by radius [m] (arXiv:2407.03925v2, Table 11)."""

SYSTEM, METHOD, FRAMES = "water2d", "io-not-io", 200
"""What is rolled out, and for how long, as in the paper."""

MEASURES = ("spacing", "speed", "official_spacing", "official_speed")
"""Names of the four numbers."""

COLUMNS = [
    "radius",
    "features_in",
    "degree",
    "components",
    "spacing",
    "paper_spacing",
    "ratio_spacing",
    "squared_spacing",
    "speed",
    "paper_speed",
    "ratio_speed",
    "official_spacing",
    "official_speed",
    "rollout_mse",
    "diverged",
]


def viscosity(position: Float[Tensor, "t q d"]) -> dict[str, float]:
    """The caption's two measures of a motion.

    Args:
        position: Positions at consecutive frames [m].

    Returns:
        ``spacing``: mean over frames of the smallest distance of two particles [m]; ``speed``:
        mean over steps of the largest distance a particle moves in a frame [m].
    """
    moved = position.diff(dim=0).norm(dim=2)
    return {
        "spacing": sum(map(smallest_distance, position)) / len(position),
        "speed": float(moved.amax(dim=1).mean()),
    }


def official_viscosity(position: Float[Tensor, "t q d"]) -> dict[str, float]:
    """The same by the rule of the official helpers.

    Particles at one place are no pair, and the speed is the largest component of any velocity at
    any frame, with its sign: that of a body at rest that is moved to the left is zero.

    Args:
        position: Positions at consecutive frames [m].

    Returns:
        ``official_spacing`` and ``official_speed`` [m].
    """
    places = [frame.unique(dim=0) for frame in position]
    return {
        "official_spacing": sum(map(smallest_distance, places)) / len(places),
        "official_speed": float(position.diff(dim=0).max()),
    }


def run(study: Study) -> Result:
    """Roll the trained models out at every radius."""
    trials = [Trial(system=SYSTEM, method=METHOD, seed=seed) for seed in study.seeds]
    names = train_tuned(study, trials)
    radii = list(PAPER)[::4] if study.scale.name == "tiny" else list(PAPER)
    keys = [
        {"trial": name, "radius": radius, "rescaled": rescaled, "frames": FRAMES}
        for rescaled in (True, False)
        for radius in radii
        for name in names
    ]
    found = study.kept_all("table11", keys, measure)
    count = len(names)
    rows = [_row(found[first : first + count]) for first in range(0, len(found), count)]
    return Result(
        id="table11",
        title=TITLE,
        columns=COLUMNS,
        rows=[_truth(study, names), *rows],
        notes=_notes(rows),
        draw=_drawing(rows),
    )


def measure(study: Study, key: dict[str, Any]) -> dict[str, Any]:
    """One rollout at one radius.

    Args:
        study: Where the models are.
        key: ``trial``, ``radius`` [m], whether the features are ``rescaled`` to it, ``frames``.
    """
    answer = {"radius": key["radius"], "rescaled": key["rescaled"]}
    simulator = trained_model(study, key["trial"])
    if simulator is None:
        return answer | dict.fromkeys((*MEASURES, "degree", "components", "rollout_mse"))
    trajectory = first_test_trajectory(study, SYSTEM)
    connect = connect_at(simulator, key["radius"], rescaled=key["rescaled"])
    samples = simulator.sample(trajectory.position[0])
    case = roll(simulator, trajectory, samples=samples, frames=key["frames"], connect=connect)
    return answer | _numbers(case) | {"trained_radius": simulator.config.graph.radius}


def _numbers(case: Case) -> dict[str, Any]:
    """What a rollout is described by; one that diverged has no measures."""
    count = len(case.edges.offset) - 1
    numbers: dict[str, Any] = {
        "degree": (len(case.edges.sender) - count) / count,
        "components": joined_components(case.edges),
        "rollout_mse": case.mse,
    }
    if case.rollout.diverged_at is not None:
        return numbers | dict.fromkeys(MEASURES)
    everything = torch.cat([case.given, case.rollout.position])
    predicted = everything[len(case.given) - 1 :]
    return numbers | viscosity(predicted) | official_viscosity(everything)


def _row(found: list[dict[str, Any]]) -> dict[str, Any]:
    """The trainings of one radius as a row."""
    radius, rescaled = found[0]["radius"], found[0]["rescaled"]
    row: dict[str, Any] = {
        "radius": radius,
        "features_in": "this radius" if rescaled else "the trained radius",
    }
    for name in ("degree", "components", *MEASURES, "rollout_mse"):
        row |= over_seeds(name, [one[name] for one in found])
    row["trained_radius"] = next((r for o in found if (r := o.get("trained_radius"))), None)
    row["diverged"] = f"{sum(one['rollout_mse'] is None for one in found)}/{len(found)}"
    spacing, speed = PAPER[radius]
    row |= {"paper_spacing": spacing, "paper_speed": speed}
    for name, paper in (("spacing", spacing), ("speed", speed)):
        row[f"ratio_{name}"] = None if row[name] is None else row[name] / paper
    row["squared_spacing"] = None if row["spacing"] is None else row["spacing"] ** 2
    return row


def _truth(study: Study, names: list[str]) -> dict[str, Any]:
    """The solver's motion of the same samples, which has no radius."""

    def make() -> dict[str, Any]:
        trajectory = first_test_trajectory(study, SYSTEM)
        models = [trained_model(study, name) for name in names]
        simulator = next((model for model in models if model is not None), None)
        if simulator is None:
            return dict.fromkeys(MEASURES)
        history = simulator.config.features.history
        motion = trajectory.position[: history + FRAMES, simulator.sample(trajectory.position[0])]
        return viscosity(motion[history - 1 :]) | official_viscosity(motion)

    found = study.kept("table11-truth", {"trials": names, "frames": FRAMES}, make)
    squared = None if found["spacing"] is None else found["spacing"] ** 2
    return {"features_in": "the solver", "squared_spacing": squared} | found


def _notes(rows: list[dict[str, Any]]) -> list[str]:
    notes = [
        f"`spacing`: mean over {FRAMES} steps of the smallest distance of two particles [m]; "
        f"`speed`: mean over steps of the largest distance a particle moves in one frame [m], "
        f"the caption's definitions. `official spacing` and `official speed` follow the official "
        f"helpers: all frames, the given ones too, the smallest distance that is not zero, and "
        f"the largest signed component of a velocity at any time.",
        "`features in`: the official code measures the features in the radius of the graph, so "
        "that another radius changes the graph and the scale of all inputs; with the trained "
        "radius the graph alone changes.",
        "The paper's spacings are far below the distance of its samples; "
        "`squared spacing` is what its column would be as a squared distance, which is a guess. "
        "The material is not stated; its helpers stand beside the two-dimensional water.",
    ]
    for label in dict.fromkeys(row["features_in"] for row in rows):
        own = [row for row in rows if row["features_in"] == label and row["spacing"] is not None]
        if len(own) > 1:
            notes.append(
                f"With features in {label}, from radius {own[0]['radius']:g} to "
                f"{own[-1]['radius']:g} m: spacing times "
                f"{own[-1]['spacing'] / own[0]['spacing']:.3g} (paper "
                f"{own[-1]['paper_spacing'] / own[0]['paper_spacing']:.3g}), speed times "
                f"{own[-1]['speed'] / own[0]['speed']:.3g} (paper "
                f"{own[-1]['paper_speed'] / own[0]['paper_speed']:.3g})."
            )
    trained = [row["trained_radius"] for row in rows if row["trained_radius"]]
    if trained:
        notes.append(f"The models were trained at a radius of {trained[0]:.4g} m.")
    return notes


def _drawing(rows: list[dict[str, Any]]) -> Callable[[Any], None]:
    def draw(figure: Any) -> None:
        panels = figure.subplots(1, 2)
        for label in dict.fromkeys(row["features_in"] for row in rows):
            own = [row for row in rows if row["features_in"] == label]
            for axes, name in zip(panels, ("spacing", "speed"), strict=True):
                known = [row for row in own if row[name] is not None]
                axes.plot(
                    [row["radius"] for row in known],
                    [row[name] for row in known],
                    marker="o",
                    label=f"features in {label}",
                )
        paper = list(PAPER.items())
        style = {"color": "black", "linestyle": "--"}
        panels[0].plot(
            [radius for radius, _ in paper],
            [spacing**0.5 for _, (spacing, _) in paper],
            label="paper, square root",
            **style,
        )
        panels[1].plot(
            [radius for radius, _ in paper],
            [speed for _, (_, speed) in paper],
            label="paper",
            **style,
        )
        panels[0].set_ylabel("mean smallest distance [m]")
        panels[1].set_ylabel("mean largest speed [m per frame]")
        for axes in panels:
            axes.set_xlabel("radius of the graph at inference [m]")
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
            axes.legend(fontsize=8)
        figure.suptitle(TITLE)

    return draw
