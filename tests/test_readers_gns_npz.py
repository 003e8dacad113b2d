"""geoelements/gns .npz files, written by NumPy itself."""

import json
import os
import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.gns_npz import GNS_NPZ
from giorom.data.readers.zip_archive import ZipArchive


def motion(seed: int, shape: tuple[int, ...] = (5, 7, 2)) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def pair(*parts: Any) -> np.ndarray:
    """An array of objects, as NumPy makes of a ragged tuple."""
    objects = np.empty(len(parts), dtype=object)
    for place, part in enumerate(parts):
        objects[place] = part
    return objects


def read(path: Path) -> list[tuple[Any, np.ndarray]]:
    return [(t, np.stack(list(t.frames()))) for t in GNS_NPZ.read(path)]


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_trajectories_come_back_bit_by_bit(save: Any, tmp_path: Path):
    """One type for all, one per particle, a material property, ten and more trajectories."""
    types = np.array([3, 5, 6, 5, 5, 0, 7])
    members = {
        "simulation_0": pair(motion(0).astype(np.float32), 6),
        "simulation_1": pair(motion(1), types),
        "simulation_2": pair(motion(2), types.astype(np.int32), 0.3),
        "simulation_10": pair(np.asfortranarray(motion(3)), np.int64(5)),
        "simulation_9": pair(motion(4).astype(">f4"), types.astype(">i8")),
    }
    save(tmp_path / "train.npz", **members)
    (tmp_path / "metadata.json").write_text(
        json.dumps({"train": {"bounds": [[0, 1], [0, 1]], "dt": 0.005, "dim": 2}})
    )
    assert detect_format(tmp_path) is GNS_NPZ
    found = read(tmp_path)
    assert [t.name for t, _ in found] == [
        f"train.npz[simulation_{number}]" for number in (0, 1, 2, 9, 10)
    ]
    expected = [members[f"simulation_{number}"][0] for number in (0, 1, 2, 9, 10)]
    for (trajectory, positions), source in zip(found, expected, strict=True):
        assert np.array_equal(positions, source)
        assert positions.dtype == source.dtype.newbyteorder("=")
        assert trajectory.frame_count == 5
        assert trajectory.split == "train"
        assert trajectory.frame_dt == 0.005
    assert np.array_equal(found[0][0].particle_type, np.full(7, 6))
    assert np.array_equal(found[1][0].particle_type, types)
    assert np.array_equal(found[3][0].particle_type, types)
    assert any("material" in note for note in found[2][0].notes)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("is_table", [True, False])
def test_the_older_layout_with_one_array_is_read(save: Any, is_table: bool, tmp_path: Path):
    """``gns_data`` holds pairs, as rows of a table or as tuples."""
    pairs = [(motion(seed, (4, 70 + seed, 3)), np.full(70 + seed, 6)) for seed in range(6)]
    data = np.empty((6, 2) if is_table else 6, dtype=object)
    for number, (positions, types) in enumerate(pairs):
        if is_table:
            data[number, 0], data[number, 1] = positions, types
        else:
            data[number] = (positions, types)
    save(tmp_path / "old.npz", gns_data=data)
    found = read(tmp_path / "old.npz")
    for (trajectory, positions), (source, types) in zip(found, pairs, strict=True):
        assert np.array_equal(positions, source)
        assert np.array_equal(trajectory.particle_type, types)


def test_plain_arrays_are_trajectories(tmp_path: Path):
    """Any array of three axes, with types beside it or without."""
    np.savez(tmp_path / "a.npz", position=motion(0), particle_type=np.full(7, 3), other=np.ones(4))
    np.savez(tmp_path / "b.npz", run=motion(1))
    ((first, positions),) = read(tmp_path / "a.npz")
    assert np.array_equal(positions, motion(0))
    assert np.array_equal(first.particle_type, np.full(7, 3))
    ((second, positions),) = read(tmp_path / "b.npz")
    assert np.array_equal(positions, motion(1))
    assert np.array_equal(second.particle_type, np.full(7, 5))
    assert any("No particle types" in note for note in second.notes)


class Reducing:
    """An object whose pickle calls something."""

    def __reduce__(self) -> Any:
        """What the unpickler is told to call."""
        return os.system, ("true",)


