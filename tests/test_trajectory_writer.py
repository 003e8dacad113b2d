"""A file written frame by frame is the file written at once; a failed one does not exist."""

import numpy as np
import pytest
import torch

from giorom.data import trajectory_writer
from giorom.data.statistics import StatisticsAccumulator, measure_statistics
from giorom.data.trajectory_file import DataError, read_trajectory_file, write_trajectory_file
from giorom.data.trajectory_writer import open_trajectory_writer
from giorom.state import SAND, Trajectory

h5py = pytest.importorskip("h5py")


@pytest.fixture
def trajectory() -> Trajectory:
    generator = torch.Generator().manual_seed(0)
    return Trajectory(
        position=torch.rand(23, 40, 3, generator=generator),
        particle_type=torch.full((40,), SAND),
        frame_dt=2.5e-3,
        bounds=torch.tensor([[0.1, 0.9]] * 3),
        attributes={"material": "sand"},
    )


def opened(path, trajectory):
    return open_trajectory_writer(
        path,
        particle_type=trajectory.particle_type.numpy(),
        frame_dt=trajectory.frame_dt,
        bounds=trajectory.bounds.numpy(),
        attributes=trajectory.attributes,
    )


def write(path, trajectory, frames):
    with opened(path, trajectory) as writer:
        for frame in frames:
            writer.append(frame)


@pytest.mark.parametrize("frames_per_block", [1, 5, 23, 1000])
def test_frames_one_by_one_give_the_file_written_at_once(
    tmp_path, trajectory, monkeypatch, frames_per_block
):
    """Also where the last block is full, and where no block is."""
    monkeypatch.setattr(trajectory_writer, "CHUNK_BYTES", frames_per_block * 40 * 3 * 4)
    write_trajectory_file(trajectory, tmp_path / "once.h5")
    write(tmp_path / "frames.h5", trajectory, trajectory.position.double().numpy())
    once, found = (read_trajectory_file(tmp_path / n) for n in ("once.h5", "frames.h5"))
    assert torch.equal(found.position, once.position)
    assert torch.equal(found.particle_type, once.particle_type)
    assert torch.equal(found.bounds, once.bounds)
    assert (found.frame_dt, found.attributes) == (once.frame_dt, once.attributes)


def test_bounds_and_attributes_may_be_completed_while_frames_come(tmp_path, trajectory):
    with opened(tmp_path / "a.h5", trajectory) as writer:
        writer.append(trajectory.position[0].numpy())
        writer.bounds = np.array([[0.0, 2.0]] * 3)
        writer.attributes["seconds"] = 3.5
    found = read_trajectory_file(tmp_path / "a.h5")
    assert found.bounds.tolist() == [[0.0, 2.0]] * 3
    assert found.attributes == {"material": "sand", "seconds": 3.5}


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (np.zeros((39, 3)), "shape .39, 3., but the trajectory has .40, 3."),
        (np.full((40, 3), np.nan), "not a finite float32 number"),
        (np.full((40, 3), 1e39), "not a finite float32 number"),
    ],
)
def test_a_bad_frame_leaves_no_file(tmp_path, trajectory, frame, message):
    """1e39 is finite in float64 and not in float32."""
    first = trajectory.position[0].numpy()
    with pytest.raises(DataError, match=message):
        write(tmp_path / "a.h5", trajectory, [first, frame])
    assert list(tmp_path.iterdir()) == []


def test_a_trajectory_without_frames_leaves_no_file(tmp_path, trajectory):
    with pytest.raises(DataError, match="has no frame"):
        write(tmp_path / "a.h5", trajectory, [])
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_file_leaves_the_earlier_one(tmp_path, trajectory):
    path = tmp_path / "a.h5"
    write_trajectory_file(trajectory, path)
    before = path.read_bytes()

    def frames():
        yield trajectory.position[0].numpy()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, trajectory, frames())
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_statistics_measured_frame_by_frame_and_merged_are_those_of_the_whole(trajectory):
    """Exact merging (Chan, Golub, LeVeque): the cut does not matter."""
    halves = [StatisticsAccumulator(), StatisticsAccumulator()]
    steps = trajectory.position.double().diff(dim=0)
    for number, step in enumerate(steps):
        halves[number % 2].velocity.add(step)
    for number, change in enumerate(steps.diff(dim=0)):
        halves[number % 2].acceleration.add(change)
    total = StatisticsAccumulator()
    for part in (StatisticsAccumulator(), *halves):
        total.merge(part)
    expected = measure_statistics([trajectory])
    found = total.statistics()
    for name in ("velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-15
        )
