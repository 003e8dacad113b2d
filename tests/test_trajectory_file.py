"""A trajectory file is whole or refused, and other people's loaders can open it."""

import json
import math
import os
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from giorom.data.statistics import Statistics
from giorom.data.trajectory_file import (
    DataError,
    iterate_trajectories,
    read_metadata,
    read_trajectory,
    read_trajectory_file,
    trajectory_count,
    write_trajectory_file,
)
from giorom.data.trajectory_stream import find_stored
from giorom.data.trajectory_writer import open_trajectory_writer
from giorom.data.work_folder import (
    assemble_dataset,
    finished_parts,
    open_work_folder,
    split_parts,
    write_part,
)
from giorom.state import KINEMATIC, SAND, Trajectory

h5py = pytest.importorskip("h5py")

IDENTITY = {"preset": "sand2d", "seed": 3, "material": "sand", "parameters": {"density": 1.0e3}}


def make_trajectory(seed: int = 0, *, frames: int = 12, particles: int = 30, dim: int = 2):
    generator = torch.Generator().manual_seed(seed)
    position = 0.2 + 0.6 * torch.rand(frames, particles, dim, generator=generator)
    particle_type = torch.full((particles,), SAND)
    particle_type[:3] = KINEMATIC
    return Trajectory(
        position=position,
        particle_type=particle_type,
        frame_dt=2.5e-3,
        bounds=torch.tensor([[0.1, 0.9]] * dim),
        attributes={"material": "sand", "seed": seed, "shape": {"kind": "box", "size": [0.1, 0.2]}},
    )


def make_dataset(folder: Path, count: int = 6, **options) -> Path:
    open_work_folder(folder, identity=IDENTITY)
    for index in range(count):
        write_part(folder, index, make_trajectory(index, **options))
    assemble_dataset(folder, radius=0.015)
    return folder


def assert_same(left: Trajectory, right: Trajectory) -> None:
    assert torch.equal(left.position, right.position)
    assert torch.equal(left.particle_type, right.particle_type)
    assert torch.equal(left.bounds, right.bounds)
    assert left.frame_dt == right.frame_dt
    assert left.attributes == right.attributes


@pytest.mark.parametrize("dim", [2, 3])
def test_a_trajectory_comes_back_as_it_was_written(tmp_path, dim):
    """Reading is the inverse of writing, exactly, for float32 positions."""
    trajectory = make_trajectory(dim=dim)
    write_trajectory_file(trajectory, tmp_path / "one.h5")
    assert_same(read_trajectory_file(tmp_path / "one.h5"), trajectory)


def test_a_data_set_comes_back_trajectory_by_trajectory(tmp_path):
    """The parts and the assembled splits hold the same motions, each once."""
    folder = make_dataset(tmp_path / "set")
    found = [
        trajectory
        for split in ("train", "valid", "test")
        for trajectory in iterate_trajectories(folder, split)
    ]
    assert sorted(t.attributes["seed"] for t in found) == [0, 1, 2, 3, 4, 5]
    for trajectory in found:
        assert_same(trajectory, make_trajectory(trajectory.attributes["seed"]))


def test_frames_can_be_read_alone(tmp_path):
    """A slice of a trajectory is that slice of the whole."""
    folder = make_dataset(tmp_path / "set")
    part = read_trajectory(folder, "train", 1, frames=slice(4, 9))
    assert torch.equal(part.position, read_trajectory(folder, "train", 1).position[4:9])


