"""LagrangeBench, our own and NeuralMPM's HDF5 files, written by h5py."""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.lagrangebench import LAGRANGEBENCH

METADATA = {
    "bounds": [[0.0, 1.0], [0.0, 2.0]],
    "dim": 2,
    "dt": 0.0004,
    "write_every": 100,
    "periodic_boundary_conditions": [True, True, False],
}


def motion(seed: int, shape: tuple[int, ...] = (25, 7, 2)) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def read_all(path: Path) -> None:
    """Every frame of every trajectory."""
    for trajectory in LAGRANGEBENCH.read(path):
        list(trajectory.frames())


def write(path: Path, runs: list[np.ndarray], **options: Any) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for number, positions in enumerate(runs):
            group = file.create_group(f"{number:05d}")
            group.create_dataset("position", data=positions, **options)
            group["particle_type"] = np.full(positions.shape[1], 6, np.int32)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "gzip", "chunks": (10, 7, 2)},
        {"compression": "gzip", "chunks": (1, 3, 1), "shuffle": True},
    ],
)
def test_trajectories_come_back_bit_by_bit(options: dict[str, Any], tmp_path: Path):
    """Whatever the storage; the frame time is the solver's step times the steps per frame."""
    write(tmp_path / "train.h5", [motion(0), motion(1)], **options)
    write(tmp_path / "valid.h5", [motion(2)], **options)
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    assert detect_format(tmp_path) is LAGRANGEBENCH
    found = list(LAGRANGEBENCH.read(tmp_path))
    assert [t.split for t in found] == ["train", "train", "valid"]
    for seed, trajectory in enumerate(found):
        assert np.array_equal(np.stack(list(trajectory.frames())), motion(seed))
        assert trajectory.frame_count == 25
        assert trajectory.frame_dt == pytest.approx(0.04)
        assert np.array_equal(trajectory.bounds, METADATA["bounds"])
        assert np.array_equal(trajectory.particle_type, np.full(7, 6))
        assert any("periodic" in note for note in trajectory.notes)


def test_big_endian_doubles_keep_their_precision(tmp_path: Path):
    """The file's byte order is not ours."""
    positions = np.random.default_rng(0).normal(size=(3, 4, 3)).astype(">f8")
    write(tmp_path / "a.h5", [positions])
    (trajectory,) = LAGRANGEBENCH.read(tmp_path / "a.h5")
    frames = np.stack(list(trajectory.frames()))
    assert frames.dtype == np.float64
    assert np.array_equal(frames, positions)


def test_our_own_attributes_win_over_the_metadata(tmp_path: Path):
    """A data set of ours says frame time and walls of each trajectory."""
    import h5py

    write(tmp_path / "test.h5", [motion(0)])
    with h5py.File(tmp_path / "test.h5", "a") as file:
        file["00000"].attrs["frame_dt"] = 0.25
        file["00000"].attrs["bounds"] = np.array([[-1.0, 1.0], [-2.0, 2.0]])
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    (trajectory,) = LAGRANGEBENCH.read(tmp_path)
    assert trajectory.frame_dt == 0.25
    assert np.array_equal(trajectory.bounds, [[-1.0, 1.0], [-2.0, 2.0]])


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        ([0, 0, 1, 2, 3], [5, 5, 3, 3, 0]),
        ([5, 0, 1, 2, 7], [5, 0, 3, 3, 7]),
        ([5, 6, 7, 8, 3], [5, 6, 7, 8, 3]),
    ],
)
@pytest.mark.parametrize("is_ours", [True, False])
def test_types_of_lagrangebench_become_those_of_gns(
    stored: list[int], expected: list[int], is_ours: bool, tmp_path: Path
):
    """0 fluid, 1 and 2 walls, 3 rigid there; 5 water, 3 kinematic, 0 rigid here."""
    import h5py

    write(tmp_path / "train.h5", [motion(0, (3, 5, 2))])
    with h5py.File(tmp_path / "train.h5", "a") as file:
        file["00000/particle_type"][:] = stored
        if is_ours:
            file.attrs["giorom_format_version"], file.attrs["complete"] = 1, True
    (trajectory,) = LAGRANGEBENCH.read(tmp_path / "train.h5")
    assert trajectory.particle_type.tolist() == (stored if is_ours else expected)
    renumbered = any("renumbered" in note for note in trajectory.notes)
    assert renumbered == (not is_ours and stored != expected)


def test_a_file_of_ours_that_was_not_finished_is_refused(tmp_path: Path):
    """Our writer marks a file complete when it closes it."""
    import h5py

    write(tmp_path / "train.h5", [motion(0)])
    with h5py.File(tmp_path / "train.h5", "a") as file:
        file.attrs["giorom_format_version"] = 1
    with pytest.raises(DataError, match="not written to its end"):
        read_all(tmp_path / "train.h5")


def test_simulations_of_neural_mpm_are_positions_beside_velocities(tmp_path: Path):
    """One file per simulation in a folder per split; boundary particles are kinematic."""
    import h5py

    (tmp_path / "train").mkdir()
    moving, wall = motion(0, (5, 6, 4)), motion(1, (5, 3, 4))
    for number in (10, 9):
        with h5py.File(tmp_path / "train" / f"sim_{number}.h5", "w") as file:
            file["particles"], file["boundary"] = moving + number, wall
            file["gravity"] = np.zeros(2)
    assert detect_format(tmp_path) is LAGRANGEBENCH
    found = list(LAGRANGEBENCH.read(tmp_path))
    assert [t.name for t in found] == ["sim_9.h5", "sim_10.h5"]
    expected = np.concatenate([moving + 9, wall], axis=1)[:, :, :2]
    assert np.array_equal(np.stack(list(found[0].frames())), expected)
    assert np.array_equal(found[0].particle_type, [5] * 6 + [3] * 3)
    assert found[0].split == "train"
    assert any("gravity" in note for note in found[0].notes)


