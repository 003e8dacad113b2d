"""Scores of forecasts and the rows made of them, against values known by hand."""

import math

import pytest
import torch

from giorom.forecasters import DinoConfig, ForecasterConfig, LatentForecaster
from giorom.reproduce import latent
from giorom.state import Trajectory


def falling(frames: int = 8) -> Trajectory:
    """A cloud that moves by a hundredth along the first axis in every frame; point 0 is held."""
    body = torch.rand(30, 2, generator=torch.Generator().manual_seed(0))
    step = torch.zeros(30, 2)
    step[1:, 0] = 0.01
    return Trajectory(
        position=torch.stack([body + n * step for n in range(frames)]),
        particle_type=torch.tensor([3] + [8] * 29),
        frame_dt=0.01,
        bounds=torch.tensor([[0.0, 1.0], [0.0, 1.0]]),
    )


@pytest.fixture
def still() -> LatentForecaster:
    """A forecaster that says that nothing moves."""
    config = ForecasterConfig(dino=DinoConfig(code=2, width=4, layers=1, fit_steps=1))
    forecaster = LatentForecaster(config, dimension=2).requires_grad_(False)
    forecaster.field.output.weight.zero_()
    forecaster.field.output.bias.zero_()
    return forecaster


def test_a_forecast_of_rest_has_the_squared_displacement_as_error(still):
    """29 of 30 points are off by n hundredths at frame n; given frames count, with no error."""
    found = latent.score_forecast(still, falling(), torch.arange(10), history=2)
    expected = sum((0.01 * n) ** 2 for n in range(2, 8)) * 29 / 30 / 8
    assert found["rollout_mse"] == pytest.approx(expected, rel=1e-4)
    assert found["relative_error"] == pytest.approx(1.0, rel=1e-5)
    floor = sum((0.01 * n) ** 2 for n in (2, 3, 4, 6, 7)) * 29 / 30 / 5
    assert found["floor_mse"] == pytest.approx(floor, rel=1e-4)
    assert found["diverged_at"] is None
    # The last given frame is one hundredth ahead of the undeformed body.
    held_still = sum((0.01 * (n - 1)) ** 2 for n in range(2, 8)) * 29 / 30 / 8
    assert found["still_mse"] == pytest.approx(held_still, rel=1e-4)


def test_a_forecast_that_leaves_the_domain_has_no_error_and_is_counted(still):
    """Further outside than the domain is wide, or not finite."""
    still.field.output.bias[0] = 5.0
    found = latent.score_forecast(still, falling(), torch.arange(10), history=2)
    assert (found["rollout_mse"], found["relative_error"]) == (None, None)
    assert found["diverged_at"] == 1
    frames = torch.full((4, 3, 2), 0.5)
    frames[2, 1, 0] = math.nan
    assert latent._diverged(frames, falling().bounds) == 3
    assert latent._diverged(frames[:2], falling().bounds) is None


def forecast(*errors, diverged=()) -> dict:
    """What one forecaster left behind."""
    entries = [
        {
            "rollout_mse": e,
            "relative_error": e,
            "floor_mse": 0.1,
            "still_mse": 9.0,
            "diverged_at": None,
        }
        for e in errors
    ]
    for number in diverged:
        entries[number] |= {"rollout_mse": None, "relative_error": None, "diverged_at": 5}
    return {"per_trajectory": entries, "steps": 10, "seconds": 2.0, "parameters": 7}


def test_rows_compare_motion_by_motion_with_ours_and_count_what_diverged():
    """Twice the error everywhere is two times; a motion that diverged is in no mean."""
    scores = [forecast(2.0, 4.0), forecast(2.0, 9.0, diverged=[1])]
    names = {name: scores for name in latent.FORECASTERS}
    rows = latent._system_rows("elastic3d", [forecast(1.0, 2.0)], names)
    mine, dino, still, colora = rows[0], rows[1], rows[-2], rows[-1]
    assert (mine["rollout_mse"], mine["relative_error"], mine["diverged"]) == (1.5, 1.5, "0/2")
    assert dino["rollout_mse"] == pytest.approx((3.0 + 2.0) / 2)
    assert dino["diverged"] == "1/4"
    assert dino["times_ours"].startswith("2 (2 to 2")
    assert (dino["floor_mse"], dino["parameters"]) == (pytest.approx(0.1), 7)
    assert still["rollout_mse"] == 9.0
    assert colora.get("rollout_mse") is None
    assert latent._verdicts(rows) == ["elastic3d: least error by ours, end to end (1.5)."]
