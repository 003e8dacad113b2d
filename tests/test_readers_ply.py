"""The reader of PLY files, held to other writers and to bytes laid out by hand."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.ply import PLY, read_ply_frame
from giorom.export import write_trajectory
from giorom.state import Trajectory


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in PLY.read(path):
        list(trajectory.frames())


@pytest.mark.parametrize("binary", [True, False])
def test_files_of_vtk_are_read_exactly(tmp_path, binary):
    """VTK's own PLY writer; in text it keeps 6 digits."""
    pv = pytest.importorskip("pyvista")
    mesh = pv.Sphere(theta_resolution=9, phi_resolution=7)
    mesh.save(tmp_path / "a.ply", binary=binary)
    position = read_ply_frame(tmp_path / "a.ply").position
    assert position.dtype == np.float32
    np.testing.assert_allclose(position, mesh.points, rtol=0 if binary else 1e-5, atol=1e-7)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_files_of_trimesh_are_read_exactly(tmp_path, encoding):
    """The writer of trimesh, with faces behind the vertices."""
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.icosphere(subdivisions=2)
    (tmp_path / "a.ply").write_bytes(
        trimesh.exchange.ply.export_ply(mesh, encoding=encoding, vertex_normal=True)
    )
    position = read_ply_frame(tmp_path / "a.ply").position
    np.testing.assert_allclose(position, mesh.vertices, rtol=1e-6, atol=1e-7)


def _by_hand(order: str) -> bytes:
    """A file with mixed faces and a plain table before two vertices of mixed types."""
    name = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\r\nformat binary_{name}_endian 1.0\r\ncomment time 0.75 s\r\n"
        "element camera 2\r\nproperty double zoom\r\nproperty uchar kind\r\n"
        "element face 2\r\nproperty list uchar short corners\r\nproperty float area\r\n"
        "property list int double weights\r\n"
        "element vertex 2\r\nproperty uint64_like_id\r\n"
    ).replace("property uint64_like_id", "property uint id")
    header += (
        "property double x\r\nproperty char shade\r\nproperty double y\r\nproperty double z\r\n"
        "property uchar type\r\nelement edge 1\r\nproperty int a\r\nend_header\r\n"
    )
    body = struct.pack(order + "dBdB", 1.5, 1, 2.5, 2)
    body += struct.pack(order + "B3hfi2d", 3, 0, 1, 2, 0.5, 2, 1.0, 2.0)
    body += struct.pack(order + "B4hfi", 4, 0, 1, 2, 3, 0.5, 0)
    body += struct.pack(order + "IdbddB", 4_000_000_000, 1.0, -1, 2.0, 3.0, 6)
    body += struct.pack(order + "IdbddB", 7, -4.0, 1, 5.5, 1e-3, 3)
    return header.encode() + body + struct.pack(order + "i", 9)


@pytest.mark.parametrize("order", ["<", ">"])
def test_elements_before_the_vertices_are_passed_over(tmp_path, order):
    """Bytes packed by hand from Turk's layout, in both byte orders."""
    (tmp_path / "a.ply").write_bytes(_by_hand(order))
    cloud = read_ply_frame(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.position, [[1.0, 2.0, 3.0], [-4.0, 5.5, 1e-3]])
    np.testing.assert_array_equal(cloud.identity, [4_000_000_000, 7])
    np.testing.assert_array_equal(cloud.particle_type, [6, 3])
    assert cloud.time == 0.75


def test_text_with_elements_before_the_vertices_is_read(tmp_path):
    """The same kind of file as text, with blank lines, and x and y alone: a 2-D motion."""
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
        "element vertex 3\nproperty float x\nproperty float y\nproperty int id\nend_header\n"
        "3 0 1 2\n\n0.5 1 2\n\n-1e-3 nan 0\n7 8 1\n"
    )
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    (frame,) = trajectory.frames()
    np.testing.assert_array_equal(frame, np.float32([[-1e-3, np.nan], [7, 8], [0.5, 1]]))
    assert trajectory.identity_kept


def test_our_own_sequence_comes_back(tmp_path):
    """The inverse of ``write_trajectory``, for a motion in the plane and one in space."""
    for dimension in (2, 3):
        motion = Trajectory(
            position=torch.rand(12, 30, dimension, generator=torch.Generator().manual_seed(0)),
            particle_type=torch.tensor([3] * 10 + [6] * 20),
            frame_dt=0.05,
            bounds=torch.tensor([[0.0, 1.0]] * dimension),
        )
        folder = write_trajectory(motion, tmp_path / f"motion{dimension}.ply")
        (trajectory,) = detect_format(folder).read(folder)
        np.testing.assert_array_equal(list(trajectory.frames()), motion.position.numpy())
        np.testing.assert_array_equal(trajectory.particle_type, motion.particle_type.numpy())
        assert trajectory.frame_dt == pytest.approx(0.05)
        assert trajectory.identity_kept is None