def test_the_layout_is_lagrangebenchs(tmp_path):
    """Keys, shapes and types LagrangeBench's H5Dataset and GNS's loaders read."""
    folder = make_dataset(tmp_path / "set", dim=3)
    for split in ("train", "valid", "test"):
        with h5py.File(folder / f"{split}.h5") as file:
            assert list(file) == [f"{i:05d}" for i in range(len(file))]
            position, particle_type = file["00000/position"], file["00000/particle_type"]
            assert (position.dtype, position.shape) == (np.float32, (12, 30, 3))
            assert (position.compression, position.shuffle) == ("gzip", True)
            assert (particle_type.dtype, particle_type.shape) == (np.int32, (30,))
    metadata = json.loads((folder / "metadata.json").read_text())
    assert metadata["bounds"] == [[0.1, 0.9]] * 3
    assert (metadata["dim"], metadata["dt"]) == (3, 2.5e-3)
    assert metadata["sequence_length"] == 11  # GNS: frames minus one
    assert metadata["sequence_length_train"] == metadata["sequence_length_test"] == 12
    assert metadata["default_connectivity_radius"] == 0.015
    assert metadata["num_particles_max"] == 30
    assert metadata["periodic_boundary_conditions"] == [False] * 3
    counts = [metadata[f"num_trajs_{split}"] for split in ("train", "valid", "test")]
    assert counts == [trajectory_count(folder, s) for s in ("train", "valid", "test")]
    assert all(len(metadata[key]) == 3 for key in ("vel_mean", "vel_std", "acc_mean", "acc_std"))
    assert metadata["parameters"] == {"density": 1.0e3}


def test_the_statistics_come_from_the_training_split_alone(tmp_path):
    """Population deviation of the free particles of the training split, by NumPy."""
    folder = make_dataset(tmp_path / "set")
    steps = [
        np.diff(t.position[:, 3:].double().numpy(), axis=0).reshape(-1, 2)
        for t in iterate_trajectories(folder, "train")
    ]
    found = Statistics.from_metadata(read_metadata(folder))
    np.testing.assert_allclose(found.velocity_std, np.concatenate(steps).std(axis=0), rtol=1e-12)


@pytest.mark.parametrize("count", [3, 4, 7, 20, 101])
def test_no_trajectory_is_in_two_splits(count):
    """The splits are a partition; from three on none is empty; shares hold to 1 (few: 1.5)."""
    split = split_parts(range(count))
    assert sorted(part for parts in split.values() for part in parts) == list(range(count))
    assert all(split.values())
    for name, share in (("train", 0.8), ("valid", 0.1), ("test", 0.1)):
        assert abs(len(split[name]) - share * count) <= (1.0 if count > 4 else 1.5)


def test_a_trajectory_keeps_its_split_when_more_are_made():
    """A model trained before the data grew has not seen the larger test split."""
    before, after = split_parts(range(40)), split_parts(range(100))
    assert all(set(before[name]) <= set(after[name]) for name in before)


def test_two_trajectories_are_both_for_training():
    assert split_parts([0, 1]) == {"train": [0, 1], "valid": [], "test": []}


def test_an_empty_split_is_empty_and_not_an_error(tmp_path):
    folder = make_dataset(tmp_path / "set", count=2)
    assert [trajectory_count(folder, s) for s in ("train", "valid", "test")] == [2, 0, 0]
    with pytest.raises(DataError, match=r"has no trajectory 0; it holds 0, .*--split train"):
        read_trajectory(folder, "test", 0)


