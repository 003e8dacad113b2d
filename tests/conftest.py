"""One tiny data set and one tiny trained run, made once and shared by all tests."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from giorom.cli import main
from giorom.config import Experiment, load_experiment
from giorom.experiment import train
from giorom.generate import generate
from giorom.simulator import Simulator
from giorom.training.training_config import Budget

TINY: dict[str, Any] = {
    "system": "tiny",
    "scene": {
        "family": "clamped",
        "dimension": 3,
        "material": "stable_neo_hookean",
        "material_parameters": {
            "density": 1000.0,
            "youngs_modulus": 1.0e5,
            "poissons_ratio": 0.2,
        },
        "shapes": ["box", "ellipsoid"],
        "held_out_shapes": ["capsule"],
        "height_range": [0.36, 0.40],
        "spacing": 0.04,
        "slenderness": [0.7, 0.8],
        "speed_range": [0.7, 1.2],
        "wall": 0.125,
    },
    "solver": {"grid_cells": 16, "frame_dt": 5.0e-3, "frames": 16},
    "sampling": {"method": "farthest", "count": 40},
    "graph": {"configuration": "reference"},
    "features": {"velocities": 1, "rest_edges": True},
    "time_stepper": {
        "overrides": {
            "hidden": 16,
            "latent_side": 4,
            "latent_width": 8,
            "transformer_width": 16,
            "gno_in_hidden": [8],
            "gno_out_hidden": [8],
        }
    },
    "field": {"neural_basis": {"modes": 4, "width": 16, "depth": 2}},
    "training": {
        "batch_size": 2,
        "learning_rate": 1.0e-3,
        "warmup": 4,
        "noise_std": 3.0e-5,
        "isotropic": True,
        "turn": True,
        "subsets": 2,
        "validations": 2,
        "validation_frames": 4,
        "average_decay": 0.5,
    },
    "field_training": {"steps": 20, "frames": 4, "samples": 40, "queries": 80, "stored_frames": 8},
}


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Sums on one thread have one order, so that equal means bit-identical."""
    torch.set_num_threads(1)


@pytest.fixture
def tiny_values() -> dict[str, Any]:
    """The values of the tiny experiment, free to be changed."""
    return copy.deepcopy(TINY)


@pytest.fixture(scope="session")
def tiny_yaml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny experiment as a file."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def tiny(tiny_yaml: Path) -> Experiment:
    """The tiny experiment."""
    return load_experiment(str(tiny_yaml))


@pytest.fixture(scope="session")
def make_data() -> Callable[..., dict[str, Any]]:
    """Make a data set of an experiment in this process."""

    def make(experiment: Experiment, folder: Path, *, trajectories: int = 6, seed: int = 0) -> Any:
        return generate(
            experiment,
            folder=folder,
            trajectories=trajectories,
            seed=seed,
            jobs=1,
            shape=None,
            device="cpu",
            report=lambda finished, wanted: None,
        )

    return make


@pytest.fixture(scope="session")
def run_training() -> Callable[..., dict[str, Any]]:
    """Train an experiment for some steps."""

    def run(experiment: Experiment, data: Path, out: Path, **options: Any) -> dict[str, Any]:
        return train(
            experiment,
            data_folder=data,
            out=out,
            budget=Budget(steps=options.pop("steps", 12)),
            seed=options.pop("seed", 0),
            resume=options.pop("resume", False),
            device="cpu",
            report=options.pop("report", lambda stage, numbers: None),
            **options,
        )

    return run


@pytest.fixture(scope="session")
def data_folder(
    tiny: Experiment, make_data: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A data set of six trajectories; tests read it and leave it as it is."""
    folder = tmp_path_factory.mktemp("data") / "tiny"
    make_data(tiny, folder)
    return folder


@pytest.fixture(scope="session")
def run_folder(
    tiny: Experiment,
    data_folder: Path,
    run_training: Callable[..., Any],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A run of twenty steps; tests read it and leave it as it is."""
    folder = tmp_path_factory.mktemp("run") / "tiny"
    run_training(tiny, data_folder, folder, steps=20)
    return folder


@pytest.fixture
def simulator(run_folder: Path) -> Simulator:
    """The tiny trained simulator."""
    return Simulator.from_pretrained(run_folder)


@pytest.fixture
def succeed(tmp_path, capsys):
    """Run a command that must succeed and return its JSON result."""

    def call(*words):
        file = tmp_path / "result.json"
        assert main([*map(str, words), "--json", str(file), "--quiet"]) == 0
        output = capsys.readouterr()
        assert output.out == output.err == ""
        return json.loads(file.read_text())

    return call


@pytest.fixture
def refuse(capsys):
    """Run a command that must refuse its input with one line, and return the line."""

    def call(*words, code=2):
        assert main([*map(str, words), "--quiet"]) == code
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.startswith(f"giorom {words[0]}: ")
        assert output.err.count("\n") == 1
        return output.err

    return call
