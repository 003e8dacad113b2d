"""A training run as a whole: what it refuses, and what it takes from the data."""

import json
import math
import shutil
from dataclasses import replace

import pytest
import torch

from giorom.data.statistics import measure_statistics
from giorom.data.trajectory_file import iterate_trajectories, read_metadata
from giorom.simulator import Simulator
from giorom.state import Trajectory
from giorom.training_data import fit_normalization, load_training_data, padded_bounds


def test_run_is_never_written_over(tiny, data_folder, run_folder, run_training):
    """Without --resume an existing run is safe."""
    with pytest.raises(ValueError, match=r"already holds a training run.*--resume"):
        run_training(tiny, data_folder, run_folder)


@pytest.mark.parametrize("change", ["network", "training", "seed"])
def test_run_of_another_configuration_is_not_resumed(
    tiny, data_folder, run_folder, run_training, change
):
    """Network, training and seed decide what is learnt; each must be the same."""
    experiment, seed = tiny, 0
    if change == "network":
        experiment = replace(tiny, field=replace(tiny.field, kind="local"))
    elif change == "training":
        experiment = replace(tiny, training=replace(tiny.training, learning_rate=2e-3))
    else:
        seed = 1
    with pytest.raises(ValueError, match="another configuration or data set"):
        run_training(experiment, data_folder, run_folder, resume=True, seed=seed)


def test_resuming_nothing_is_refused_and_makes_nothing(tiny, data_folder, run_training, tmp_path):
    """A misspelt folder does not become a run."""
    with pytest.raises(ValueError, match="no training run to resume"):
        run_training(tiny, data_folder, tmp_path / "none", resume=True)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("wrong", [("dim", 2), ("dt", 1e-2)])
def test_data_of_another_dimension_or_frame_time_are_refused(
    tiny, data_folder, run_training, tmp_path, wrong
):
    """The message names the key; no folder is made."""
    (key, value), copy = wrong, tmp_path / "data"
    shutil.copytree(data_folder, copy, ignore=shutil.ignore_patterns("parts"))
    metadata = json.loads((copy / "metadata.json").read_text())
    metadata[key] = value
    if key == "dim":
        metadata["bounds"] = metadata["bounds"][:2]
    (copy / "metadata.json").write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=f"{key}={value}"):
        run_training(tiny, copy, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_data_without_validation_are_refused_before_anything_is_made(
    tiny, data_folder, make_data, run_training, tmp_path
):
    """Two trajectories leave none to hold out; the field is not trained in vain."""
    shutil.copytree(data_folder, tmp_path / "data")
    make_data(tiny, tmp_path / "data", trajectories=2)
    with pytest.raises(ValueError, match="no validation trajectory"):
        run_training(tiny, tmp_path / "data", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("dimension", [2, 3])
def test_padded_bounds_hold_every_position_also_after_turning(dimension):
    """Brute force: a square body turned by every degree and mirrored stays inside."""
    corners = torch.cartesian_prod(*[torch.tensor([0.2, 0.7])] * dimension)
    bounds = torch.tensor([[0.1, 0.9]] * dimension)
    body = Trajectory(
        position=corners.repeat(2, 1, 1),
        particle_type=torch.full((len(corners),), 8),
        frame_dt=0.01,
        bounds=bounds,
    )
    plain = torch.tensor(padded_bounds([body], turned=False))
    torch.testing.assert_close(plain, torch.tensor([[0.15, 0.75]] * dimension))

    low, high = torch.tensor(padded_bounds([body], turned=True)).T
    away = corners - bounds.mean(dim=1)
    for degree in range(360 if dimension == 3 else 1):
        turned = away.clone()
        if dimension == 3:
            cosine, sine = math.cos(math.radians(degree)), math.sin(math.radians(degree))
            turned[:, 0] = cosine * away[:, 0] + sine * away[:, 2]
            turned[:, 2] = cosine * away[:, 2] - sine * away[:, 0]
        for sign in (1.0, -1.0):
            turned[:, 0] *= sign
            position = turned + bounds.mean(dim=1)
            assert bool((position >= low).all())
            assert bool((position <= high).all())


def test_scales_come_from_the_training_split_alone(tiny, data_folder):
    """Reference: the spread of the free training particles, measured here; noise added."""
    steps = [t.position[:, ~t.kinematic] for t in iterate_trajectories(data_folder, "train")]
    dt, noise = tiny.solver.frame_dt, tiny.training.noise_std
    for name, order in (("velocity_std", 1), ("acceleration_std", 2)):
        rows = torch.cat([s.double().diff(n=order, dim=0).flatten(0, 1) for s in steps])
        spread = rows.std(dim=0, correction=0).square().mean().sqrt() / dt**order
        found = getattr(fit_normalization(tiny, read_metadata(data_folder)), name)
        expected = math.hypot(float(spread), noise / dt**order)
        assert found == pytest.approx((expected,) * 3, rel=1e-9)
    every = [t for name in ("train", "valid") for t in iterate_trajectories(data_folder, name)]
    leaked = measure_statistics(every).velocity_std
    own = torch.tensor(read_metadata(data_folder)["vel_std"], dtype=torch.float64)
    assert not torch.allclose(leaked, own, rtol=1e-6)


def test_windows_hold_training_trajectories_alone(tiny, data_folder):
    """Each split is read from its own file; two subsets of each training body, one held out."""
    data = load_training_data(tiny, data_folder)
    train = list(iterate_trajectories(data_folder, "train"))
    valid = list(iterate_trajectories(data_folder, "valid"))
    assert len(data.windows.trajectories) == 2 * len(train)
    assert len(data.validation) == len(valid)
    seeds = {t.motion.attributes["seed"] for t in data.windows.trajectories}
    assert seeds == {t.attributes["seed"] for t in train}
    assert seeds.isdisjoint({t.motion.attributes["seed"] for t in data.validation})


def test_field_without_weights_is_not_trained(tiny, data_folder, run_training, tmp_path):
    """The run has no stage of the field, and the stored simulator recovers all particles."""
    stages = []
    experiment = replace(tiny, field=replace(tiny.field, kind="local"))
    run_training(
        experiment,
        data_folder,
        tmp_path / "run",
        steps=2,
        report=lambda stage, numbers: stages.append(stage),
    )
    assert "time_stepper" in stages
    assert "field" not in stages
    assert not (tmp_path / "run" / "field.safetensors").exists()
    simulator = Simulator.from_pretrained(tmp_path / "run")
    body = next(iterate_trajectories(data_folder, "valid"))
    samples = simulator.sample(body.position[0])
    decode = simulator.decoder(body.position[0], body.kinematic, samples=samples)
    found = decode(body.position[-1, samples])
    still = float((body.position[0] - body.position[-1]).square().sum())
    assert float((found - body.position[-1]).square().sum()) < 0.01 * still
