"""The time to reach stated errors, against histories whose answer is plain."""

import json
from dataclasses import replace

import pytest

from giorom.training.goals import seconds_of_stage, time_to
from giorom.training.training_config import TrainingConfig

HISTORY = [
    {"seconds": 1.0, "rollout_mse": None, "static_mse": 4.0},
    {"seconds": 2.0, "rollout_mse": 2.0, "static_mse": 4.0},
    {"seconds": 3.0, "rollout_mse": 8.0, "static_mse": 4.0},
    {"seconds": 4.0, "rollout_mse": 0.4, "static_mse": 4.0},
]
"""Diverged, half of holding still, worse again, a tenth."""


def test_the_first_validation_that_is_good_enough_counts():
    """Later ones may be worse; equality is reached; what never was is None."""
    found = time_to(HISTORY, [1.0, 0.5, 0.25, 0.1, 0.05], unit="static")
    assert found == {
        "1 x static": 2.0,
        "0.5 x static": 2.0,
        "0.25 x static": 4.0,
        "0.1 x static": 4.0,
        "0.05 x static": None,
    }


def test_goals_in_square_metres_do_not_know_holding_still():
    """The same history; what went before is added."""
    found = time_to(HISTORY, [8.0, 1.0], unit="m^2", earlier=10.0)
    assert found == {"8 m^2": 12.0, "1 m^2": 14.0}
    assert time_to([], [1.0], unit="static") == {"1 x static": None}


def test_seconds_of_a_stage_are_those_of_its_last_entry(tmp_path):
    """An interrupted stage is logged again when it is repeated; no log, no seconds."""
    log = tmp_path / "log.jsonl"
    assert seconds_of_stage(log, "skip") == 0.0
    entries = [
        {"stage": "skip", "seconds": 3.0},
        {"stage": "skip", "seconds": 5.0},
        {"stage": "field", "seconds": 7.0},
    ]
    log.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    assert seconds_of_stage(log, "skip") == 5.0
    assert seconds_of_stage(log, "other") == 0.0


@pytest.mark.parametrize(
    ("values", "name"),
    [({"goals": [0.5, 0.0]}, "goals"), ({"least_coverage": 1.5}, "least_coverage")],
)
def test_goals_and_shares_no_run_can_have_are_refused(values, name):
    """The message names the field."""
    with pytest.raises(ValueError, match=rf"TrainingConfig\.{name}"):
        TrainingConfig(**values)


def test_a_run_reports_the_time_of_its_own_validations(tiny, data_folder, run_training, tmp_path):
    """A goal every rollout reaches, one none does, and the skip's fit counted in."""
    training = replace(tiny.training, goals=[1e9, 1e-9], gate_steps=1)
    stepper = replace(
        tiny.time_stepper, overrides=tiny.time_stepper.overrides | {"input_skip": "linear"}
    )
    experiment = replace(tiny, training=training, time_stepper=stepper)
    result = run_training(experiment, data_folder, tmp_path / "run", steps=2)
    skip = seconds_of_stage(tmp_path / "run" / "log.jsonl", "skip")
    assert skip > 0.0
    first = skip + result["history"][0]["seconds"]
    assert result["time_to"] == {"1e+09 x static": pytest.approx(first), "1e-09 x static": None}
