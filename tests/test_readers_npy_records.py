"""Arrays of records in .npz files: written by NumPy, read without it."""

import zipfile

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format

FIELDS = [("positions", "<f4", (5, 7, 3)), ("particle_type", "<i8", (7,))]


def records(count: int = 3) -> np.ndarray:
    """Trajectories of one shape."""
    generator = np.random.default_rng(0)
    array = np.zeros(count, dtype=FIELDS)
    array["positions"] = generator.random((count, 5, 7, 3))
    array["particle_type"] = generator.integers(0, 9, (count, 7))
    return array


def test_numpy_records_are_read_back(tmp_path):
    """np.savez is the writer."""
    array = records()
    np.savez_compressed(tmp_path / "valid.npz", gns_data=array)
    found = list(detect_format(tmp_path / "valid.npz").read(tmp_path / "valid.npz"))
    assert len(found) == 3
    for motion, record in zip(found, array, strict=True):
        np.testing.assert_array_equal(np.stack(list(motion.frames())), record["positions"])
        np.testing.assert_array_equal(motion.particle_type, record["particle_type"])
        assert (motion.frame_count, motion.split, motion.identity_kept) == (5, "valid", True)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"'shape': (3,)", b"'shape': (4,)"),
        (b"(5, 7, 3)", b"(6, 7, 3)"),
        (b"(5, 7, 3)", b"(0, 0, 0)"),
        (b"(5, 7, 3)", b"(5, 8, 3)"),
        (b"'shape': (3,)", b"'shape': (9,)"),
        (b"'<i8', (7,)", b"'<i8', (0,)"),
        (b"'<f4'", b"'<f8'"),
        (b"'<f4'", b"'|O8'"),
        (b"'positions'", b"'positionz'"),
    ],
)
def test_records_that_are_not_all_there_are_refused(tmp_path, old, new):
    """Each is one line."""
    np.save(tmp_path / "a.npy", records())
    content = (tmp_path / "a.npy").read_bytes()
    assert content.count(old) == 1
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("gns_data.npy", content.replace(old, new))
    with pytest.raises(DataError) as caught:
        list(detect_format(tmp_path / "a.npz").read(tmp_path / "a.npz"))
    assert "\n" not in str(caught.value)


def test_an_empty_array_of_records_is_no_trajectory(tmp_path):
    np.savez(tmp_path / "a.npz", gns_data=records(0))
    with pytest.raises(DataError, match="no trajectory"):
        list(detect_format(tmp_path / "a.npz").read(tmp_path / "a.npz"))
