"""Table 12: the latent grid of a trained network made finer or coarser, water in two dimensions.

One model is trained and its grid changed when it is used. Its nodes reach as many spacings as in
the training (the kernels then see the same numbers), or as many metres (the paper).
"""

from dataclasses import replace
from typing import Any

import torch

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.discretisation import rebuilt
from giorom.pipeline import start_from_trajectory
from giorom.reproduce.ablation import ERRORS, Variant, network_of, trials_of
from giorom.reproduce.changed_model import (
    changed_row,
    score_simulator,
    with_latent_grid,
)
from giorom.reproduce.charts import OTHER, OURS, draw_paper, draw_rows, finish
from giorom.reproduce.compare import over_seeds, with_ratio
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import trained_model
from giorom.reproduce.study import Study
from giorom.simulator import Simulator

TITLE = "Table 12: another latent grid than in the training, water in 2-D"

SYSTEM = "water2d"
"""System of the table."""

PAPER = {128: 7.2e-3, 64: 7.4e-3, 32: 8.1e-3, 16: 7.5e-3, 8: 1.1e-2}
"""Rollout error [m^2] by nodes along an axis; Table 12 of arXiv:2407.03925v2."""

REACHES = ("spacings", "metres")
"""What of a node's reach stays as it was in the training."""


def run(study: Study) -> Result:
    """Train once, use with every grid."""
    trials = trials_of(study, [Variant(system=SYSTEM, labels={})])[0]
    study.train_all(trials, full=False)
    keys = [
        {"trial": study.folder(trial).name, "side": side, "reach": reach}
        for reach in REACHES
        for side in PAPER
        for trial in trials
    ]
    found = study.kept_all("another latent grid", keys, score_with_grid)
    rows, trained_side = [], network_of(study, SYSTEM).latent_side
    for start in range(0, len(keys), len(trials)):
        several = found[start : start + len(trials)]
        side, reach = keys[start]["side"], keys[start]["reach"]
        labels = {"latent_side": side, "reach_kept": reach, "trained": side == trained_side}
        scores = [None if entry is None else entry["scores"] for entry in several]
        row = labels | changed_row(study, trials, scores, ERRORS)
        for name in ("reach", "coverage", "tokens"):
            row |= over_seeds(name, [None if e is None else e[name] for e in several])
        rows.append(row | with_ratio(row["rollout_mse"], PAPER[side]))
    return Result(
        id="table12",
        title=TITLE,
        columns=[
            "latent_side",
            "reach_kept",
            "reach",
            "coverage",
            "tokens",
            "trained",
            "rollout_mse",
            "diverged",
            "paper",
            "ratio",
        ],
        rows=rows,
        notes=_notes(trained_side),
        draw=lambda figure: draw(figure, rows),
    )


def score_with_grid(study: Study, key: dict[str, Any]) -> dict[str, Any] | None:
    """Scores of a trained model with another grid, and what it reaches; none if there is none.

    Args:
        study: Where the model is.
        key: ``trial``, ``side`` and which ``reach`` is kept.
    """
    trained = trained_model(study, key["trial"])
    if trained is None:
        return None
    grid = trained.dynamics.time_stepper.latent.grid
    finer = replace(grid, side=key["side"], radius=None)
    in_spacings = key["reach"] == "spacings"
    radius = grid.reach / grid.covering_radius * finer.covering_radius
    radius = radius if in_spacings else grid.reach
    config = with_latent_grid(trained.config, side=key["side"], radius=radius)
    changed = rebuilt(trained, config)
    scores = score_simulator(study, changed, SYSTEM)
    return {"scores": scores, "reach": radius, **_grid_use(study, changed)}


def _grid_use(study: Study, simulator: Simulator) -> dict[str, float]:
    """Share of the samples that the grid reaches and nodes in use, half-way through the test."""
    grid, history = simulator.dynamics.time_stepper.latent.grid, simulator.config.features.history
    shares, tokens = [], []
    for found in iterate_trajectories(study.dataset(SYSTEM), "test"):
        trajectory = found.to(study.device)
        frame = max(history - 1, trajectory.frame_count // 2)
        samples = simulator.sample(trajectory.position[0])
        state = start_from_trajectory(trajectory, samples, history=history, frame=frame)
        shares.append(float(grid.coverage(state.position)))
        tokens.append(len(torch.unique(grid.pairs(state.position).node)))
    return {"coverage": sum(shares) / len(shares), "tokens": sum(tokens) / len(tokens)}


def _notes(trained_side: int) -> list[str]:
    return [
        f"Trained with {trained_side} nodes along an axis; the grid is changed when the model is "
        f"used, and nothing is trained again.",
        "Reach of a node [m]: as many spacings as in the training, or as many metres. Coverage is "
        "the share of the samples that some node reaches, tokens the number of nodes that reach "
        "some sample, both half-way through the test trajectories. Samples out of reach get "
        "nothing from the grid.",
        "Figure 9 has the networks that are trained with each of these grids.",
        "Rollout error of the samples [m²].",
    ]


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Error by nodes along an axis."""
    axes = figure.add_subplot()
    for reach, color in zip(REACHES, (OURS, OTHER), strict=True):
        chosen = [row for row in rows if row["reach_kept"] == reach]
        sides = [row["latent_side"] for row in chosen]
        draw_rows(axes, chosen, sides, label=f"ours, same reach in {reach}", color=color)
    sides = list(PAPER)
    draw_paper(axes, sides, list(PAPER.values()))
    finish(axes, x="nodes of the latent grid along an axis")
    axes.set_xscale("log", base=2)
    axes.set_xticks(sides, [str(side) for side in sides])
