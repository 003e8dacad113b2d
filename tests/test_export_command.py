"""``giorom export`` and ``giorom rollout``: between formats, whole data sets, and refusals."""

import json
import os
import shutil

import numpy as np
import pytest
import torch

from giorom.cli import main
from giorom.commands import rollout
from giorom.data.readers import ForeignTrajectory, Reader
from giorom.data.trajectory_file import (
    SPLITS,
    iterate_trajectories,
    read_trajectory,
    read_trajectory_file,
)
from giorom.data.trajectory_stream import find_stored, stored_trajectories
from giorom.export.dataset import export_dataset
from giorom.export.source import open_source
from giorom.state import KINEMATIC

h5py = pytest.importorskip("h5py")


@pytest.fixture
def out(tmp_path):
    """A folder that must not appear when the input is refused."""
    return tmp_path / "out"


@pytest.fixture
def moving(data_folder, tmp_path):
    """A copy of the data set in which a kinematic particle of the first test trajectory moves."""
    copy = shutil.copytree(data_folder, tmp_path / "moving", ignore=shutil.ignore_patterns("parts"))
    with h5py.File(copy / "test.h5", "r+") as file:
        row = int(np.flatnonzero(file["00000/particle_type"][:] == KINEMATIC)[0])
        position = file["00000/position"][:]
        position[5:, row, 0] += 0.01
        file["00000/position"][:] = position
    return copy


def read_gns(path, split) -> list:
    """What the loader of geoelements/gns makes of a split: pairs of positions and types."""
    with np.load(path / f"{split}.npz", allow_pickle=True) as file:
        data = file["gns_data"] if "gns_data" in file else [file[name] for name in file.files]
        return [(positions, types) for positions, types in data]


def read_lagrangebench(path, split) -> list:
    """What LagrangeBench's loader makes of a split: positions (p, t, d) and types.

    The number of frames is that of the first trajectory, as there.
    """
    with h5py.File(path / f"{split}.h5", "r") as file:
        frames = file["00000/position"].shape[0]
        groups = [file[key] for key in list(file.keys())]
        return [
            (group["position"][0:frames].transpose((1, 0, 2)), group["particle_type"][:])
            for group in groups
        ]


def test_a_stored_trajectory_is_exported_to_every_format(succeed, data_folder, out):
    """Frames, particles and time stand in the result; every file it names exists."""
    count = find_stored(data_folder, split="train", index=1).frame_count
    for name in ("a.h5", "a.npz", "a.vtkhdf", "a.usdc", "a.ply"):
        words = ("export", data_folder, out / name, "--split", "train", "--trajectory", 1)
        result = succeed(*words)
        assert (result["frames"], result["frame_dt"], result["dimension"]) == (count, 5e-3, 3)
        assert [(out / name.removesuffix(".ply")).exists()] == [True]
        assert result["files"] == [str(out / name.removesuffix(".ply"))]
    original = read_trajectory(data_folder, "train", 1)
    copy = read_trajectory_file(out / "a.h5")
    assert torch.equal(copy.position, original.position)
    assert torch.equal(copy.particle_type, original.particle_type)
    assert torch.equal(copy.bounds, original.bounds)
    assert copy.attributes == original.attributes


@pytest.mark.parametrize("stride", [1, 2, 3, 5, 15])
def test_a_stride_takes_every_so_manyth_frame(succeed, data_folder, out, stride, monkeypatch):
    """The same as slicing; the time between frames grows with it; whatever the size of a block."""
    original = read_trajectory(data_folder, "test", 0)
    for block in (1, 10**5, 1 << 20):
        monkeypatch.setattr("giorom.data.trajectory_stream.CHUNK_BYTES", block)
        result = succeed("export", data_folder, out / "a.h5", "--stride", stride)
        copy = read_trajectory_file(out / "a.h5")
        assert torch.equal(copy.position, original.position[::stride])
        assert result["frame_dt"] == copy.frame_dt == pytest.approx(stride * 5e-3)
        assert result["frames"] == len(copy.position)


def test_a_single_file_is_a_source_too(succeed, data_folder, out):
    """One trajectory of ours, and one of several in a split's file."""
    succeed("export", data_folder / "train.h5", out / "a.h5", "--trajectory", 2)
    original = read_trajectory(data_folder, "train", 2)
    assert torch.equal(read_trajectory_file(out / "a.h5").position, original.position)
    succeed("export", out / "a.h5", out / "b.h5")
    assert torch.equal(read_trajectory_file(out / "b.h5").position, original.position)