def _write(path: Path, points: np.ndarray, **columns: np.ndarray) -> None:
    """A text file of points and whole numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = "".join(f"property int {name}\n" for name in columns)
    rows = [
        " ".join([*(repr(float(x)) for x in point), *(str(c[i]) for c in columns.values())])
        for i, point in enumerate(points)
    ]
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\n"
        f"property double y\nproperty double z\n{names}end_header\n" + "\n".join(rows) + "\n"
    )


def test_every_folder_is_a_motion_and_says_its_part(tmp_path):
    """train/run2 before train/run10; other names are other motions, or none."""
    points = np.random.default_rng(0).random((4, 3))
    for folder in ("test/a", "train/run10", "train/run2"):
        for frame in (0, 1):
            _write(tmp_path / folder / f"f{frame}.ply", points)
    for name in ("sand_8", "sand_9", "sand_10", "wall_0", "wall_1", "floor", "._sand_8"):
        _write(tmp_path / "train" / "two" / f"{name}.ply", points)
    motions = list(PLY.read(tmp_path))
    found = [(t.name.split("/", 1)[1], t.split, t.frame_count) for t in motions]
    assert found == [
        ("test/a", "test", 2),
        ("train/run2", "train", 2),
        ("train/run10", "train", 2),
        ("train/two/sand_#.ply", "train", 3),
        ("train/two/wall_#.ply", "train", 2),
    ]
    assert motions[-1].notes == ("floor.ply stands alone beside the frames and is left out.",)


def test_a_gap_in_the_numbers_is_said(tmp_path):
    """Files 0, 5, 10, 20: frame 15 may be missing. Files 0, 5, 10: nothing is."""
    points = np.random.default_rng(0).random((4, 3))
    for frame in (0, 5, 10):
        _write(tmp_path / f"{frame}.ply", points)
    assert next(PLY.read(tmp_path)).notes == ()
    _write(tmp_path / "20.ply", points)
    (note,) = next(PLY.read(tmp_path)).notes
    assert "10.ply is followed by 20.ply" in note


SECOND = {
    "count": (lambda p: {"points": p[:3]}, "3 points, but 0.ply holds 4"),
    "lost": (lambda p: {"points": p, "id": np.array([0, 1, 2, 9])}, "identity 3"),
    "twice": (
        lambda p: {"points": p, "id": np.array([0, 1, 2, 2])},
        "several points of identity 2",
    ),
    "none": (lambda p: {"points": p}, "has no identities"),
}


@pytest.mark.parametrize("case", SECOND)
def test_a_frame_with_other_particles_is_refused(tmp_path, case):
    """The third of four frames is wrong, which shows when it is read."""
    points = np.random.default_rng(0).random((4, 3))
    change, word = SECOND[case]
    for frame in range(4):
        _write(tmp_path / f"{frame}.ply", points, id=np.arange(4))
    _write(tmp_path / "2.ply", **change(points))
    (trajectory,) = PLY.read(tmp_path)
    frames = trajectory.frames()
    assert len([next(frames), next(frames)]) == 2
    with pytest.raises(DataError, match=word):
        next(frames)


def test_a_motion_that_leaves_its_plane_late_is_refused(tmp_path):
    """The plane z = 0 holds the first and last frame alone; with another last frame it is 3-D."""
    flat, high = np.zeros((4, 3)), np.ones((4, 3))
    for frame, points in enumerate((flat, flat, high, flat)):
        _write(tmp_path / f"{frame}.ply", points)
    with pytest.raises(DataError, match="off the plane"):
        _read_all(tmp_path)
    _write(tmp_path / "4.ply", high)
    (trajectory,) = PLY.read(tmp_path)
    assert next(trajectory.frames()).shape == (4, 3)


def test_types_that_are_no_gns_types_are_left_out_or_refused(tmp_path):
    """``type`` is anybody's word, ``particle_type`` is ours."""
    points, kinds = np.random.default_rng(0).random((2, 3)), np.array([12, 3])
    _write(tmp_path / "a.ply", points, type=kinds)
    (trajectory,) = PLY.read(tmp_path)
    assert trajectory.particle_type.tolist() == [5, 5]
    assert "holds 12" in trajectory.notes[0]
    _write(tmp_path / "a.ply", points, particle_type=kinds)
    with pytest.raises(DataError, match="holds 12"):
        _read_all(tmp_path)
    _write(tmp_path / "a.ply", points, Type=np.array([0, 3]), Idp=np.array([4, 1]))
    (trajectory,) = PLY.read(tmp_path)
    assert trajectory.particle_type.tolist() == [5, 5]
    np.testing.assert_array_equal(next(trajectory.frames()), points[::-1])


