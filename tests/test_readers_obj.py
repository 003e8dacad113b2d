"""The reader of OBJ meshes, held to the writers of trimesh and VTK."""

from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.obj import OBJ


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in OBJ.read(path):
        list(trajectory.frames())


def test_a_sequence_of_trimesh_keeps_its_vertices(tmp_path):
    """The writer of trimesh with normals and texture; the vertices to its eight digits."""
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.icosphere(subdivisions=2)
    motion = [mesh.vertices * (1.0 + 0.1 * frame) for frame in range(11)]
    for frame, vertices in enumerate(motion):
        deformed = trimesh.Trimesh(vertices, mesh.faces, process=False)
        text = trimesh.exchange.obj.export_obj(deformed, include_normals=True)
        (tmp_path / f"body.{frame}.obj").write_text(text)
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    np.testing.assert_allclose(list(trajectory.frames()), motion, atol=1e-8)
    assert (trajectory.frame_count, trajectory.identity_kept) == (11, True)
    assert trajectory.notes == (
        f"The vertices are the particles; {len(mesh.faces)} faces are left out.",
    )


def test_a_mesh_of_vtk_is_read(tmp_path):
    """VTK's own writer, to its six digits."""
    pv = pytest.importorskip("pyvista")
    mesh = pv.Sphere(theta_resolution=7, phi_resolution=5)
    mesh.save(tmp_path / "a.obj")
    (trajectory,) = detect_format(tmp_path / "a.obj").read(tmp_path / "a.obj")
    np.testing.assert_allclose(next(trajectory.frames()), mesh.points, atol=1e-5)


MESH = "# a\nmtllib a.mtl\nv 0 0 0.5 1 0 0\nv\t1 0 0\r\nv 0 1 0 1.0\nvt 0 0\n\nf 1/1 2/1 3/1\n"

SECOND = {
    "other faces": (MESH.replace("f 1/1 2/1 3/1", "f 2 1 3"), "other faces"),
    "fewer vertices": (MESH.replace("v 0 1 0 1.0\n", ""), "2 points, but a1.obj holds 3"),
    "short vertex": (MESH.replace("v 0 1 0 1.0", "v 0 1"), "vertex of 2 numbers"),
    "word": (MESH.replace("v 0 1 0 1.0", "v 0 1 x"), "damaged"),
    "empty": ("", "no vertices"),
    "endless line": ("v 0 " + "0" * (2 << 20), "line of more"),
}


@pytest.mark.parametrize("case", SECOND)
def test_a_second_file_that_does_not_fit_is_refused_in_one_line(tmp_path, case):
    """Each is broken in one way; the message names it."""
    content, word = SECOND[case]
    (tmp_path / "a1.obj").write_text(MESH)
    (tmp_path / "a2.obj").write_text(content)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path)
    assert "\n" not in str(caught.value)


def test_corners_may_be_written_in_any_way(tmp_path):
    """``f 1/1 2/1 3/1`` and ``f 1 2//9 3`` are one face; colours and weights are left out."""
    (tmp_path / "a1.obj").write_text(MESH)
    (tmp_path / "a2.obj").write_text(MESH.replace("f 1/1 2/1 3/1", "f  1 2//9 3"))
    (trajectory,) = OBJ.read(tmp_path)
    for frame in trajectory.frames():
        np.testing.assert_array_equal(frame, [[0, 0, 0.5], [1, 0, 0], [0, 1, 0]])


def test_points_without_faces_make_no_promise(tmp_path):
    """Nothing says that row i is the same point in every frame."""
    (tmp_path / "a.obj").write_text("v 0 0 1\nv 0 1 0\n")
    assert next(OBJ.read(tmp_path)).identity_kept is None


def test_a_pickle_of_that_name_is_not_a_mesh(tmp_path):
    """MPM-Verse calls its pickles .obj; they begin with 0x80 and hold no vertex line."""
    (tmp_path / "train.obj").write_bytes(b"\x80\x04}\x94\x00(v 1 2 3\nv 1 2 3\n")
    assert not OBJ.detect(tmp_path / "train.obj")