def arrays() -> dict[str, tuple[Any, Any]]:
    """Positions and types of a wrong form."""
    types = np.full(7, 5)
    return {
        "floats": (motion(0).astype(int), types),
        "shape": (motion(0)[0], types),
        "coordinates": (motion(0, (5, 7, 4)), types),
        "empty": (motion(0, (0, 7, 2)), types),
        "type 9": (motion(0), np.full(7, 9)),
        "one integer": (motion(0), np.full(6, 5)),
        "particle types of type": (motion(0), np.full(7, 5.0)),
    }


def hollow(group: Any, path: Path) -> None:
    """Nothing is stored."""
    group.create_dataset("position", shape=(10_000, 1_000_000, 2), dtype="f4", chunks=True)


def vast_block(group: Any, path: Path) -> None:
    """A block of a gigabyte."""
    block = (20_000_000, 7, 2)
    dataset = group.create_dataset(
        "position", shape=(400, 7, 2), maxshape=(None, 7, 2), dtype="f4", chunks=block
    )
    dataset.id.write_direct_chunk((0, 0, 0), bytes(40_000), filter_mask=0)


def link(group: Any, path: Path) -> None:
    """The positions of another file."""
    import h5py

    group["position"] = h5py.ExternalLink("other.h5", "/00000/position")


def outside(group: Any, path: Path) -> None:
    """Bytes of a file that is no HDF5."""
    place = [(str(path.with_suffix(".raw")), 0, 1 << 20)]
    group.create_dataset("position", shape=(5, 7, 2), dtype="f4", external=place)


def attributes(group: Any, path: Path) -> None:
    """Texts where numbers belong."""
    group["position"] = motion(0)
    group.attrs["frame_dt"], group.attrs["bounds"] = "soon", "far"


def endless(group: Any, path: Path) -> None:
    """A frame time that is no number."""
    group["position"] = motion(0)
    group.attrs["frame_dt"], group.attrs["bounds"] = np.nan, np.array([[0, 1], [0, 1]])


STORAGES = {
    "announces": hollow,
    "out of proportion": vast_block,
    "not followed": link,
    "other files": outside,
    "unknown form": attributes,
    "finite": endless,
}


@pytest.mark.parametrize("finding", [*arrays(), *STORAGES])
def test_other_contents_are_refused_in_one_line(finding: str, tmp_path: Path):
    """Wrong shapes and types, empty announcements, links that lead elsewhere."""
    import h5py

    write(tmp_path / "other.h5", [motion(0)])
    path = tmp_path / "train.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("00000")
        if finding in STORAGES:
            group["particle_type"] = np.full(7, 5)
            STORAGES[finding](group, path)
        else:
            group["position"], group["particle_type"] = arrays()[finding]
    with pytest.raises(DataError, match=finding) as refusal:
        list(LAGRANGEBENCH.read(tmp_path / "train.h5"))
    assert "\n" not in str(refusal.value)


def test_what_a_link_names_is_not_opened_to_tell_the_format(tmp_path: Path):
    """A group that lies elsewhere is named in the refusal, whether or not its place exists."""
    import h5py

    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["00000"] = h5py.ExternalLink("absent.h5", "/00000")
    assert LAGRANGEBENCH.detect(tmp_path / "train.h5")
    with pytest.raises(DataError, match="not followed"):
        list(LAGRANGEBENCH.read(tmp_path / "train.h5"))


def test_a_file_that_is_cut_off_is_refused(tmp_path: Path):
    """HDF5 notices at once, or when the block is read."""
    path = tmp_path / "train.h5"
    write(path, [motion(0, (40, 100, 3))], compression="gzip", chunks=(10, 100, 3))
    good = path.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.99):
        path.write_bytes(good[: int(share * len(good))])
        with pytest.raises(DataError):
            read_all(path)


def test_a_damaged_block_is_found_when_it_is_read(tmp_path: Path):
    """The check sum of the filter."""
    path = tmp_path / "train.h5"
    write(path, [motion(0, (40, 100, 3))], chunks=(10, 100, 3), fletcher32=True)
    data = bytearray(path.read_bytes())
    place = data.find(motion(0, (40, 100, 3))[15].tobytes())
    data[place] ^= 1
    path.write_bytes(bytes(data))
    (trajectory,) = LAGRANGEBENCH.read(path)
    with pytest.raises(DataError, match="damaged"):
        list(trajectory.frames())


def test_a_large_file_is_read_within_a_small_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Peak of a few blocks, not of the file (24 MB)."""
    monkeypatch.setattr("giorom.data.readers.lagrangebench.BLOCK_BYTES", 1 << 20)
    write(tmp_path / "train.h5", [np.zeros((200, 10_000, 3), np.float32)], chunks=(1, 10_000, 3))
    tracemalloc.start()
    (trajectory,) = LAGRANGEBENCH.read(tmp_path / "train.h5")
    frames = sum(1 for _ in trajectory.frames())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frames == 200
    assert peak < 6_000_000
