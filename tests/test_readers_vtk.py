"""Readers of VTK's files, held to files that VTK itself wrote."""

import itertools
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.vtk_arrays import unpacked_limit
from giorom.data.readers.vtk_files import VTK, read_vtk_frame
from giorom.export import write_trajectory
from giorom.state import Trajectory

pv = pytest.importorskip("pyvista")
vtk = pytest.importorskip("vtk")

POINTS = 700


def _cloud(kind: str, dtype: str, seed: int = 0):
    """Points with an identity, a type, numbers that are not wanted, a time and strings."""
    rng = np.random.default_rng(seed)
    mesh = pv.PolyData(rng.random((POINTS, 3)).astype(dtype) - 0.5)
    if kind == "grid":
        mesh = mesh.cast_to_unstructured_grid()
    mesh["id"] = rng.permutation(POINTS).astype(np.int64) + 2**40
    mesh["velocity"] = rng.random((POINTS, 3))
    mesh["particle_type"] = rng.integers(0, 9, POINTS).astype(np.uint8)
    mesh.cell_data["cell"] = np.arange(POINTS, dtype=np.float32)
    mesh.field_data["TimeValue"] = [0.25]
    mesh.field_data["names"] = ["a b", "c" * 100]
    return mesh


def _check(path: Path, mesh, *, rtol: float = 0.0) -> None:
    """Compare everything that is read with what VTK was given."""
    cloud = read_vtk_frame(path)
    assert cloud.position.dtype == mesh.points.dtype
    np.testing.assert_allclose(cloud.position, mesh.points, rtol=rtol, atol=0.0)
    np.testing.assert_array_equal(cloud.identity, mesh["id"])
    np.testing.assert_array_equal(cloud.particle_type, mesh["particle_type"])
    assert cloud.time == 0.25


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("kind", ["points", "grid"])
def test_legacy_files_of_vtk_are_read_exactly(tmp_path, kind, version, binary):
    """VTK's own writer; in text it keeps 6 (float) or 11 (double) digits."""
    writers = {"points": vtk.vtkPolyDataWriter, "grid": vtk.vtkUnstructuredGridWriter}
    for dtype, digits in (("f4", 1e-5), ("f8", 1e-9)):
        mesh, writer = _cloud(kind, dtype), writers[kind]()
        writer.SetInputData(mesh)
        writer.SetFileVersion(version)
        writer.SetFileName(str(tmp_path / "a.vtk"))
        (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
        writer.Write()
        _check(tmp_path / "a.vtk", mesh, rtol=0.0 if binary else digits)


MODES = [
    (mode, encoded)
    for mode, encoded in itertools.product(["Ascii", "Binary", "Appended"], [False, True])
    if mode == "Appended" or not encoded
]


@pytest.mark.parametrize(("mode", "encoded"), MODES)
@pytest.mark.parametrize("compressor", ["None", "ZLib", "LZMA"])
@pytest.mark.parametrize("kind", ["points", "grid"])
def test_xml_files_of_vtk_are_read_exactly(tmp_path, kind, compressor, mode, encoded):
    """VTK's own writer in every encoding, header width and byte order; no digit is lost."""
    writers = {"points": vtk.vtkXMLPolyDataWriter, "grid": vtk.vtkXMLUnstructuredGridWriter}
    mesh = _cloud(kind, "f8")
    for width, order in itertools.product([32, 64], ["Little", "Big"]):
        writer, path = writers[kind](), tmp_path / ("a.vtp" if kind == "points" else "a.vtu")
        writer.SetInputData(mesh)
        writer.SetFileName(str(path))
        getattr(writer, f"SetDataModeTo{mode}")()
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        getattr(writer, f"SetHeaderTypeToUInt{width}")()
        getattr(writer, f"SetByteOrderTo{order}Endian")()
        writer.SetEncodeAppendedData(encoded)
        writer.SetBlockSize(4096)
        writer.Write()
        _check(path, mesh)


def test_global_ids_of_vtk_name_the_particles(tmp_path):
    """VTK's global ids, which the two formats store in ways of their own."""
    mesh = pv.PolyData(np.random.default_rng(0).random((50, 3)))
    ids = vtk.vtkIdTypeArray()
    ids.SetName("GlobalPointIds")
    for index in range(50):
        ids.InsertNextValue(49 - index)
    mesh.GetPointData().SetGlobalIds(ids)
    for name, binary in (("a.vtk", True), ("b.vtk", False), ("c.vtp", True)):
        mesh.save(tmp_path / name, binary=binary)
        np.testing.assert_array_equal(read_vtk_frame(tmp_path / name).identity, np.arange(50)[::-1])


def test_frames_come_in_natural_order_and_rows_follow_the_identities(tmp_path):
    """Frame 2 before frame 10; a permuted file gives the same rows as the plain one."""
    rng = np.random.default_rng(0)
    motion = rng.random((12, 40, 3)).astype(np.float32)
    for frame, points in enumerate(motion):
        order = rng.permutation(40)
        mesh = pv.PolyData(points[order])
        mesh["particle_id"] = order
        mesh.save(tmp_path / f"run7_frame_{frame}.vtp")
    (trajectory,) = detect_format(tmp_path).read(tmp_path)
    for _ in range(2):
        np.testing.assert_array_equal(list(trajectory.frames()), motion)
    assert (trajectory.frame_count, trajectory.identity_kept) == (12, True)
    assert trajectory.particle_type.tolist() == [5] * 40


def test_a_collection_gives_order_and_time(tmp_path):
    """A .pvd file in ParaView's layout, its entries out of order."""
    motion = np.random.default_rng(0).random((5, 10, 3))
    entries = []
    for frame in (3, 0, 4, 1, 2):
        name = f"{'bdace'[frame]}.vtp"
        pv.PolyData(motion[frame]).save(tmp_path / name)
        entries.append(f'<DataSet timestep="{frame * 0.02}" group="" part="0" file="{name}"/>')
    collection = tmp_path / "all.pvd"
    collection.write_text(
        f'<?xml version="1.0"?><VTKFile type="Collection" version="0.1">'
        f"<Collection>{''.join(entries)}</Collection></VTKFile>"
    )
    for source in (collection, tmp_path):
        (trajectory,) = detect_format(source).read(source)
        np.testing.assert_array_equal(list(trajectory.frames()), motion)
        assert trajectory.frame_dt == pytest.approx(0.02, rel=1e-12)


def test_times_in_the_files_give_the_time_between_frames(tmp_path):
    """TimeValue of VTK's writers; uneven times are said."""
    for times, even in (([0.0, 0.5, 1.0], True), ([0.0, 0.5, 2.0], False)):
        for frame, time in enumerate(times):
            mesh = pv.PolyData(np.random.default_rng(frame).random((4, 3)))
            mesh.field_data["TimeValue"] = [time]
            mesh.save(tmp_path / f"{frame}.vtp")
        (trajectory,) = VTK.read(tmp_path)
        assert trajectory.frame_dt == pytest.approx(times[-1] / 2)
        assert any("not evenly" in note for note in trajectory.notes) != even


def test_our_own_animation_comes_back(tmp_path):
    """The inverse of ``write_trajectory``; a 2-D motion lies in z = 0 and is 2-D again."""
    for dimension in (2, 3):
        motion = Trajectory(
            position=torch.rand(4, 30, dimension, generator=torch.Generator().manual_seed(0)),
            particle_type=torch.tensor([3] * 10 + [6] * 20),
            frame_dt=0.05,
            bounds=torch.tensor([[0.0, 1.0]] * dimension),
        )
        path = write_trajectory(motion, tmp_path / f"{dimension}.vtkhdf")
        (trajectory,) = detect_format(path).read(path)
        np.testing.assert_array_equal(list(trajectory.frames()), motion.position.numpy())
        np.testing.assert_array_equal(trajectory.particle_type, motion.particle_type.numpy())
        assert trajectory.frame_dt == pytest.approx(0.05)


@pytest.mark.parametrize("compression", [0, 4])
def test_a_temporal_file_of_vtk_is_read_exactly(tmp_path, compression):
    """VTK's own VTKHDF writer, driven by a source with time steps; rows permuted in each frame."""
    writer_type = getattr(vtk, "vtkHDFWriter", None)
    if writer_type is None:
        pytest.skip("this VTK has no VTKHDF writer")
    rng = np.random.default_rng(0)
    motion = rng.random((6, 50, 3)).astype(np.float32)
    order = [rng.permutation(50) for _ in range(6)]
    source = _temporal_source(motion, order)
    writer, path = writer_type(), tmp_path / "a.vtkhdf"
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetFileName(str(path))
    writer.SetWriteAllTimeSteps(True)
    writer.SetCompressionLevel(compression)
    writer.Write()
    (trajectory,) = detect_format(path).read(path)
    np.testing.assert_array_equal(list(trajectory.frames()), motion)
    assert trajectory.frame_dt == pytest.approx(0.1, rel=1e-6)
    assert trajectory.particle_type.tolist() == [6] * 50


def _temporal_source(motion: np.ndarray, order: list[np.ndarray]):
    """A VTK source of points at times 0, 0.1, 0.2 ..."""
    from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Keys

    class Source(VTKPythonAlgorithmBase):
        def __init__(self) -> None:
            super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkPolyData")

        def RequestInformation(self, request, inputs, outputs):  # noqa: N802 (VTK's name)
            information = outputs.GetInformationObject(0)
            times = [0.1 * frame for frame in range(len(motion))]
            information.Set(Keys.TIME_STEPS(), times, len(times))
            information.Set(Keys.TIME_RANGE(), [times[0], times[-1]], 2)
            return 1

        def RequestData(self, request, inputs, outputs):  # noqa: N802 (VTK's name)
            time = outputs.GetInformationObject(0).Get(Keys.UPDATE_TIME_STEP())
            frame = round(time / 0.1)
            mesh = pv.PolyData(motion[frame][order[frame]])
            mesh["id"] = order[frame]
            mesh["particle_type"] = np.full(len(order[frame]), 6, dtype=np.uint8)
            output = vtk.vtkDataObject.GetData(outputs, 0)
            output.ShallowCopy(mesh)
            output.GetInformation().Set(vtk.vtkDataObject.DATA_TIME_STEP(), time)
            return 1

    return Source()


def _read_all(path: Path) -> None:
    """Read every frame below a path."""
    for trajectory in VTK.read(path):
        list(trajectory.frames())


def _legacy(body: str, *, form: str = "ASCII", kind: str = "POLYDATA") -> bytes:
    return f"# vtk DataFile Version 3.0\nt\n{form}\nDATASET {kind}\n{body}".encode()


def _xml(body: str, *, head: str = "", root: str = "") -> bytes:
    root = root or 'type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64"'
    return (
        f'<?xml version="1.0"?>{head}<VTKFile {root}><PolyData>{body}</PolyData></VTKFile>'.encode()
    )


def _points(text: str, count: int = 2, form: str = "ascii") -> str:
    return (
        f'<Piece NumberOfPoints="{count}"><Points><DataArray type="Float32" Name="Points" '
        f'NumberOfComponents="3" format="{form}">{text}</DataArray></Points></Piece>'
    )


BIG = "9" * 15
ENTITY = '<!DOCTYPE a [<!ENTITY e "1 2 3">]>'
EXTERNAL = '<!DOCTYPE a [<!ENTITY e SYSTEM "/etc/hostname">]>'
SWAPPED = np.linspace(0.1, 1, 30).astype("<f4").tobytes()

DAMAGED = {
    "empty": ("a.vtk", b"", "neither"),
    "not VTK": ("a.vtp", b"hello", "neither"),
    "image": ("a.vtk", _legacy("", kind="STRUCTURED_POINTS"), "STRUCTURED_POINTS"),
    "no points": ("a.vtk", _legacy(""), "no POINTS"),
    "zero points": ("a.vtk", _legacy("POINTS 0 float\n"), "0 points"),
    "absurd count": ("a.vtk", _legacy(f"POINTS {BIG} float\n1 2 3"), "more than"),
    "count beyond file": ("a.vtk", _legacy("POINTS 9999 float\n1 2 3"), "left in the file"),
    "truncated text": ("a.vtk", _legacy("POINTS 2 float\n1 2 3 4 5\n" + "\n" * 30), "truncated"),
    "too many": ("a.vtk", _legacy("POINTS 2 float\n1 2 3 4 5 6 7\n" + "\n" * 30), "more numbers"),
    "words": ("a.vtk", _legacy("POINTS 2 float\n1 2 3 4 5 x\n" + "\n" * 30), "damaged"),
    "unknown type": ("a.vtk", _legacy("POINTS 1 quad\n1 2 3\n"), "quad"),
    "negative count": ("a.vtk", _legacy("POINTS -1 float\n1 2 3\n"), "-1"),
    "unknown block": ("a.vtk", _legacy("POINTS 1 float\n1 2 3\nNONSENSE\n"), "NONSENSE"),
    "truncated binary": (
        "a.vtk",
        _legacy("POINTS 9 float\n", form="BINARY") + SWAPPED[:100],
        "truncated",
    ),
    "little-endian": (
        "a.vtk",
        _legacy("POINTS 10 float\n", form="BINARY") + SWAPPED + b"\n",
        "byte order",
    ),
    "entity": ("a.vtp", _xml(_points("&e; 1 2 3"), head=ENTITY), "DOCTYPE"),
    "external entity": ("a.vtp", _xml(_points("&e; 1 2 3"), head=EXTERNAL), "DOCTYPE"),
    "xml cut": ("a.vtp", _xml(_points("1 2 3 4 5 6"))[:-40], "truncated"),
    "short xml": ("a.vtp", _xml(_points("1 2 3 4 5")), "5 numbers"),
    "absurd xml": ("a.vtp", _xml(_points("1", count=int(BIG))), "more than"),
    "beyond proportion": ("a.vtp", _xml(_points("1", count=50_000_000)), "proportion"),
    "no piece": ("a.vtp", _xml(""), "0 points"),
    "no array": ("a.vtp", _xml('<Piece NumberOfPoints="2"/>'), "0 arrays"),
    "bad base64": ("a.vtp", _xml(_points("AAAA", form="binary")), "left"),
    "not base64": ("a.vtp", _xml(_points("!" * 60, form="binary")), "damaged"),
    "no appended": ("a.vtp", _xml(_points("", form="appended")), "offset"),
    "no byte order": ("a.vtp", _xml("", root='type="PolyData"'), "byte_order"),
    "lz4": (
        "a.vtp",
        _xml("", root='type="PolyData" compressor="vtkLZ4DataCompressor"'),
        "vtkLZ4DataCompressor",
    ),
    "image xml": ("a.vtp", _xml("", root='type="ImageData"'), "ImageData"),
    "parallel": ("a.pvtu", _xml("", root='type="PUnstructuredGrid"'), "parallel"),
    "no hdf": ("a.vtkhdf", b"\x89HDF\r\n\x1a\n" + b"\0" * 200, "HDF5"),
    "collection outside": (
        "a.pvd",
        b'<VTKFile type="Collection"><Collection><DataSet timestep="0" file="../a.vtp"/>'
        b"</Collection></VTKFile>",
        "own folder",
    ),
    "collection of nothing": ("a.pvd", b'<VTKFile type="Collection"/>', "0 found"),
    "collection of missing": (
        "a.pvd",
        b'<VTKFile type="Collection"><Collection><DataSet timestep="0" file="no.vtp"/>'
        b"</Collection></VTKFile>",
        "is no file",
    ),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, case):
    """Each file is broken in one way; the message names it."""
    name, content, word = DAMAGED[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=word) as caught:
        _read_all(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_bomb_is_not_unpacked(tmp_path):
    """64 MB of zeros in a block that declares 24 bytes: memory stays far below the bomb's size."""
    packed = zlib.compress(bytes(1 << 26), 9)
    header = np.array([1, 24, 0, len(packed)], dtype="<u4").tobytes()
    head = (
        b'<VTKFile type="PolyData" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
        b'<PolyData><Piece NumberOfPoints="2"><Points><DataArray type="Float32" '
        b'NumberOfComponents="3" format="appended" offset="0"/></Points></Piece></PolyData>'
        b'<AppendedData encoding="raw">_'
    )
    path = tmp_path / "bomb.vtp"
    path.write_bytes(head + header + packed)
    tracemalloc.start()
    with pytest.raises(DataError, match="24 must stand"):
        read_vtk_frame(path)
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_memory_does_not_depend_on_the_number_of_frames(tmp_path):
    """The peak over ten frames is that over three, to a tenth."""
    peaks = []
    for count in (3, 10):
        for frame in range(count):
            points = np.random.default_rng(frame).random((20_000, 3))
            pv.PolyData(points).save(tmp_path / f"{frame}.vtp", binary=True)
        (trajectory,) = VTK.read(tmp_path)
        tracemalloc.start()
        for _ in trajectory.frames():
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_a_truncation_of_a_file_is_refused_or_harmless(tmp_path):
    """Cut at sixty places of a small file: the points or a DataError, nothing else."""
    mesh = pv.PolyData(np.random.default_rng(0).random((5, 3)))
    mesh["id"] = np.arange(5)
    for name, binary in (("a.vtk", True), ("b.vtk", False), ("c.vtp", True), ("d.vtp", False)):
        mesh.save(tmp_path / name, binary=binary)
        content = (tmp_path / name).read_bytes()
        for length in range(0, len(content), 1 + len(content) // 60):
            (tmp_path / name).write_bytes(content[:length])
            try:
                cloud = read_vtk_frame(tmp_path / name)
            except DataError:
                continue
            assert cloud.position.shape == (5, 3)


def test_a_temporal_file_that_points_elsewhere_is_refused(tmp_path):
    """Steps beyond the points, external links, and arrays out of proportion to the file."""
    import h5py

    motion = Trajectory(
        position=torch.rand(4, 30, 3),
        particle_type=torch.full((30,), 5),
        frame_dt=0.05,
        bounds=torch.tensor([[0.0, 1.0]] * 3),
    )

    def offset(root):
        root["Steps/PointOffsets"][2] = 10**9

    def link(root):
        del root["Points"]
        root["Points"] = h5py.ExternalLink("other.h5", "/Points")

    def huge(root):
        del root["Points"]
        root.create_dataset("Points", (10**9, 3), "f8", chunks=(1000, 3))

    for damage, word in ((offset, "rows"), (link, "link"), (huge, "proportion")):
        path = write_trajectory(motion, tmp_path / "a.vtkhdf")
        with h5py.File(path, "r+") as file:
            damage(file["VTKHDF"])
        with pytest.raises(DataError, match=word):
            _read_all(path)
    assert unpacked_limit(0) < 10**9
