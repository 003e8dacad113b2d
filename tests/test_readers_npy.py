"""The reader of NumPy's arrays, held to np.save."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.npy_files import NPY

MOTION = np.random.default_rng(0).random((12, 9, 3))


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in NPY.read(path):
        list(trajectory.frames())


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f2", "<i4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_of_frames_is_a_motion(tmp_path, dtype, order):
    """Any byte order, width and memory order; every number comes back."""
    motion = np.asarray(100 * MOTION, dtype=dtype, order=order)
    np.save(tmp_path / "a.npy", motion)
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    for _ in range(2):
        np.testing.assert_array_equal(list(trajectory.frames()), motion)
    assert trajectory.frame_count == 12


def test_arrays_of_one_frame_are_the_frames_of_a_motion(tmp_path):
    """In natural order; frame 2 before frame 10."""
    for frame, position in enumerate(MOTION):
        np.save(tmp_path / f"x{frame}.npy", position[:, :2])
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    np.testing.assert_array_equal(list(trajectory.frames()), MOTION[..., :2])


def test_each_array_of_frames_is_a_motion_of_its_own(tmp_path):
    """Two files in a folder that says which part they are."""
    (tmp_path / "valid").mkdir()
    np.save(tmp_path / "valid" / "10.npy", MOTION)
    np.save(tmp_path / "valid" / "9.npy", MOTION[:2, :5])
    found = [(t.name, t.split, t.frame_count) for t in NPY.read(tmp_path)]
    assert found == [("9.npy", "valid", 2), ("10.npy", "valid", 12)]


def test_a_motion_in_the_plane_is_two_dimensional(tmp_path):
    """A z of 0 throughout is dropped and said; a later other z is refused."""
    flat = MOTION * [1, 1, 0]
    np.save(tmp_path / "a.npy", flat)
    (trajectory,) = NPY.read(tmp_path)
    np.testing.assert_array_equal(list(trajectory.frames()), MOTION[..., :2])
    assert "2-D" in trajectory.notes[0]
    flat[5, 3, 2] = 0.1
    np.save(tmp_path / "a.npy", flat)
    with pytest.raises(DataError, match=r"a.npy\[5\] has points off the plane"):
        _read_all(tmp_path)


def test_a_large_array_is_read_frame_by_frame(tmp_path):
    """Forty frames of 1.2 MB; the peak stays below that of four."""
    np.save(tmp_path / "a.npy", np.ones((40, 50_000, 3)))
    (trajectory,) = NPY.read(tmp_path)
    tracemalloc.start()
    assert sum(len(frame) for frame in trajectory.frames()) == 40 * 50_000
    assert tracemalloc.get_traced_memory()[1] < 4 * 1_200_000
    tracemalloc.stop()


def _header(text: str) -> bytes:
    """The beginning of a .npy file with a header of this text."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


ABSURD = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }\n"
CODE = "__import__('os').abort()"

DAMAGED = {
    "empty": (b"", "no .npy"),
    "absurd": (_header(ABSURD), "but 0 are there"),
    "code": (_header(CODE), "header"),
    "cut": (_header(ABSURD.replace("1000000000000", "4")) + bytes(90), "96 bytes"),
    "shape": (_header(ABSURD.replace("1000000000000, 3", "4,")) + bytes(32), "must be"),
    "objects": (_header(ABSURD.replace("<f8", "|O")) + bytes(32), "plain numbers"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_array_is_refused_in_one_line(tmp_path, case):
    """Each is broken in one way; the message names it."""
    content, word = DAMAGED[case]
    (tmp_path / "a.npy").write_bytes(content)
    assert not NPY.detect(tmp_path)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_motions_and_frames_are_not_mixed(tmp_path):
    """Whichever comes first says what the folder holds."""
    np.save(tmp_path / "1.npy", MOTION)
    np.save(tmp_path / "2.npy", MOTION[0])
    with pytest.raises(DataError, match="holds one frame"):
        _read_all(tmp_path)
    np.save(tmp_path / "0.npy", MOTION[0])
    with pytest.raises(DataError, match="holds several frames"):
        _read_all(tmp_path)