def test_a_data_set_becomes_one_of_gns(succeed, data_folder, out):
    """Every trajectory as its loader sees it; the metadata has its keys; types stay."""
    result = succeed("export", data_folder, out, "--layout", "gns")
    metadata = json.loads((out / "metadata.json").read_text())
    keys = {"bounds", "sequence_length", "default_connectivity_radius", "dim", "dt"}
    assert keys | {"vel_mean", "vel_std", "acc_mean", "acc_std"} <= set(metadata)
    assert metadata["dt"] == 5e-3
    for split in SPLITS:
        data = read_gns(out, split)
        assert len(data) == result["trajectories"][split] > 0
        for index, (positions, types) in enumerate(data):
            original = read_trajectory(data_folder, split, index)
            np.testing.assert_array_equal(positions, original.position)
            np.testing.assert_array_equal(types, original.particle_type)
            assert metadata["sequence_length"] < len(positions)
    assert result["pickle"] == (len({x.shape for x, _ in read_gns(out, "train")}) > 1)
    assert {str(path) for path in out.iterdir()} == set(result["files"])


def test_a_data_set_becomes_one_of_lagrangebench(succeed, moving, out):
    """Walls at rest are type 1 there and moving ones type 2; nothing else changes."""
    result = succeed("export", moving, out, "--layout", "lagrangebench")
    metadata = json.loads((out / "metadata.json").read_text())
    keys = {"num_particles_max", "periodic_boundary_conditions", "write_every", "dx"}
    assert keys | {"num_trajs_train", "sequence_length_train", "dt", "bounds"} <= set(metadata)
    assert metadata["dt"] * metadata["write_every"] == 5e-3
    largest = 0
    for split in SPLITS:
        data = read_lagrangebench(out, split)
        assert len(data) == result["trajectories"][split] == metadata[f"num_trajs_{split}"]
        for index, (positions, types) in enumerate(data):
            original = read_trajectory(moving, split, index)
            np.testing.assert_array_equal(positions.transpose(1, 0, 2), original.position)
            wall = 2 if (split, index) == ("test", 0) else 1
            expected = torch.where(original.kinematic, wall, original.particle_type)
            np.testing.assert_array_equal(types, expected)
            largest = max(largest, len(types))
    assert metadata["num_particles_max"] == largest


def test_what_lagrangebench_gets_comes_back_with_its_walls(succeed, moving, out):
    """Import undoes the export: walls are kinematic again, although the metadata still name us."""
    succeed("export", moving, out, "--layout", "lagrangebench")
    succeed("import", out, "--out", out.with_name("back"))
    for split in SPLITS:
        found = iterate_trajectories(out.with_name("back"), split)
        for back, original in zip(found, iterate_trajectories(moving, split), strict=True):
            assert torch.equal(back.particle_type, original.particle_type)
            assert torch.equal(back.position, original.position)


def test_lagrangebench_gets_trajectories_of_one_length(moving, out):
    """Its loader reads the length of the first; the others are cut to the shortest."""
    with h5py.File(moving / "train.h5", "r+") as file:
        position = file["00001/position"][:9]
        del file["00001/position"]
        file["00001/position"] = position
    export_dataset(moving, out, layout="lagrangebench")
    assert {x.shape[1] for x, _ in read_lagrangebench(out, "train")} == {9}
    assert json.loads((out / "metadata.json").read_text())["sequence_length_train"] == 9
    assert json.loads((out / "metadata.json").read_text())["sequence_length_test"] > 9


def test_an_interrupted_data_set_leaves_nothing(moving, out):
    def stop():
        raise KeyboardInterrupt

    for layout in ("gns", "lagrangebench"):
        with pytest.raises(KeyboardInterrupt):
            export_dataset(moving, out, layout=layout, report=stop)
        assert not out.exists()
        assert not list(out.parent.glob(".out*"))


def test_a_split_without_trajectories_gets_no_file(moving, out):
    with h5py.File(moving / "valid.h5", "r+") as file:
        for name in list(file):
            del file[name]
    assert stored_trajectories(moving, "valid") == []
    export_dataset(moving, out, layout="gns")
    assert sorted(path.name for path in out.iterdir()) == ["metadata.json", "test.npz", "train.npz"]


@pytest.fixture
def foreign(monkeypatch, tmp_path):
    """A file of a format whose reader says what it is given here."""
    path = tmp_path / "a.foreign"
    path.write_text("foreign")
    frames = np.random.default_rng(0).random((6, 10, 2))

    def install(**known):
        motions = [
            ForeignTrajectory(
                name=f"a.foreign[{index}]",
                particle_type=np.full(10, 5),
                frames=lambda index=index: iter(frames + index),
                **known,
            )
            for index in range(2)
        ]
        reader = Reader(
            name="foreign",
            title="made for this test",
            detect=lambda found: found.suffix == ".foreign",
            read=lambda _: iter(motions),
        )
        monkeypatch.setattr("giorom.data.readers.READERS", (reader,))
        return path, frames

    return install


