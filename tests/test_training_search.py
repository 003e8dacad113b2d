"""The search without gradients against its own inverse problem, an interruption and divergence."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from giorom.data.windows import SampledTrajectory, Windows
from giorom.grid_stepper import GridStepper, GridStepperConfig
from giorom.pipeline import rollout, start_from_velocity, unconnected
from giorom.state import WATER, Trajectory
from giorom.training.checkpoint import CheckpointError
from giorom.training.loop import RunState, train_stepper
from giorom.training.search import (
    MOST_VALUES,
    Distribution,
    StepperSearch,
    searched_entries,
    watched,
)
from giorom.training.training_config import Budget, TrainingConfig

FRAMES = 6
CONFIG = TrainingConfig(
    optimizer="cma", objective="motion", batch_size=1, unroll=[[0.0, float(FRAMES)]], validations=2
)


def stepper():
    model = GridStepper(GridStepperConfig(spacing=0.05, substeps=3), dimension=2)
    model.gravity[1] = -9.8
    return model


def windows_of(model):
    """Windows over what a model makes of a block of water that hits the floor at 1 m/s."""
    axis = torch.arange(4) * 0.025
    position = torch.cartesian_prod(0.4 + axis, 0.11 + axis)
    state = start_from_velocity(
        position,
        torch.tensor([[0.0, -1.0]]).repeat(16, 1),
        particle_type=torch.full((16,), WATER),
        bounds=torch.tensor([[0.1, 0.9]] * 2),
        frame_dt=2.5e-3,
        history=2,
    )
    with torch.no_grad():
        later = rollout(state, FRAMES, connect=unconnected, step=model.step)
        frames = [*state.history.unbind(1), *(each.position for each in later)]
    motion = Trajectory(
        position=torch.stack(frames),
        particle_type=state.particle_type,
        frame_dt=state.frame_dt,
        bounds=state.bounds,
    )
    sampled = SampledTrajectory(motion=motion, reference=position, edges=None)
    return Windows([sampled], history=2, future=FRAMES, starts=True)


def search(model, windows, folder, *, config=CONFIG):
    options = {"windows": windows, "connect": unconnected, "seed": 0, "folder": folder}
    return StepperSearch(model, config, **options)


def run(training, steps, *, stop_at=None):
    """Train for some steps, validated by the training motion; optionally interrupted."""
    seen = []

    def report(numbers):
        if numbers["step"] == stop_at:
            raise KeyboardInterrupt

    def validate(model):
        window = training.windows[0]
        state, misses = window.state, []
        with torch.no_grad():
            for frame in range(FRAMES):
                state = model.step(state, unconnected(state))
                misses.append((state.position - window.target[:, frame]).square().sum(dim=1))
        return {"rollout_mse": float(torch.stack(misses).mean()), "static_mse": 1.0}

    train_stepper(
        training,
        Budget(steps=steps),
        validate=validate,
        keep=lambda model: seen.append({k: v.clone() for k, v in model.state_dict().items()}),
        report=report,
    )
    return seen


def test_the_search_finds_the_stiffness_that_made_the_motion(tmp_path):
    """From half the bulk modulus; the other values of water are right from the start."""
    truth, model = stepper(), stepper()
    with torch.no_grad():
        truth.law.log_bulk += math.log(2.0)
    model.searched = lambda types: {"law.log_bulk": model.law.used(types)["log_bulk"]}
    kept = run(search(model, windows_of(truth), tmp_path), 10)
    miss = kept[-1]["law.log_bulk"] - truth.law.log_bulk.detach()
    assert float(miss[WATER].exp()) == pytest.approx(1.0, rel=0.05)


def test_values_that_do_not_matter_stay_and_those_that_do_move(tmp_path):
    """Of water: bulk, exponent and the share of the own velocity; nothing of any other type."""
    model, start = stepper(), stepper().state_dict()
    kept = run(search(model, windows_of(stepper()), tmp_path), 2)[-1]
    moved = {
        name: (kept[name] != value).nonzero().flatten().tolist() for name, value in start.items()
    }
    assert moved.pop("blend_logit") == []  # of a single number: no index
    assert kept["blend_logit"] != start["blend_logit"]
    assert {name: places for name, places in moved.items() if places} == {
        "law.log_bulk": [WATER],
        "law.log_exponent": [WATER],
    }


class Growing(nn.Module):
    """Positions are multiplied each frame by a learned factor; 1 is right."""

    def __init__(self, start, count=1):
        super().__init__()
        self.log_factor = nn.Parameter(torch.full((count,), start))

    def step(self, state, edges, prescribed=None):  # noqa: D102
        position = state.position * self.log_factor.exp().mean()
        history = torch.cat([state.history[:, 1:], position[:, None]], dim=1)
        return replace(state, history=history)


def still_windows():
    """Windows over samples at rest."""
    position = 0.5 + 0.1 * torch.rand(5, 2, generator=torch.Generator().manual_seed(0))
    motion = Trajectory(
        position=position.repeat(FRAMES + 2, 1, 1),
        particle_type=torch.full((5,), WATER),
        frame_dt=2.5e-3,
        bounds=torch.tensor([[0.0, 1.0]] * 2),
    )
    sampled = SampledTrajectory(motion=motion, reference=position, edges=None)
    return Windows([sampled], history=2, future=FRAMES, starts=True)


def test_an_interrupted_search_ends_as_one_never_interrupted(tmp_path):
    """Six generations against four and, from the checkpoint at three, the rest; bit for bit."""
    windows = still_windows()
    whole = search(Growing(0.1, count=5), windows, tmp_path / "whole")
    run(whole, 6)
    with pytest.raises(KeyboardInterrupt):
        run(search(Growing(0.1, count=5), windows, tmp_path / "parts"), 6, stop_at=4)
    parts = search(Growing(0.1, count=5), windows, tmp_path / "parts")
    parts.resume()
    assert parts.run.step == 3
    run(parts, 6)
    assert len(whole.distribution.mean) == 5
    for name, value in whole.distribution.tensors().items():
        assert torch.equal(value, parts.distribution.tensors()[name]), name
    without_clock = [
        [{k: v for k, v in entry.items() if k != "seconds"} for entry in each.run.history]
        for each in (whole, parts)
    ]
    assert without_clock[0] == without_clock[1]
    assert len(without_clock[0]) == 3


def test_a_checkpoint_of_other_values_is_refused(tmp_path):
    """Three values do not go on where five were searched."""
    run(search(Growing(0.1, count=5), still_windows(), tmp_path), 1)
    with pytest.raises(CheckpointError, match="does not fit"):
        search(Growing(0.1, count=3), still_windows(), tmp_path).resume()


@pytest.mark.parametrize("start", [0.15, 60.0])
def test_a_search_survives_candidates_that_diverge(tmp_path, start):
    """Some or, from exp(60) on, all diverge: infinite scores, a finite mean, no exception."""
    training = search(Growing(start), still_windows(), tmp_path)
    first = training.train_step([0], progress=0.0)
    assert math.isinf(first) == (start > 1.0)
    run(training, 12)
    (mean,) = training.distribution.mean
    assert math.isfinite(mean)
    assert (abs(mean) < 0.01) == (start < 1.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, 3.0])
def test_a_lost_sample_raises_and_others_do_not(value):
    """One that is not finite, or further out than the domain is wide."""
    state = still_windows()[0].state

    def lose(state, *arguments):
        history = state.history.clone()
        history[0, -1, 0] = value
        return replace(state, history=history)

    assert watched(lambda state, *_: state)(state, None) is state
    with pytest.raises(FloatingPointError, match="lost"):
        watched(lose)(state, None)


def test_the_distribution_narrows_around_the_minimum():
    """A parabola of axes 1 to 10 in five dimensions: to 1e-3 in 120 generations."""
    distribution = Distribution([1.0] * 5, spread=0.3)
    scale = torch.logspace(0, 1, 5, dtype=torch.float64)
    for generation in range(120):
        drawn = distribution.draw(torch.Generator().manual_seed(generation))
        values = (scale * torch.tensor(drawn, dtype=torch.float64)).square().sum(dim=1)
        distribution.update(drawn, values.tolist())
    assert max(abs(value) for value in distribution.mean) < 1e-3


@pytest.mark.parametrize("count", [0, MOST_VALUES + 1])
def test_networks_and_models_without_values_are_refused_in_one_line(count):
    with pytest.raises(ValueError, match=f"learns {count}. Train it by 'adamax'") as caught:
        searched_entries(Growing(0.0, count=count), still_windows())
    assert "\n" not in str(caught.value)


def test_a_search_compares_whole_motions_alone():
    with pytest.raises(ValueError, match="'cma' compares whole motions: objective must be"):
        TrainingConfig(optimizer="cma")


@pytest.mark.parametrize(
    ("name", "value"),
    [("mean", math.nan), ("covariance", math.nan), ("covariance", -1.0), ("spread", -1.0)],
)
def test_a_damaged_distribution_is_refused(name, value):
    """NaN would search without end; a negative variance is none."""
    distribution = Distribution([1.0, 2.0], spread=0.3)
    tensors = distribution.tensors()
    tensors[name].fill_(value)
    with pytest.raises(ValueError, match=name):
        distribution.load(tensors)


def test_damaged_counters_of_a_run_are_refused():
    """Other types are refused too, here by the checks of the tests before."""
    with pytest.raises(ValueError, match=r"RunState\.step"):
        RunState(step=-5)
