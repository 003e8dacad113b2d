"""The reader of CROM's sequences, held to files that h5py wrote in the published layout."""

import zlib
from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.crom import CROM

REST = np.random.default_rng(0).random((60, 3)) * [1.0, 0.2, 0.1]


def _motion(frames: int) -> np.ndarray:
    """A body that bends, starting at rest."""
    angle = np.linspace(0.0, 0.5, frames)[:, None] * REST[:, 0]
    return np.stack([REST + a[:, None] * [[0.0, 1.0, 0.3]] for a in angle])


def _write(path: Path, state: np.ndarray, *, rest: np.ndarray = REST, **more) -> None:
    """One file with x and q as (3, N), as CROM's programs lay it out."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["x"], file["q"] = rest.T, state.T
        for name, value in more.items():
            file[name] = value


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in CROM.read(path):
        list(trajectory.frames())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_q_may_be_the_displacement_or_the_position(tmp_path, dtype):
    """Displacements and the positions themselves are one motion, told apart by the first frame."""
    motion = _motion(12).astype(dtype)
    rest = REST.astype(dtype)
    for frame, position in enumerate(motion):
        name = f"h5_f_{frame:010d}.h5"
        _write(tmp_path / "sim_seq_u" / name, position - rest, rest=rest)
        _write(tmp_path / "sim_seq_x" / name, position, rest=rest, time=[[frame * 0.01]])
    displaced, placed = detect_format(tmp_path).read(tmp_path)
    assert (displaced.name, placed.name) == ("sim_seq_u", "sim_seq_x")
    assert "displacement" in displaced.notes[0]
    assert "current position" in placed.notes[0]
    np.testing.assert_array_equal(list(placed.frames()), motion)
    step = np.finfo(dtype).eps
    np.testing.assert_allclose(list(displaced.frames()), motion, atol=2 * step)
    assert (displaced.frame_count, displaced.frame_dt, displaced.identity_kept) == (12, None, True)
    assert placed.frame_dt == pytest.approx(0.01)
    assert displaced.particle_type.tolist() == [5] * 60


def test_a_single_sequence_and_one_point_per_row_are_read(tmp_path):
    """The folder itself, with (N, 3) arrays, packed by h5py's filters."""
    import h5py

    motion = _motion(3)
    filters = ({"compression": "gzip", "shuffle": True, "fletcher32": True},
               {"compression": "lzf"}, {"chunks": (7, 2), "compression": "gzip"})  # fmt: skip
    for frame, position in enumerate(motion):
        with h5py.File(tmp_path / f"h5_f_{frame:010d}.h5", "w") as file:
            file.create_dataset("x", data=REST, **filters[frame])
            file.create_dataset("q", data=position, **filters[frame])
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    np.testing.assert_array_equal(list(trajectory.frames()), motion)


def test_a_guess_without_a_small_candidate_is_called_unsure(tmp_path):
    """A first frame far from the reference."""
    _write(tmp_path / "h5_f_0000000000.h5", REST * 0.5)
    (trajectory,) = CROM.read(tmp_path)
    assert "Neither is small" in trajectory.notes[0]
    assert "Neither" not in next(CROM.read(_single(tmp_path / "b", REST * 1.01))).notes[0]


def _single(folder: Path, state: np.ndarray) -> Path:
    """A sequence of one file."""
    _write(folder / "h5_f_0000000000.h5", state)
    return folder


def test_other_reference_positions_are_refused(tmp_path):
    """Rows that are permuted from frame to frame would tear the body."""
    _write(tmp_path / "h5_f_0000000000.h5", REST)
    _write(tmp_path / "h5_f_0000000001.h5", REST, rest=REST[::-1])
    with pytest.raises(DataError, match="other reference positions"):
        _read_all(tmp_path)


def _external_link(file, folder):
    import h5py

    file["q"] = h5py.ExternalLink("other.h5", "/q")


def _soft_link(file, folder):
    import h5py

    file["q"] = h5py.SoftLink("/x")


def _external_storage(file, folder):
    (folder / "secret").write_bytes(bytes(8 * 180))
    file.create_dataset("q", (3, 60), "f8", external=[(str(folder / "secret"), 0, 8 * 180)])


