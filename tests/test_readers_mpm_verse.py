"""The official data sets, written by PyTorch and pickle in the published layout."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.mpm_verse import MPM_VERSE

WINDOW = 6


def run(seed: int, *, frames: int, particles: int, dimension: int = 3) -> np.ndarray:
    """A trajectory (frames, particles, axes) of a drifting cloud."""
    generator = np.random.default_rng(seed)
    steps = generator.normal(scale=1e-3, size=(frames, particles, dimension))
    return (generator.uniform(size=(particles, dimension)) + np.cumsum(steps, 0)).astype(np.float32)


def read_all(path: Path) -> None:
    """Every frame of every trajectory."""
    for trajectory in MPM_VERSE.read(path):
        list(trajectory.frames())


def windows_of(runs: list[np.ndarray]) -> dict[str, list[np.ndarray]]:
    """The parallel lists of train and test files, windows trajectory by trajectory."""
    lists: dict[str, list[np.ndarray]] = {
        key: [] for key in ("particle_type", "position", "n_particles_per_example", "output")
    }
    for positions in runs:
        count = positions.shape[1]
        particle_first = positions.transpose(1, 0, 2)
        for start in range(len(positions) - WINDOW):
            lists["particle_type"].append(np.full(count, 5, np.int32))
            lists["position"].append(particle_first[:, start : start + WINDOW])
            lists["n_particles_per_example"].append(np.array([count], np.int32))
            lists["output"].append(particle_first[:, start + WINDOW])
    return lists


def rollouts_of(runs: list[np.ndarray], outputs: list[np.ndarray]) -> dict[str, list[np.ndarray]]:
    return {
        "particle_type": [np.full(positions.shape[1], 6) for positions in runs],
        "position": [np.ascontiguousarray(positions.transpose(1, 0, 2)) for positions in runs],
        "n_particles_per_example": [np.array([positions.shape[1]]) for positions in runs],
        "output": outputs,
    }


def dump(value: Any, path: Path) -> None:
    with path.open("wb") as file:
        pickle.dump(value, file)


def save_old(value: Any, path: Path) -> None:
    torch.save(value, path, _use_new_zipfile_serialization=False)


WRITERS: list[tuple[str, Callable[[Any, Path], None]]] = [
    ("train.pt", torch.save),
    ("train.obj", dump),
    ("train.pt", save_old),
]


@pytest.mark.parametrize(("name", "write"), WRITERS)
def test_windows_are_put_together_to_the_trajectories_they_were_cut_from(
    name: str, write: Callable[[Any, Path], None], tmp_path: Path
):
    """The inverse of cutting; copies with other particles and equal counts stay apart."""
    whole = run(0, frames=9, particles=30)
    runs = [
        whole[:, ::2],
        whole[:, 1::2],
        run(1, frames=9, particles=11),
        run(2, frames=7, particles=4),
    ]
    write(windows_of(runs), tmp_path / name)
    assert detect_format(tmp_path) is MPM_VERSE
    assert detect_format(tmp_path / name) is MPM_VERSE
    trajectories = list(MPM_VERSE.read(tmp_path / name))
    for trajectory, positions in zip(trajectories, runs, strict=True):
        assert np.array_equal(np.stack(list(trajectory.frames())), positions)
        assert trajectory.frame_count == len(positions)
        assert trajectory.split == "train"
        assert np.array_equal(trajectory.particle_type, np.full(positions.shape[1], 5))


def test_an_output_that_contradicts_the_windows_is_left_out(tmp_path: Path):
    """The next window knows better; the last frame of the trajectory is then unknown."""
    positions = run(0, frames=12, particles=5)
    lists = windows_of([positions])
    lists["output"] = [output + 1 for output in lists["output"]]
    torch.save(lists, tmp_path / "test.pt")
    (trajectory,) = MPM_VERSE.read(tmp_path / "test.pt")
    assert np.array_equal(np.stack(list(trajectory.frames())), positions[:-1])
    assert trajectory.frame_count == 11
    assert trajectory.split == "test"
    assert any("contradicts" in note for note in trajectory.notes)


def test_rollouts_are_turned_to_frames_first(tmp_path: Path):
    """A missing last frame is taken from the output; the path of particle 6 is not."""
    short, long = run(0, frames=9, particles=20), run(1, frames=15, particles=15)
    outputs = [short[-1], long[:, WINDOW]]
    torch.save(rollouts_of([short[:-1], long], outputs), tmp_path / "rollout.pt")
    torch.save(rollouts_of([long], [long[:, WINDOW]]), tmp_path / "rollout_full.pt")
    found = list(MPM_VERSE.read(tmp_path))
    for trajectory, positions in zip(found, [short, long, long], strict=True):
        assert np.array_equal(np.stack(list(trajectory.frames())), positions)
        assert trajectory.split == "test"
        assert any("row i" in note for note in trajectory.notes)
    assert next(MPM_VERSE.read(tmp_path / "rollout.pt")).split is None


@pytest.mark.parametrize(("dimension", "trusted"), [(2, True), (3, False)])
def test_the_frame_time_of_three_dimensional_sets_is_not_taken(
    dimension: int, trusted: bool, tmp_path: Path
):
    """0.025 s is a constant of the official converter."""
    runs = [run(0, frames=8, particles=5, dimension=dimension)]
    torch.save(windows_of(runs), tmp_path / "train.pt")
    metadata = {"bounds": [[0, 1]] * dimension, "dt": 0.025, "dim": dimension}
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    (trajectory,) = MPM_VERSE.read(tmp_path)
    assert trajectory.frame_dt == (0.025 if trusted else None)
    assert trajectory.bounds.shape == (dimension, 2)
    assert any("0.025" in note for note in trajectory.notes) is not trusted


def damaged() -> dict[str, Any]:
    good = windows_of([run(0, frames=9, particles=5)])
    ragged = windows_of([run(0, frames=9, particles=5)])
    ragged["position"][1] = ragged["position"][1][:, :5]
    types = {**good, "particle_type": [np.full(4, 5)] * 3}
    same = [good["position"][0]] * 800
    return {
        "no list": {"position": good["position"][0]},
        "no list 'position'": [1, 2],
        "must be floats": {"position": [np.zeros((3, 6), np.float32)]},
        "must be floats (particles": {"position": [np.zeros((3, 6, 3), int)]},
        "others 6": ragged,
        "one for each": types,
        "coordinates": {"position": [np.zeros((3, 6, 5))]},
        "at least one": {"position": [np.zeros((3, 0, 3))]},
        "again and again": {"position": same},
    }


@pytest.mark.parametrize("finding", [*damaged()])
def test_other_contents_are_refused_in_one_line(finding: str, tmp_path: Path):
    """Wrong shapes, types and lists; the message says what was found."""
    torch.save(damaged()[finding], tmp_path / "train.pt")
    with pytest.raises(DataError) as refusal:
        read_all(tmp_path / "train.pt")
    assert finding in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("is_zip", [True, False])
def test_a_file_that_is_cut_off_is_refused(is_zip: bool, tmp_path: Path):
    """Anywhere, in either layout of PyTorch."""
    path = tmp_path / "train.pt"
    lists = windows_of([run(0, frames=9, particles=5)])
    lists["output"] = [torch.from_numpy(output.copy()) for output in lists["output"]]
    torch.save(lists, path, _use_new_zipfile_serialization=is_zip)
    good = path.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(good[: int(share * len(good))])
        with pytest.raises(DataError):
            read_all(path)


def test_a_mesh_is_no_data_set(tmp_path: Path):
    """Wavefront files have the same ending."""
    (tmp_path / "train.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert not MPM_VERSE.detect(tmp_path / "train.obj")