def test_generation_continues_where_it_stopped(tmp_path, monkeypatch):
    """A part whose writing was interrupted is not among the finished ones and leaves nothing."""
    open_work_folder(tmp_path, identity=IDENTITY)
    write_part(tmp_path, 0, make_trajectory(0))
    with monkeypatch.context() as patch:
        patch.setattr(h5py.Group, "create_dataset", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_part(tmp_path, 1, make_trajectory(1))
    assert finished_parts(tmp_path) == [0]
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["00000.h5"]
    open_work_folder(tmp_path, identity=IDENTITY)
    write_part(tmp_path, 1, make_trajectory(1))
    assert finished_parts(tmp_path) == [0, 1]


def _interrupt(*_args, **_kwargs):
    raise KeyboardInterrupt


def test_a_file_being_written_is_no_part(tmp_path):
    """What a killed process left under its temporary name is passed over."""
    open_work_folder(tmp_path, identity=IDENTITY)
    write_part(tmp_path, 0, make_trajectory(0))
    (tmp_path / "parts" / ".00001.77.tmp.h5").write_bytes(b"\x89HDF")
    assert finished_parts(tmp_path) == [0]


def test_an_interrupted_assembly_leaves_an_unfinished_data_set(tmp_path, monkeypatch):
    folder = make_dataset(tmp_path / "set")
    with monkeypatch.context() as patch:
        patch.setattr("giorom.data.work_folder.measure_statistics", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            assemble_dataset(folder, radius=0.015)
    with pytest.raises(DataError, match="no finished data set"):
        read_trajectory(folder, "train", 0)
    assemble_dataset(folder, radius=0.015, keep_parts=False)
    assert trajectory_count(folder, "train") == 4
    assert not (folder / "parts").exists()


def test_a_file_without_its_last_mark_is_refused(tmp_path):
    write_trajectory_file(make_trajectory(), tmp_path / "one.h5")
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        del file.attrs["complete"]
    with pytest.raises(DataError, match="not written to its end"):
        read_trajectory_file(tmp_path / "one.h5")


@pytest.mark.parametrize("change", [{"seed": 4}, {"preset": "water2d"}])
def test_another_data_set_is_not_written_over(tmp_path, change):
    open_work_folder(tmp_path, identity=IDENTITY)
    with pytest.raises(DataError, match=f"holds another data set: its {next(iter(change))}"):
        open_work_folder(tmp_path, identity={**IDENTITY, **change})


def test_of_another_scene_only_what_differs_is_said(tmp_path):
    """A scene has two dozen fields; the reader wants the one that is not the same."""
    scene = {"material": "water", "solver": {"frames": 3, "cells": 8}, "gravity": 9.81}
    open_work_folder(tmp_path, identity={"scene": scene})
    other = {**scene, "solver": {"frames": 5, "cells": 8}}
    with pytest.raises(DataError) as caught:
        open_work_folder(tmp_path, identity={"scene": other})
    assert "its scene.solver.frames is 3, not 5. Choose" in str(caught.value)
    assert "water" not in str(caught.value)


def test_another_system_is_said_by_its_name_and_not_by_its_scene(tmp_path):
    open_work_folder(tmp_path, identity={"system": "sand2d", "scene": {"gravity": 9.8}})
    with pytest.raises(DataError, match=r"its system is 'sand2d', not 'water2d'\. Choose"):
        open_work_folder(tmp_path, identity={"system": "water2d", "scene": {"gravity": 0.0}})


def test_a_data_set_of_unknown_origin_is_not_written_over(tmp_path):
    (tmp_path / "train.h5").write_bytes(b"precious")
    with pytest.raises(DataError, match=r"train\.h5 of another origin"):
        open_work_folder(tmp_path, identity=IDENTITY)


def test_a_trajectory_may_not_be_in_two_given_splits(tmp_path):
    folder = make_dataset(tmp_path / "set")
    with pytest.raises(DataError, match="trajectory 1 is used twice"):
        assemble_dataset(folder, radius=0.015, splits={"train": [0, 1], "test": [1]})


def test_trajectories_of_different_scenes_do_not_mix(tmp_path):
    open_work_folder(tmp_path, identity=IDENTITY)
    write_part(tmp_path, 0, make_trajectory(0))
    write_part(tmp_path, 1, make_trajectory(1, dim=3))
    with pytest.raises(DataError, match=r"00001\.h5 has bounds="):
        assemble_dataset(tmp_path, radius=0.015)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused(tmp_path, share):
    path = tmp_path / "one.h5"
    write_trajectory_file(make_trajectory(frames=50, particles=500), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(DataError, match=r"one\.h5 is truncated") as caught:
        read_trajectory_file(path)
    assert "\n" not in str(caught.value)


def test_damaged_compressed_data_are_refused(tmp_path):
    """The size is right but a block does not decompress."""
    path = tmp_path / "one.h5"
    write_trajectory_file(make_trajectory(frames=50, particles=500), path)
    with h5py.File(path) as file:
        chunk = file["00000/position"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + 64] = bytes(64)
    path.write_bytes(content)
    with pytest.raises(DataError, match="damaged"):
        read_trajectory_file(path)


def test_foreign_files_are_refused(tmp_path):
    text, other = tmp_path / "text.h5", tmp_path / "other.h5"
    text.write_text("not HDF5")
    with h5py.File(other, "w") as file:
        file["results/pressure"] = np.zeros(3)
    with pytest.raises(DataError, match="no HDF5 file"):
        read_trajectory_file(text)
    with pytest.raises(DataError, match="its entries are results"):
        read_trajectory_file(other)
    with pytest.raises(DataError, match="does not exist"):
        read_trajectory_file(tmp_path / "absent.h5")


def _replace(file, key, value):
    del file[key]
    if value is not None:
        file[key] = value


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("00000/position", None, "has no 'position'"),
        ("00000/position", np.zeros((12, 30, 2)), "is float64 of shape"),
        ("00000/position", np.zeros((12, 60), np.float32), r"shape \(12, 60\)"),
        ("00000/position", np.zeros((0, 30, 2), np.float32), "is empty"),
        ("00000/position", np.full((12, 30, 2), np.nan, np.float32), "not finite"),
        ("00000/particle_type", np.zeros(29, np.int32), "one integer for each of the 30"),
        ("00000/particle_type", np.zeros(30), "is float64"),
    ],
)
def test_wrong_contents_are_refused(tmp_path, key, value, message):
    path = tmp_path / "one.h5"
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        _replace(file, key, value)
    with pytest.raises(DataError, match=message):
        read_trajectory_file(path)


def _metadata_text(**changes):
    known = {"bounds": [[0, 1], [0, 1]], "dim": 2, "dt": 0.1, "sequence_length": 4}
    return json.dumps(known | {"default_connectivity_radius": 0.03} | changes)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frame_dt", [0.1, 0.2], "no numbers"),
        ("frame_dt", "soon", "no numbers"),
        ("frame_dt", np.nan, "frame_dt=nan"),
        ("frame_dt", -1.0, "frame_dt=-1.0"),
        ("bounds", [[0.0, np.inf], [0.0, 1.0]], "must be finite"),
        ("bounds", [[-1e308, 1e308], [0.0, 1.0]], "must be finite in float32"),
        ("bounds", [[0.0j, 1.0], [0.0, 1.0]], "no numbers"),
        ("attributes", 5, "no JSON object"),
        ("attributes", "[" * 20_000, "no JSON object"),
        ("attributes", "[1]", "no JSON object"),
    ],
)
def test_wrong_attributes_are_refused(tmp_path, name, value, message):
    """They are a stranger's numbers as much as the positions are."""
    path = tmp_path / "one.h5"
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        file["00000"].attrs[name] = value
    with pytest.raises(DataError, match=message):
        find_stored(path, split="train", index=0)


