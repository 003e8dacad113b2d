"""The reader of CSV tables, held to VTK's table writer, NumPy's and text by hand."""

from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.csv_files import CSV


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in CSV.read(path):
        list(trajectory.frames())


def test_tables_of_paraview_are_read(tmp_path):
    """VTK's delimited text writer is what ParaView's spreadsheet export runs; to its six digits."""
    pv = pytest.importorskip("pyvista")
    vtk = pytest.importorskip("vtk")
    motion = np.random.default_rng(0).random((11, 20, 3))
    for frame, points in enumerate(motion):
        columns = {"id": np.arange(20)[::-1] + 2**40, "pressure": np.arange(20.0)}
        columns |= {f"Points:{axis}": points[:, axis] for axis in range(3)}
        writer = vtk.vtkDelimitedTextWriter()
        writer.SetInputData(pv.Table(columns))
        writer.SetFileName(str(tmp_path / f"t{frame}.csv"))
        writer.Write()
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    np.testing.assert_allclose(list(trajectory.frames()), motion[:, ::-1], atol=1e-5)
    assert trajectory.identity_kept


@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
def test_plain_numbers_of_numpy_are_positions(tmp_path, mark):
    """np.savetxt without names, two columns; every digit comes back."""
    points = np.random.default_rng(0).standard_normal((17_000, 2))
    np.savetxt(tmp_path / "a.csv", points, delimiter=mark, fmt="%.17g")
    (trajectory,) = detect_format(tmp_path / "a.csv").read(tmp_path / "a.csv")
    np.testing.assert_array_equal(next(trajectory.frames()), points)


def test_names_may_carry_units_and_a_byte_order_mark(tmp_path):
    """As spreadsheet programs write them."""
    text = '\ufeff"Type";"Z [m]";"X (m)";"Y"\r\n6;3;1;2\r\n\r\n3;6;4;5e0\r\n'
    (tmp_path / "a.csv").write_bytes(text.replace("5e0", '"5e0"').encode("utf-8"))
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    np.testing.assert_array_equal(next(trajectory.frames()), [[1, 2, 3], [4, 5, 6]])
    assert trajectory.particle_type.tolist() == [6, 3]


DAMAGED = {
    "empty": ("", "empty"),
    "names alone": ("x,y\n", "no rows"),
    "no x": ("a,b\n1,2\n", "one x, one y"),
    "x and z": ("x,z\n1,2\n", "one x, one y"),
    "two x": ("x,x,y\n1,2,3\n", "one x, one y"),
    "four numbers": ("1,2,3,4\n", "one x, one y"),
    "short row": ("x,y\n1,2\n3\n", "damaged"),
    "word": ("x,y\n1,2\n3,four\n", "damaged"),
    "identity": ("x,y,id\n1,2,0.5\n", "whole number"),
    "endless": ("x,y\n" + "1" * (2 << 20), "line of more"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_table_is_refused_in_one_line(tmp_path, case):
    """Each is broken in one way; the message names it."""
    content, word = DAMAGED[case]
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)


def test_a_table_of_something_else_is_not_taken(tmp_path):
    """No x and y, and no two or three numbers."""
    (tmp_path / "loss.csv").write_text("step,loss\n1,0.5\n")
    assert not CSV.detect(tmp_path)
