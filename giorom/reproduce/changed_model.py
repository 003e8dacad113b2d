"""A trained model with another latent grid or graph than it was trained with, scored as it is.

The weights stay: neither the size of the latent grid nor the graph shapes any of them.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from giorom.reproduce.compare import score_columns
from giorom.reproduce.study import Study
from giorom.reproduce.trial import Trial, score_run
from giorom.simulator import Simulator
from giorom.simulator_config import SimulatorConfig


def with_latent_grid(
    config: SimulatorConfig, *, side: int, radius: float | None
) -> SimulatorConfig:
    """Another number of nodes along each axis; ``radius`` as in ``latent_radius`` [m]."""
    network = replace(config.time_stepper, latent_side=side, latent_radius=radius)
    return replace(config, time_stepper=network)


def with_graph(config: SimulatorConfig, *, kind: str) -> SimulatorConfig:
    """Another kind of graph."""
    return replace(config, graph=replace(config.graph, kind=kind))


def score_simulator(study: Study, simulator: Simulator, system: str) -> dict[str, Any]:
    """Scores of a model on the test split of a system."""
    with tempfile.TemporaryDirectory() as directory:
        simulator.save_pretrained(directory)
        return score_run(
            Path(directory),
            study.dataset(system),
            where="test",
            frames=None,
            sparse_points=None,
            full=False,
            device=study.device,
        )


def changed_row(
    study: Study,
    trials: list[Trial],
    scores: list[dict[str, Any] | None],
    names: dict[str, tuple[str, str]],
) -> dict[str, Any]:
    """Columns of changed models; what their trainings were stays theirs."""
    found = []
    for trial, score in zip(trials, scores, strict=True):
        known = study.scores(trial, full=False)
        base = {"sparse": None, "full": None, "diverged": known["trajectories"]}
        found.append(known | (base if score is None else score))
    return score_columns(found, names)