@pytest.mark.parametrize("key", ["00000", "00000/position"])
@pytest.mark.parametrize("way", ["external", "soft"])
def test_links_are_not_followed(tmp_path, key, way):
    """A file of ours holds its own numbers; a link would read whatever it names."""
    path, other = tmp_path / "one.h5", tmp_path / "other.h5"
    for name in (path, other):
        write_trajectory_file(make_trajectory(), name)
    with h5py.File(path, "r+") as file:
        file.move(key, "elsewhere")
        file[key] = (
            h5py.SoftLink("/elsewhere") if way == "soft" else h5py.ExternalLink(str(other), key)
        )
        if way == "external":
            del file["elsewhere"]
    with pytest.raises(DataError, match=r"as a link|its entries are"):
        find_stored(path, split="train", index=0)


def test_numbers_in_other_files_are_not_read(tmp_path):
    """HDF5 maps any file as an array (external storage), a stranger's choice of which."""
    path, secret = tmp_path / "one.h5", tmp_path / "secret"
    secret.write_bytes(bytes(4 * 12 * 30 * 2))
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        del file["00000/position"]
        file["00000"].create_dataset(
            "position", (12, 30, 2), np.float32, external=[(str(secret), 0, secret.stat().st_size)]
        )
    with pytest.raises(DataError, match="lies in other files"):
        find_stored(path, split="train", index=0)