def member(header: bytes, content: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def plain(descr: str, shape: str, content: bytes) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"
    return member(header.encode(), content)


def damaged() -> dict[str, dict[str, bytes]]:
    objects = "'|O'", "(2,)"
    same = motion(0, (4, 30, 2))
    repeated = np.empty(9, dtype=object)
    for place in range(9):
        repeated[place] = (same, 5)
    short = np.zeros((2, 2, 2), np.float32).tobytes()
    return {
        "os.system|posix.system": {"simulation_0": plain(*objects, pickle.dumps(Reducing()))},
        "no array of objects": {"simulation_0": plain(*objects, pickle.dumps([1, 2]))},
        "no pair": {"simulation_0": plain(*objects, pickle.dumps(pair("a", "b"), 4))},
        "type": {"simulation_0": plain(*objects, pickle.dumps(pair(motion(0), 12), 4))},
        "no integers": {"simulation_0": plain(*objects, pickle.dumps(pair(motion(0), "x"), 4))},
        "one for each": {
            "simulation_0": plain(*objects, pickle.dumps(pair(motion(0), np.full(6, 5)), 4))
        },
        "again and again": {"gns_data": plain(*objects, pickle.dumps(repeated, 4))},
        "axes|shape": {"simulation_0": plain(*objects, pickle.dumps(pair(motion(0)[0], 5), 4))},
        "floating": {
            "simulation_0": plain(*objects, pickle.dumps(pair(motion(0).astype(int), 5), 4))
        },
        "coordinates": {"a": plain("'<f4'", "(2, 2, 4)", bytes(64))},
        "at least one": {"a": plain("'<f4'", "(0, 2, 2)", b"")},
        "bytes, but": {"a": plain("'<f4'", "(2, 2, 3)", short)},
        "absurd": {"a": plain("'<f4'", "(99999999999999999999, 2, 3)", short)},
        "header": {"a": plain("[('x', '<f4')]", "(2, 2, 2)", short)},
        "plain numbers": {"a": plain("'<c8'", "(2, 2, 2)", bytes(64))},
        "known version": {"a": b"\x93NUMPY\x09\x00" + short},
        "announces": {"a": b"\x93NUMPY\x02\x00" + b"\xff" * 4 + short},
        "no trajectory": {"a": plain("'<f4'", "(8,)", short)},
        "no trajectory: none of no": {},
    }


@pytest.mark.parametrize("finding", [*damaged()])
def test_damaged_members_are_refused_in_one_line(finding: str, tmp_path: Path):
    """Each kind of damage by hand; the message says what was found."""
    path = tmp_path / "train.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in damaged()[finding].items():
            archive.writestr(f"{name}.npy", content)
    with pytest.raises(DataError, match=finding) as refusal:
        read(path)
    assert "\n" not in str(refusal.value)


def test_damaged_archives_are_refused(tmp_path: Path):
    """Cut anywhere, or with a byte changed where it matters."""
    path = tmp_path / "train.npz"
    np.savez_compressed(path, simulation_0=pair(motion(0, (20, 30, 2)), 5))
    good = path.read_bytes()
    for cut in (0, 3, 40, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:cut])
        with pytest.raises(DataError):
            read(path)
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 0x10
    path.write_bytes(bytes(flipped))
    with pytest.raises(DataError):
        read(path)


def test_a_name_that_would_break_the_line_is_refused(tmp_path: Path):
    """Names come from the file, too; found by fuzzing."""
    path = tmp_path / "train.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("simulation\n_0.npy", b"")
    with pytest.raises(DataError, match="name") as refusal:
        read(path)
    assert "\n" not in str(refusal.value)


def test_a_stored_member_is_compared_with_its_check_sum(tmp_path: Path):
    """A changed number in an archive without compression is found."""
    path = tmp_path / "train.npz"
    np.savez(path, simulation_0=motion(0))
    data = bytearray(path.read_bytes())
    place = data.find(motion(0)[2].tobytes())
    data[place] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match="check sum"):
        read(path)


def test_zip_bombs_are_refused_before_they_are_unpacked(tmp_path: Path):
    """Ratios, sizes and directories that no data file has; nothing is allocated for them."""
    path = tmp_path / "train.npz"
    content = plain("'<f4'", "(1000, 5000, 2)", bytes(40_000_000))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("simulation_0.npy", content)
    del content
    tracemalloc.start()
    with pytest.raises(DataError, match="bomb"):
        read(path)
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()
    data = bytearray(path.read_bytes())
    end = data.rfind(b"PK\x05\x06")
    data[end + 12 : end + 16] = struct.pack("<I", 0x7FFFFFFF)
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match="directory"):
        read(path)


@pytest.mark.parametrize("record", [b"PK\x06\x06", b"none"])
def test_the_directory_that_is_limited_is_the_one_that_is_read(record: bytes, tmp_path: Path):
    """Of two records zipfile believes the wide one, whatever the short one says."""
    path = tmp_path / "train.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", plain("'<f4'", "(2, 2, 2)", bytes(32)))
    data = path.read_bytes()
    end = data.rfind(b"PK\x05\x06")
    wide = record + struct.pack("<QHHIIQQQQ", 44, 45, 45, 0, 0, 1, 1, 1 << 40, 0)
    locator = b"PK\x06\x07" + struct.pack("<IQI", 0, end, 1)
    path.write_bytes(data[:end] + wide + locator + data[end:])
    with pytest.raises(DataError, match=r"announces a directory|without its directory"):
        ZipArchive(path)


def test_a_wide_directory_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An archive of more than 65535 members, as zipfile writes it, has the wide record."""
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 0)
    path = tmp_path / "train.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"x")
    assert b"PK\x06\x06" in path.read_bytes()
    assert list(ZipArchive(path).members) == ["a.npy"]


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused(method: int, tmp_path: Path):
    """NumPy writes stored and deflated members only."""
    path = tmp_path / "train.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("a.npy", plain("'<f4'", "(2, 2, 2)", bytes(32)))
    with pytest.raises(DataError, match="packed by method"):
        read(path)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a_large_member_is_read_within_a_small_memory(save: Any, tmp_path: Path):
    """Peak of a frame, not of the file (24 MB); the array of objects is a pickle inside."""
    block = np.random.default_rng(0).normal(size=(50, 1_000, 3)).astype(np.float32)
    save(tmp_path / "train.npz", simulation_0=pair(np.tile(block, (1, 40, 1)), 5))
    tracemalloc.start()
    frames = 0
    for trajectory in GNS_NPZ.read(tmp_path):
        frames += sum(1 for _ in trajectory.frames())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frames == 50
    assert peak < 8_000_000
