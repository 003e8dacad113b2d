"""A fresh test set for a trained simulator: new scenes of the family it was trained on.

Made by the functions of ``giorom simulate`` from what the simulator itself stores. The seeds of the
scenes lie far from those of training data, which start at seed 0.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from giorom.config import Experiment
from giorom.data.trajectory_file import SPLITS, iterate_trajectories
from giorom.generate.dataset import generate
from giorom.records import one_line
from giorom.simulator import SimulatorConfig
from giorom.state import Trajectory

HELD_OUT_SEED = 1000
"""Added to the seed of a held-out set; no training set of ours has so high a seed."""


def make_held_out(
    config: SimulatorConfig,
    *,
    folder: Path,
    trajectories: int,
    seed: int = 0,
    frames: int | None = None,
    shape: str | None = None,
    jobs: int = 1,
    device: str = "cpu",
    report: Callable[[int, int], None] = lambda _, __: None,
) -> dict[str, Any]:
    """Simulate scenes that the model has not seen.

    Args:
        config: The simulator; its scenes, solver and walls are used as they are.
        folder: Data set to make.
        trajectories: How many.
        seed: Number of the held-out set; its data set has the seed ``HELD_OUT_SEED + seed``.
        frames: Frames after those that the model is given; by default the length of the training
            trajectories.
        shape: Shape or mesh file in place of the drawn ones.
        jobs: Processes.
        device: ``cpu`` or ``cuda``.
        report: Progress, in frames.

    Returns:
        The keys of ``giorom simulate --json``, and the ``seed``.
    """
    solver = config.solver
    if frames is not None:
        solver = replace(solver, frames=frames + config.features.history)
    experiment = Experiment(
        system=config.system,
        scene=config.scene,
        solver=solver,
        sampling=config.sampling,
        graph=config.graph,
    )
    made = generate(
        experiment,
        folder=folder,
        trajectories=trajectories,
        seed=HELD_OUT_SEED + seed,
        jobs=jobs,
        shape=shape,
        device=device,
        report=report,
    )
    return made | {"seed": HELD_OUT_SEED + seed}


def held_out_trajectories(folder: Path) -> Iterator[Trajectory]:
    """Every trajectory of a data set, whatever part it was put into."""
    for split in SPLITS:
        yield from iterate_trajectories(folder, split)


def require_unseen(directory: Path, seed: int) -> None:
    """Refuse a held-out set whose scenes the model was trained on.

    Args:
        directory: Folder of the model; ``data_seed`` in its ``training.json`` is the seed of the
            training data.
        seed: Seed of the held-out data set.

    Raises:
        ValueError: If both are the same, or ``training.json`` is damaged.
    """
    path = directory / "training.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is not readable JSON ({one_line(error)}). Copy it again."
        ) from None
    if not isinstance(record, dict):
        raise ValueError(f"{path} must hold a JSON object, got {str(record)[:80]}. Copy it again.")
    if record.get("data_seed") == seed:
        raise ValueError(
            f"the training data of {directory.name} were made with the seed {seed} too, so that "
            f"its scenes are no test. Choose another --seed."
        )
