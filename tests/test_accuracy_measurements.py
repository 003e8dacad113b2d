"""Noise floor, long rollouts and other discretisations: at a size that a test can afford."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks.accuracy.discretisation import KEPT, _row, measure_discretisation
from benchmarks.accuracy.noise_floor import measure_noise_floor
from benchmarks.accuracy.stability import measure_stability
from giorom.data.trajectory_file import read_trajectory
from giorom.evaluation.discretisation import widened
from giorom.pipeline import integrated, start_from_trajectory


def test_the_noise_floor_of_an_elastic_body_is_linear_in_the_noise(tiny):
    """Ten times the velocity noise, a hundred times the squared distance: no chaos in a swing."""
    found = measure_noise_floor(tiny.scene, tiny.solver, trajectories=1, frames=51)
    small, large = found["rows"][:2]
    assert [row["scenes"] for row in found["rows"]] == [1] * 4
    assert found["failed"] == []
    for key in ("mse_at", "mse_until"):
        assert set(small[key]) == {"50"}
        assert large[key]["50"] == pytest.approx(100.0 * small[key]["50"], rel=0.2)
        assert 0.0 < small[key]["50"] <= small[f"{key}_largest"]["50"]
    assert all(row["mse_at"]["50"] > 0.0 for row in found["rows"][2:])


def test_a_model_that_holds_still_loses_nothing_and_one_that_flies_away_everything(simulator):
    """Stability counts what it should; scenes that do not fill a batch are counted too."""
    options = {"scenes": 3, "horizons": 1.5, "batch": 2}
    simulator.dynamics.step = integrated(lambda state, _: -state.velocity / state.frame_dt)
    found = measure_stability(simulator, **options)
    assert (found["scenes"], found["frames"], found["lost"]) == (3, 24, 0)
    assert found["largest_excursion"] == 0.0
    simulator.dynamics.step = integrated(lambda state, _: torch.full_like(state.position, 1e3))
    found = measure_stability(simulator, **options)
    assert (found["lost"], found["beyond_walls"], found["not_finite"]) == (3, 3, 0)
    assert found["largest_excursion"] > found["tolerance"]
    assert [entry["scene"] for entry in found["losses"]] == [0, 1, 2]


def test_other_discretisations_are_compared_with_the_trained_one(simulator):
    """Counts and radii follow the factor; the ratio is that of the means; shapes are kept apart."""
    found = measure_discretisation(simulator, trajectories=2, frames=4, factors=(1.0, 0.5, 2.0))
    rows = {entry["setting"]: entry for entry in found["rows"]}
    assert list(rows) == ["1 x", "0.5 x", "2 x", "shape capsule"]
    assert [entry["sparse_points"] for entry in found["rows"]] == [40, 20, 80, 40]
    trained = simulator.config.graph.radius
    assert rows["0.5 x"]["radius"] == pytest.approx(trained * 2.0 ** (1.0 / 3.0))
    assert rows["2 x"]["radius"] == trained
    assert rows["1 x"]["ratio"] == 1.0
    expected = rows["2 x"]["full_rollout_mse"] / rows["1 x"]["full_rollout_mse"]
    assert rows["2 x"]["ratio"] == expected
    assert all(entry["trajectories"] == 2 for entry in found["rows"])
    with pytest.raises(ValueError, match="the first factor is the reference"):
        measure_discretisation(simulator, factors=(0.5, 1.0))


def test_a_model_at_its_own_radius_is_the_same_model(simulator, data_folder):
    """Equal accelerations, bit by bit; a larger radius has more edges and nothing else changed."""
    trajectory = read_trajectory(data_folder, "test", 0)
    samples = simulator.sample(trajectory.position[0])
    state = start_from_trajectory(trajectory, samples, history=2)
    same, other = widened(simulator, 1.0), widened(simulator, 1.5)
    expected = simulator.dynamics(state, simulator.connect(state))
    assert torch.equal(same.dynamics(state, same.connect(state)), expected)
    assert len(other.connect(state).sender) > len(same.connect(state).sender)
    assert replace(other.config, graph=simulator.config.graph) == simulator.config


def test_a_score_that_is_not_finite_has_no_mean_and_hides_no_other():
    """One step of one trajectory overflows: its mean is unknown, the rollout's is not."""

    def result(one_step):
        scores = {where: dict.fromkeys(keys, 2.0) for where, keys in KEPT.items()}
        scores["sparse"]["one_step_mse"] = one_step
        scores["full"]["static_mse"] = 1.0
        sizes = {"points": 10, "sparse_points": 5, "frames": 3, "radius": 0.1}
        return scores | sizes | {"diverged_at": None}

    row = _row("0.25 x", [result(1.0), result(math.inf)])
    assert row["sparse_one_step_mse"] is None
    assert row["sparse_one_step_mse_std"] is None
    assert row["full_rollout_mse"] == 2.0