HEAD = "ply\nformat {} 1.0\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
VALUES = np.linspace(0.1, 1, 30).astype("<f4").tobytes()


def _ply(body: str, form: str = "ascii", after: bytes = b"") -> bytes:
    return HEAD.format(form).encode() + body.encode() + b"end_header\n" + after


LITTLE, LARGE = "binary_little_endian", "binary_big_endian"
LIST = "element face 1\nproperty list uint int a\n"

DAMAGED = {
    "empty": (b"", "no PLY"),
    "other": (b"plywood", "no PLY"),
    "no end": (b"ply\nformat ascii 1.0\n", "within its header"),
    "no format": (b"ply\nend_header\n", "format None"),
    "no vertex": (_ply(""), "no element 'vertex'"),
    "no x": (_ply("element vertex 1\nproperty float a\n"), "no element 'vertex'"),
    "no points": (_ply(f"element vertex 0\n{XYZ}"), "0 points"),
    "absurd": (_ply(f"element vertex {10**17}\n{XYZ}", LITTLE, VALUES), "more than"),
    "negative": (_ply(f"element vertex -1\n{XYZ}"), "element NAME COUNT"),
    "beyond": (_ply(f"element vertex 99\n{XYZ}", LITTLE, VALUES), "truncated"),
    "beyond in text": (_ply(f"element vertex 99\n{XYZ}", after=b"1 2 3\n"), "truncated"),
    "ends": (_ply(f"element vertex 2\n{XYZ}", after=b"1 2 3\n" + b"\n" * 20), "truncated"),
    "short row": (_ply(f"element vertex 2\n{XYZ}", after=b"1 2 3\n4 5\n1"), "damaged"),
    "short rows": (_ply(f"element vertex 2\n{XYZ}", after=b"1 2\n4 5\n" * 2), "vertex of 2"),
    "word": (_ply(f"element vertex 1\n{XYZ}", after=b"1 2 x\n"), "damaged"),
    "half an identity": (
        _ply(f"element vertex 1\n{XYZ}property uchar id\n", after=b"1 2 3 0.5\n"),
        "whole number",
    ),
    "wrong order": (_ply(f"element vertex 10\n{XYZ}", LARGE, VALUES), "byte order"),
    "list of vertices": (
        _ply(f"element vertex 1\n{XYZ}property list int int a\n"),
        "vertices with a list",
    ),
    "same names": (_ply(f"element vertex 1\n{XYZ}{XYZ}"), "two properties"),
    "orphan": (_ply(XYZ), "before any element"),
    "unknown type": (_ply("element vertex 1\nproperty quad x\n"), "quad"),
    "counted in float": (_ply("element face 1\nproperty list float int a\n"), "floating-point"),
    "absurd list": (
        _ply(f"{LIST}element vertex 1\n{XYZ}", LITTLE, b"\xff" * 4 + VALUES),
        "list of 4294967295",
    ),
    "many lists": (
        _ply(
            f"element face {10**8}\nproperty list uint int a\n{LIST}element vertex 1\n{XYZ}", LITTLE
        ),
        "truncated",
    ),
    "endless line": (b"ply\n" + b"a" * (3 << 20), "line of more"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, case):
    """Each file is broken in one way; the message names it."""
    content, word = DAMAGED[case]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path / "a.ply")
    assert "\n" not in str(caught.value)


def test_an_absurd_count_takes_no_memory(tmp_path):
    """A hundred million points in a file of a hundred bytes."""
    (tmp_path / "a.ply").write_bytes(_ply(f"element vertex {10**8}\n{XYZ}", LITTLE, VALUES))
    tracemalloc.start()
    with pytest.raises(DataError):
        read_ply_frame(tmp_path / "a.ply")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_a_folder_without_files_of_the_format_is_said(tmp_path):
    """The remedy is to look at the path."""
    with pytest.raises(DataError, match="no file that ends in"):
        _read_all(tmp_path)
    with pytest.raises(DataError, match="cannot be listed"):
        _read_all(tmp_path / "nothing")