def test_a_foreign_file_is_exported_through_its_reader(foreign, succeed, out):
    """What it does not say is measured (bounds) or given (time)."""
    path, frames = foreign()
    succeed("export", path, out / "a.h5", "--trajectory", 1, "--frame-dt", 0.1, "--stride", 2)
    copy = read_trajectory_file(out / "a.h5")
    np.testing.assert_allclose(copy.position, frames[::2] + 1, rtol=1e-6)
    assert copy.frame_dt == pytest.approx(0.2)
    low, high = frames.min(axis=(0, 1)) + 1, frames.max(axis=(0, 1)) + 1
    np.testing.assert_allclose(copy.bounds, np.stack([low, high], axis=1), rtol=1e-6)
    path, _ = foreign(frame_dt=0.25, bounds=np.array([[0.0, 3.0], [0.0, 2.0]]), frame_count=6)
    source = open_source(path, split="test", index=0)
    assert (source.header.frame_dt, source.frame_count) == (0.25, 6)
    np.testing.assert_array_equal(source.header.bounds, [[0.0, 3.0], [0.0, 2.0]])


def test_what_a_foreign_file_lacks_is_said(foreign, refuse, out):
    path, _ = foreign()
    assert "--frame-dt" in refuse("export", path, out / "a.h5")
    words = ("export", path, out / "a.h5", "--frame-dt", 1, "--trajectory", 2)
    assert "it holds 2 trajectories" in refuse(*words)
    assert not out.exists()


def test_a_foreign_folder_has_splits_and_a_file_is_one(data_folder, succeed, refuse, out):
    """Exported to GNS and back: the split of a file needs no naming."""
    succeed("export", data_folder, out / "gns", "--layout", "gns")
    for source, options in (
        (out / "gns", ("--split", "train")),
        (out / "gns" / "train.npz", ()),
    ):
        succeed("export", source, out / "a.h5", "--trajectory", 1, *options)
        original = read_trajectory(data_folder, "train", 1)
        copy = read_trajectory_file(out / "a.h5")
        assert torch.equal(copy.position, original.position)
        assert torch.equal(copy.particle_type, original.particle_type)
        assert copy.frame_dt == original.frame_dt
    (out / "gns" / "test.npz").unlink()
    assert "4 train" in refuse("export", out / "gns", out / "b.h5")


def test_a_lagrangebench_folder_comes_back_with_its_walls(moving, succeed, out):
    """Types 1 and 2 there are 3 here."""
    succeed("export", moving, out / "lb", "--layout", "lagrangebench")
    succeed("export", out / "lb", out / "a.h5")
    original, copy = read_trajectory(moving, "test", 0), read_trajectory_file(out / "a.h5")
    assert torch.equal(copy.position, original.position)
    assert torch.equal(copy.particle_type, original.particle_type)
    assert "import" in refuse_layout(out / "lb", out / "b")


def refuse_layout(source, target) -> str:
    """What is said of a foreign data set."""
    with pytest.raises(ValueError, match="foreign data set") as caught:
        export_dataset(source, target, layout="gns")
    return str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--stride", "0"], "stride"),
        (["--stride", "-3"], "stride"),
        (["--stride", "17"], "the first one alone"),
        (["--stride", "1.5"], "--stride"),
        (["--trajectory", "99"], "no trajectory 99"),
        (["--trajectory", "-1"], "no trajectory -1"),
        (["--split", "all"], "--split"),
        (["--frame-dt", "0"], "time between frames"),
        (["--frame-dt", "nan"], "time between frames"),
        (["--layout", "gns"], "named like a file"),
        (["--layout", "openfoam"], "--layout"),
    ],
)
def test_nonsense_options_are_refused(refuse, data_folder, out, options, words):
    assert words in refuse("export", data_folder, out / "a.h5", *options)
    assert not out.exists()


@pytest.mark.parametrize("option", [["--stride", "2"], ["--trajectory", "0"], ["--split", "test"]])
def test_a_whole_data_set_takes_no_option_of_a_motion(refuse, data_folder, out, option):
    """Its statistics are per stored frame."""
    words = refuse("export", data_folder, out, "--layout", "gns", *option)
    assert "whole data set" in words
    assert not out.exists()