def _virtual(file, folder):
    import h5py

    layout = h5py.VirtualLayout((3, 60), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "q", (3, 60))
    file.create_virtual_dataset("q", layout)


def _unknown_filter(file, folder):
    import h5py

    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((3, 60))
    plan.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, (3,))
    space = h5py.h5s.create_simple((3, 60))
    h5py.h5d.create(file.id, b"q", h5py.h5t.IEEE_F64LE, space, plan)


def _absurd(file, folder):
    file.create_dataset("q", (3, 10**12), "f8", chunks=(3, 1000))


def _absurd_block(file, folder):
    file.create_dataset("q", (3, 60), "f8", maxshape=(None, None), chunks=(3, 10**8))


def _bomb(file, folder):
    data = file.create_dataset("q", (3, 60), "f8", chunks=(3, 60), compression="gzip")
    data.id.write_direct_chunk((0, 0), zlib.compress(bytes(1 << 26), 9))


def _short_block(file, folder):
    data = file.create_dataset("q", (3, 60), "f8", chunks=(3, 60), compression="gzip")
    data.id.write_direct_chunk((0, 0), zlib.compress(bytes(100)))


def _garbage_block(file, folder):
    data = file.create_dataset("q", (3, 60), "f8", chunks=(3, 60), compression="gzip")
    data.id.write_direct_chunk((0, 0), b"nonsense")


def _array(values):
    """Builds a file whose q is the given array."""
    return lambda file, folder: file.create_dataset("q", data=values)


HOSTILE = {
    "missing": (lambda file, folder: None, "has no 'q'"),
    "text": (_array("hello"), "no array of numbers"),
    "group": (lambda file, folder: file.create_group("q"), "no array of numbers"),
    "reduced": (_array(np.zeros((5, 7))), "decode them"),
    "other count": (_array(np.zeros((3, 9))), "q for 9"),
    "one axis": (_array(np.zeros(180)), "2 axes"),
    "empty": (_array(np.zeros((3, 0))), "not be empty"),
    "external link": (_external_link, "link to another"),
    "soft link": (_soft_link, "link to another"),
    "external storage": (_external_storage, "lies in other files"),
    "virtual": (_virtual, "lies in other files"),
    "unknown filter": (_unknown_filter, "32015"),
    "absurd": (_absurd, "proportion"),
    "absurd block": (_absurd_block, "proportion"),
    "bomb": (_bomb, "unpacks to more"),
    "short block": (_short_block, "unpacks to 100"),
    "garbage block": (_garbage_block, "damaged"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_an_array_that_could_do_harm_is_refused_in_one_line(tmp_path, case):
    """Each file's q is unreadable, elsewhere, or larger than the file can mean."""
    import h5py

    build, word = HOSTILE[case]
    path = tmp_path / "h5_f_0000000000.h5"
    with h5py.File(path, "w") as file:
        file["x"] = REST.T
        build(file, tmp_path)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_truncated_file_and_no_file_are_refused(tmp_path):
    """Every tenth of the length of an honest file, and a folder of other files."""
    path = tmp_path / "h5_f_0000000000.h5"
    _write(path, REST)
    content = path.read_bytes()
    for tenth in range(10):
        path.write_bytes(content[: len(content) * tenth // 10])
        with pytest.raises(DataError):
            _read_all(tmp_path)
    path.rename(tmp_path / "train.h5")
    assert not CROM.detect(tmp_path)
    with pytest.raises(DataError, match="no files h5_f_"):
        _read_all(tmp_path)


def test_numbers_in_the_other_byte_order_are_read(tmp_path):
    """HDF5 says its byte order; big-endian arrays come out as the machine's."""
    import h5py

    with h5py.File(tmp_path / "h5_f_0000000000.h5", "w") as file:
        file["x"], file["q"] = REST.T.astype(">f4"), REST.T.astype(">f4")
    (trajectory,) = CROM.read(tmp_path)
    frame = next(trajectory.frames())
    assert frame.dtype == np.float32
    np.testing.assert_array_equal(frame, REST.astype(np.float32))