def test_a_shape_that_no_file_of_that_size_can_hold_is_refused(tmp_path):
    """Deflate packs 1032 to 1 at most; blocks that were never written cost a file nothing."""
    path, particles = tmp_path / "one.h5", 10**11
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        group, options = file["00000"], {"compression": "gzip"}
        del group["position"], group["particle_type"]
        group.create_dataset("position", (9, particles, 2), "f4", chunks=(1, 99, 2), **options)
        group.create_dataset("particle_type", (particles,), "i4", chunks=(99,), **options)
    with pytest.raises(DataError, match="out of proportion to a file"):
        find_stored(path, split="train", index=0)


def test_a_block_that_no_file_of_that_size_can_hold_is_refused(tmp_path):
    """HDF5 makes room for a whole block, here 800 MB, to read one frame of it."""
    path = tmp_path / "one.h5"
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        shape, block = (12, 30, 2), (3_333_333, 30, 2)
        del file["00000/position"]
        file["00000"].create_dataset(
            "position", shape, "f4", maxshape=(None, 30, 2), chunks=block, compression="gzip"
        )
    with pytest.raises(DataError, match="out of proportion to a file"):
        find_stored(path, split="train", index=0)


def test_a_block_that_unpacks_to_more_than_it_declares_is_not_unpacked(tmp_path):
    """64 MB of zeros in a block of 2,880 bytes: HDF5 itself would make room for all of them."""
    path, bomb = tmp_path / "one.h5", zlib.compress(bytes(1 << 26))
    write_trajectory_file(make_trajectory(), path)
    with h5py.File(path, "r+") as file:
        file["00000/position"].id.write_direct_chunk((0, 0, 0), bomb)
    stored = find_stored(path, split="train", index=0)
    tracemalloc.start()
    with pytest.raises(DataError, match="unpacks to more"):
        next(stored.frames())
    assert tracemalloc.get_traced_memory()[1] < 1 << 22
    tracemalloc.stop()


def test_a_body_at_rest_is_read_however_well_it_packs(tmp_path):
    """Equal frames pack a thousandfold and are sound; the limit is deflate's own."""
    path, frames, count = tmp_path / "still.h5", 3000, 3000
    still, types = np.zeros((count, 2), np.float32), np.full(count, SAND)
    walls = np.array([[0.0, 1.0]] * 2, np.float32)
    with open_trajectory_writer(path, particle_type=types, frame_dt=0.1, bounds=walls) as writer:
        for _ in range(frames):
            writer.append(still)
    assert 500 * path.stat().st_size < frames * still.nbytes
    assert find_stored(path, split="train", index=0).frame_count == frames


@pytest.mark.parametrize("kind", [1, 2])
def test_walls_in_lagrangebenchs_numbering_are_refused(tmp_path, kind):
    """Types 1 and 2 are walls there; read as they stand they would move freely."""
    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["00000/position"] = np.zeros((5, 4, 2), np.float32)
        file["00000/particle_type"] = np.array([0, 0, kind, 0])
    (tmp_path / "metadata.json").write_text(_metadata_text())
    with pytest.raises(DataError, match=r"wall in LagrangeBench's numbering .* 'giorom import'"):
        read_trajectory(tmp_path, "train", 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not readable JSON"),
        ("[]", "must hold a JSON object"),
        ('{"dim": 2}', "lacks bounds, sequence_length"),
        ("[" * 100_000, "not readable JSON"),
        (_metadata_text(format_version="new"), "format version 'new'"),
        (_metadata_text(bounds=1), "dim=2 and bounds=1"),
    ],
)
def test_wrong_metadata_are_refused(tmp_path, content, message):
    folder = make_dataset(tmp_path / "set")
    (folder / "metadata.json").write_text(content)
    with pytest.raises(DataError, match=message):
        read_trajectory(folder, "train", 0)