def test_places_where_nothing_can_be_written_are_refused(refuse, data_folder, moving, out):
    """The input stays as it is."""
    before = {path: path.stat().st_mtime_ns for path in moving.rglob("*")}
    single = moving / "train.h5"
    part = "is, holds or is part of what is read"
    assert part in refuse("export", moving, single)
    assert part in refuse("export", single, single)
    assert part in refuse("export", single, moving.with_name("moving.ply"))
    assert part in refuse("export", moving, moving, "--layout", "gns")
    assert "holds something" in refuse("export", data_folder, moving, "--layout", "gns")
    assert "names no format" in refuse("export", moving, out)
    assert "names no format" in refuse("export", moving, out / "a.vtk")
    assert "/dev/full is a file" in refuse("export", moving, "/dev/full/a.h5")
    assert before == {path: path.stat().st_mtime_ns for path in moving.rglob("*")}
    assert not out.exists()


def test_a_folder_closed_to_the_user_is_refused(refuse, data_folder, out, monkeypatch):
    """Before the work; nobody may write into it, not even a new folder."""
    monkeypatch.setattr(os, "access", lambda path, mode, **_: path != out.parent)
    for name in ("a.h5", "new/a.ply"):
        assert "does not let you write" in refuse("export", data_folder, out / name)
    words = ("export", data_folder, out, "--layout", "gns")
    assert "does not let you write" in refuse(*words)
    assert not out.exists()


def test_damaged_sources_are_refused(refuse, moving, out, tmp_path):
    assert "does not exist" in refuse("export", tmp_path / "no", out / "a.h5")
    (tmp_path / "junk.h5").write_bytes(b"junk")
    assert "no known format" in refuse("export", tmp_path / "junk.h5", out / "a.h5")
    assert "no known format" in refuse("export", tmp_path, out / "a.h5")
    content = (moving / "test.h5").read_bytes()
    (moving / "test.h5").write_bytes(content[: len(content) // 2])
    assert "damaged" in refuse("export", moving, out / "a.h5")
    with h5py.File(moving / "train.h5", "r+") as file:
        file["00000/position"][3, 0, 0] = np.nan
    refusal = refuse("export", moving, out / "a.npz", "--split", "train")
    assert "frame 3" in refusal
    assert not out.exists() or not list(out.iterdir())


def test_rollout_frames_go_straight_to_the_file(succeed, run_folder, simulator, out, monkeypatch):
    """The writer gets a frame before the next one is simulated; the file is that of rollout()."""
    events = []
    frames = type(simulator).frames

    def watched(*positional, **named):
        for frame in frames(*positional, **named):
            events.append("simulated")
            yield frame

    class Watched:
        def __init__(self, writer):
            self.writer = writer

        def __enter__(self):
            inner = self.writer.__enter__()
            append = inner.append

            def watched_append(position):
                events.append("written")
                append(position)

            inner.append = watched_append
            return inner

        def __exit__(self, *error):
            return self.writer.__exit__(*error)

    opened = rollout.open_writer
    monkeypatch.setattr(type(simulator), "frames", watched)
    monkeypatch.setattr(rollout, "open_writer", lambda *words: Watched(opened(*words)))
    words = ("rollout", run_folder, "--shape", "box", "--frames", 3, "--sparse", 30)
    succeed(*words, "--out", out / "a.h5")
    assert events == ["written", *["simulated", "written"] * 3]
    written = read_trajectory_file(out / "a.h5")
    assert written.attributes == {"system": "tiny", "sparse_points": 30}


def test_a_rollout_that_diverges_leaves_nothing(run_folder, simulator, out, monkeypatch, capsys):
    """Exit code 3, one line, no file."""

    def diverge(self, position, *_, **__):
        yield position
        raise FloatingPointError("the rollout is no longer finite")

    monkeypatch.setattr(type(simulator), "frames", diverge)
    words = ["rollout", str(run_folder), "--shape", "box", "--frames", "3", "--quiet"]
    for name in ("a.h5", "a.vtkhdf", "a.usd", "a.npz", "a.ply"):
        assert main([*words, "--out", str(out / name)]) == 3
        assert "no longer finite" in capsys.readouterr().err
        assert list(out.iterdir()) == []


def test_frames_and_rollout_are_one_motion(simulator):
    """The iterator gives what rollout() keeps."""
    generator = torch.Generator().manual_seed(0)
    position = 0.3 + 0.3 * torch.rand(300, 3, generator=generator)
    velocity, types = torch.zeros_like(position), torch.full((300,), 8)
    kept = simulator.rollout(position, velocity, types, frames=3)
    motion = list(simulator.frames(position, velocity, types, frames=3))
    assert torch.equal(torch.stack([position, *motion]), kept.position)
