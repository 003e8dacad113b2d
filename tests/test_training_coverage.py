"""The latent grid has to reach the training samples; otherwise a run says so and does not begin."""

import json
from dataclasses import replace

import pytest
import torch

from giorom.config import StepperChoice
from giorom.experiment import build_simulator
from giorom.training.coverage import check_coverage, measure_coverage
from giorom.training_data import load_training_data

FAR = [[5.0, 6.0]] * 3
"""A grid where no body is."""


def with_grid(experiment, least=0.9, **overrides):
    """The experiment with another latent grid."""
    overrides = experiment.time_stepper.overrides | overrides
    return replace(
        experiment,
        time_stepper=StepperChoice(overrides=overrides),
        training=replace(experiment.training, least_coverage=least),
    )


def log_of(folder):
    """Entries of a log."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_coverage_is_the_share_of_samples_with_a_node_in_reach(tiny, data_folder):
    """Brute force over all samples, nodes and windows of a coarse grid with a short reach."""
    experiment = with_grid(tiny, latent_radius=0.15, latent_bounds=[[0.0, 1.0]] * 3)
    data = load_training_data(experiment, data_folder)
    network = build_simulator(experiment, data).dynamics.time_stepper
    nodes = torch.cartesian_prod(*[torch.linspace(0.0, 1.0, 4)] * 3)
    shares = []
    for number in range(len(data.windows)):
        position = data.windows[number].state.position
        distance = (position[:, None] - nodes).norm(dim=2).amin(dim=1)
        shares.append(float((distance <= 0.15).float().mean()))
    step = max(1, len(data.windows) // 64)
    found = measure_coverage(network, data.windows, turned=False)
    assert 0.0 < found < 0.9
    assert found == pytest.approx(sum(shares[::step]) / len(shares[::step]), abs=1e-6)


@pytest.mark.parametrize("grid", [{"latent_bounds": FAR}, {"latent_radius": 1e-3}])
def test_a_run_whose_latent_branch_is_dead_is_refused_before_it_begins(
    tiny, data_folder, run_training, tmp_path, grid
):
    """Share, rule, value and every way out stand in one line; no folder is made."""
    with pytest.raises(ValueError, match="latent grid reaches") as caught:
        run_training(with_grid(tiny, **grid), data_folder, tmp_path / "run")
    message = str(caught.value)
    for part in (
        "reaches 0.0 % of the samples",
        "least_coverage=0.9",
        "latent_radius to null",
        "latent_bounds",
        "latent_side",
        "latent: false",
        "least_coverage: 0 accepts",
    ):
        assert part in message
    assert "\n" not in message
    assert not (tmp_path / "run").exists()


def test_a_grid_that_misses_samples_knowingly_can_be_trained(
    tiny, data_folder, run_training, tmp_path
):
    """The share is in the result and in the log; what the message proposes is accepted."""
    experiment = with_grid(tiny, least=0.0, latent_bounds=FAR)
    result = run_training(experiment, data_folder, tmp_path / "run", steps=1)
    assert result["latent_coverage"] == 0.0
    assert log_of(tmp_path / "run")[0] == {"stage": "coverage", "share": 0.0}


def test_the_grid_over_the_data_reaches_all_samples_also_when_turned(tiny, data_folder):
    """The recommended grid follows from the padded bounds; without a grid nothing is missed."""
    for overrides in ({}, {"latent": False}):
        experiment = with_grid(tiny, least=1.0, **overrides)
        data = load_training_data(experiment, data_folder)
        network = build_simulator(experiment, data).dynamics.time_stepper
        assert check_coverage(network, data.windows, experiment.training) == 1.0


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_the_domain_of_the_grid_can_be_given(tiny, preset):
    """Otherwise it is that of the data, or that of the official code."""
    wanted, data = [[-1.0, 2.0]] * 3, [[0.2, 0.8]] * 3

    def bounds(**overrides):
        choice = StepperChoice(preset=preset, overrides=overrides)
        config = choice.build(dimension=3, features=tiny.features, latent_bounds=data)
        return config.latent_bounds

    assert bounds(latent_bounds=wanted) == wanted
    assert bounds() == (data if preset == "default" else [[0.0, 1.0]] * 3)