DEEP = f'{{"dim": {"[" * 100_000}'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounds": 5}, "dim=2 and bounds=5; dim must be 2 or 3, with one"),
        ({"bounds": None}, "bounds=None"),
        ({"bounds": [[0.0, 1.0], [0.0]]}, r"bounds=\[\[0.0, 1.0\], \[0.0\]\]"),
        ({"bounds": [[0.0, 1.0], [0.0, math.nan]]}, "of finite numbers per axis"),
        ({"bounds": [["a", "b"]] * 2}, "of finite numbers per axis"),
        ({"dim": [2]}, r"dim=\[2\]"),
        ({"dt": 0.0}, "dt=0.0; it must be > 0 s"),
        ({"dt": "x"}, "dt='x'; it must be > 0 s"),
        ({"dt": 10**400}, "it must be > 0 s"),
        ({"format_version": "1"}, "format version '1', this program reads up to"),
        ({"format_version": None}, "format version None, this program reads up to"),
    ],
)
def test_metadata_edited_by_hand_are_refused_in_one_line(tmp_path, change, message):
    """No type of JSON value in a key of the format raises anything else."""
    folder = make_dataset(tmp_path / "set")
    known = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps(known | change))
    with pytest.raises(DataError, match=message) as caught:
        read_trajectory(folder, "train", 0)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("content", [DEEP, f'{{"dt": {"9" * 10_000}}}', b"\xff\xfe", "\0" * 99])
def test_metadata_that_break_the_parser_are_refused(tmp_path, content):
    folder = make_dataset(tmp_path / "set")
    text = content if isinstance(content, bytes) else content.encode()
    (folder / "metadata.json").write_bytes(text)
    with pytest.raises(DataError, match="not readable JSON"):
        read_trajectory(folder, "train", 0)


def test_metadata_that_are_a_pipe_or_endless_are_not_opened(tmp_path):
    """Reading a pipe waits for ever, and a sparse file of 1 GiB would be read to its end."""
    folder = make_dataset(tmp_path / "set")
    (folder / "metadata.json").unlink()
    os.mkfifo(folder / "metadata.json")
    with pytest.raises(DataError, match="is no file of at most"):
        read_trajectory(folder, "train", 0)
    (folder / "metadata.json").unlink()
    with (folder / "metadata.json").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(DataError, match="is no file of at most"):
        read_trajectory(folder, "train", 0)


def test_metadata_of_another_dimension_are_refused(tmp_path):
    flat, solid = make_dataset(tmp_path / "2d"), make_dataset(tmp_path / "3d", dim=3)
    (flat / "metadata.json").write_bytes((solid / "metadata.json").read_bytes())
    with pytest.raises(DataError, match=r"is 2-dimensional, but metadata\.json .* dim=3"):
        read_trajectory(flat, "train", 0)


def test_a_lagrangebench_set_without_our_attributes_is_read(tmp_path):
    """Its frame time is dt times write_every, its walls stand in the metadata."""
    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["00000/position"] = np.zeros((5, 4, 2), np.float32)
        file["00000/particle_type"] = np.zeros(4, np.int64)
    metadata = {"bounds": [[0, 1], [0, 2]], "dim": 2, "dt": 4e-4, "write_every": 100}
    metadata |= {"sequence_length": 4, "default_connectivity_radius": 0.03}
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    trajectory = read_trajectory(tmp_path, "train", 0)
    assert trajectory.frame_dt == pytest.approx(0.04)
    assert trajectory.bounds.tolist() == [[0.0, 1.0], [0.0, 2.0]]


def test_attributes_that_are_no_json_are_refused_before_anything_is_written(tmp_path):
    trajectory = make_trajectory()
    trajectory.attributes["model"] = object()
    with pytest.raises(DataError, match="must hold JSON values"):
        write_trajectory_file(trajectory, tmp_path / "one.h5")
    assert list(tmp_path.iterdir()) == []
