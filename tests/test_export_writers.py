"""Every writer keeps the same contract; what it writes is read back by another library."""

import os
import subprocess
import sys
import tracemalloc
from itertools import islice

import numpy as np
import pytest
import torch

from giorom.export import EXTENSIONS, MotionHeader, check_room, open_writer, written_path
from giorom.export.gns import StoredMotion, write_gns_file
from giorom.export.video import _check_film
from giorom.state import ELASTIC, KINEMATIC, WATER

FRAME_DT = 2.5e-3

USD = (".usd", ".usda", ".usdc")


def make_header(*, particles: int = 30, dim: int = 3, **changes) -> MotionHeader:
    """Water and elastic particles, the first five of them prescribed."""
    types = torch.full((particles,), WATER)
    types[particles // 2 :] = ELASTIC
    types[:5] = KINEMATIC
    values = {
        "particle_type": types,
        "frame_dt": FRAME_DT,
        "bounds": torch.tensor([[0.0, 1.0]] * dim),
        "attributes": {"material": "test"},
    }
    return MotionHeader(**(values | changes))


def make_frames(header: MotionHeader, count: int):
    """A cloud that moves to the right with unlike speeds; prescribed particles rest."""
    generator = torch.Generator().manual_seed(1)
    start = torch.rand(header.particle_count, header.dimension, generator=generator)
    step = torch.zeros_like(start)
    step[:, 0] = torch.rand(len(start), generator=generator) * 1e-3
    step[header.kinematic] = 0.0
    for frame in range(count):
        yield start + frame * step


def write(path, header, frames):
    """Write frames; return what was written and the frames as one array."""
    frames = [frame.clone() for frame in frames]
    with open_writer(path, header) as writer:
        for frame in frames:
            writer.append(frame)
    return written_path(path), torch.stack(frames).numpy()


def speeds(position: np.ndarray) -> np.ndarray:
    """Distance per time of the step that ends at each frame; the first takes the second's."""
    steps = np.linalg.norm(np.diff(position.astype(float), axis=0), axis=2) / FRAME_DT
    return np.concatenate([steps[:1], steps])


def geoelements(path) -> list:
    """Pairs of (positions, types) as the loader of geoelements/gns takes them from a file."""
    with np.load(path, allow_pickle=True) as file:
        return file["gns_data"] if "gns_data" in file else [file[name] for name in file.files]


@pytest.mark.parametrize("extension", USD)
@pytest.mark.parametrize("dim", [2, 3])
def test_usd_reads_its_points_back(tmp_path, extension, dim):
    """Units, times, types, ids and every sample through OpenUSD's own interface."""
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    header = make_header(dim=dim)
    path, position = write(tmp_path / f"a{extension}", header, make_frames(header, 4))
    assert path.read_bytes().startswith(b"#usda" if extension == ".usda" else b"PXR-USDC")
    stage = usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetTimeCodesPerSecond() == pytest.approx(1.0 / FRAME_DT)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    points = UsdGeom.Points(stage.GetDefaultPrim())
    assert points.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0, 3.0]
    numbers = UsdGeom.PrimvarsAPI(points)
    for frame in range(4):
        found = np.array(points.GetPointsAttr().Get(frame))
        np.testing.assert_array_equal(found[:, :dim], position[frame])
        assert not found[:, dim:].any()
        speed = np.array(numbers.GetPrimvar("speed").Get(frame))
        np.testing.assert_allclose(speed, speeds(position)[frame], rtol=1e-4, atol=1e-6)
        low, high = np.array(points.GetExtentAttr().Get(frame))
        assert (low <= found.min(axis=0)).all()
        assert (high >= found.max(axis=0)).all()
    types = np.array(numbers.GetPrimvar("particle_type").Get())
    np.testing.assert_array_equal(types, header.particle_type)
    np.testing.assert_array_equal(points.GetIdsAttr().Get(), np.arange(30))
    colors = np.array(points.GetDisplayColorAttr().Get())
    assert len(np.unique(colors, axis=0)) == 3
    assert points.GetWidthsInterpolation() == "constant"
    assert 0.0 < points.GetWidthsAttr().Get()[0] < 1.0


@pytest.mark.parametrize("dim", [2, 3])
def test_gns_files_of_one_shape_open_without_pickle(tmp_path, dim):
    """As geoelements' loader takes them apart, and with pickles refused."""
    header = make_header(dim=dim)
    path, position = write(tmp_path / "a.npz", header, make_frames(header, 6))
    assert np.load(path, allow_pickle=False)["gns_data"].shape == (1,)
    data = geoelements(path)
    assert [x.shape[0] for x, _ in data] == [6]
    positions, types = data[0]
    assert len(data[0]) == 2
    np.testing.assert_array_equal(positions, position)
    np.testing.assert_array_equal(np.full(30, types, dtype=int), header.particle_type)
    windows = torch.tensor(np.transpose(data[0][0][1:5], (1, 0, 2)))
    assert windows.shape == (30, 4, dim)


def test_gns_files_of_several_shapes_hold_a_pair_for_each(tmp_path):
    """One member per motion; no member gns_data."""
    generator = np.random.default_rng(0)
    shapes = [(4, 7, 2), (5, 9, 2), (4, 7, 2)]
    arrays = [generator.random(shape, dtype=np.float32) for shape in shapes]
    motions = [
        StoredMotion(
            particle_type=np.arange(array.shape[1]) % 9,
            shape=array.shape,
            frames=lambda array=array: iter(array),
        )
        for array in arrays
    ]
    assert not write_gns_file(tmp_path / "a.npz", motions)
    data = geoelements(tmp_path / "a.npz")
    assert len(data) == 3
    for (positions, types), array in zip(data, arrays, strict=True):
        np.testing.assert_array_equal(positions, array)
        np.testing.assert_array_equal(types, np.arange(array.shape[1]) % 9)


@pytest.mark.parametrize("dim", [2, 3])
def test_trimesh_reads_a_ply_sequence_back(tmp_path, dim):
    """Points, speed and types of every file."""
    trimesh = pytest.importorskip("trimesh")
    header = make_header(dim=dim)
    folder, position = write(tmp_path / "a.ply", header, make_frames(header, 3))
    files = sorted(folder.iterdir())
    assert len(files) == 3
    for frame, file in enumerate(files):
        cloud = trimesh.load(file)
        np.testing.assert_array_equal(cloud.vertices[:, :dim], position[frame])
        assert not cloud.vertices[:, dim:].any()
        data = cloud.metadata["_ply_raw"]["vertex"]["data"]
        np.testing.assert_array_equal(data["particle_type"], header.particle_type)
        np.testing.assert_allclose(data["speed"], speeds(position)[frame], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("extension", sorted(set(EXTENSIONS) - {".mp4"}))
@pytest.mark.parametrize("dim", [2, 3])
def test_a_motion_of_one_frame_is_written(tmp_path, extension, dim):
    header = make_header(dim=dim)
    path, position = write(tmp_path / f"a{extension}", header, make_frames(header, 1))
    assert path.exists()
    if extension == ".npz":
        np.testing.assert_array_equal(geoelements(path)[0][0], position)


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("frames", [0, 1, 5])
def test_an_interrupted_writer_leaves_nothing(tmp_path, extension, frames):
    """Not even a hidden file; what stood there before stays."""
    header = make_header()
    path = tmp_path / f"a{extension}"
    if extension != ".ply":
        path.write_text("earlier")
    before = sorted(tmp_path.iterdir())

    def interrupted():
        with open_writer(path, header) as writer:
            for frame in make_frames(header, frames):
                writer.append(frame)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert sorted(tmp_path.iterdir()) == before
    if before:
        assert path.read_text() == "earlier"


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_motion_without_a_frame_is_refused(tmp_path, extension):
    with (
        pytest.raises(ValueError, match="no frame"),
        open_writer(tmp_path / f"a{extension}", make_header()),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", [".h5", ".npz", ".vtkhdf", ".ply", ".usd"])
def test_frames_are_copied_when_they_arrive(tmp_path, extension):
    """A simulator may step in place."""
    header = make_header()
    frames = list(make_frames(header, 3))
    write(tmp_path / f"plain{extension}", header, frames)
    buffer = torch.empty_like(frames[0])
    with open_writer(tmp_path / f"reused{extension}", header) as writer:
        for frame in frames:
            buffer.copy_(frame)
            writer.append(buffer)
            buffer.fill_(-1.0)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    plain, reused = files[: len(files) // 2], files[len(files) // 2 :]
    assert [p.read_bytes() for p in plain] == [p.read_bytes() for p in reused]


@pytest.mark.parametrize("extension", [".h5", ".npz", ".vtkhdf", ".ply"])
def test_memory_does_not_grow_with_the_motion(tmp_path, extension):
    """The peak of NumPy's and Python's memory stays far below the motion's 12 MB."""
    header = make_header(particles=10_000)
    frames = make_frames(header, 100)
    with open_writer(tmp_path / f"a{extension}", header) as writer:
        for frame in islice(frames, 2):
            writer.append(frame)
        tracemalloc.start()
        for frame in frames:
            writer.append(frame)
        writer.finish()
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        writer.finish = lambda: None
    assert peak < 4e6, peak


def test_usd_memory_does_not_grow_with_the_motion(tmp_path, monkeypatch):
    """Anonymous memory of the process grows by the unsaved samples, not by all 32 MB."""
    pytest.importorskip("pxr")
    monkeypatch.setattr("giorom.export.usd.SAVE_BYTES", 1 << 20)
    header = make_header(particles=20_000)
    frames = make_frames(header, 120)
    with open_writer(tmp_path / "a.usd", header) as writer:
        for frame in islice(frames, 20):
            writer.append(frame)
        before = anonymous_bytes()
        for frame in frames:
            writer.append(frame)
        assert anonymous_bytes() - before < 12e6
    assert (tmp_path / "a.usd").stat().st_size > 24e6


def anonymous_bytes() -> int:
    """Memory of this process that is no mapped file."""
    try:
        with open("/proc/self/status") as status:
            lines = [line for line in status if line.startswith("RssAnon")]
    except OSError:
        pytest.skip("this system does not say")
    return 1024 * int(lines[0].split()[1])


def test_a_frame_that_does_not_fit_is_refused(tmp_path):
    """Shape, numbers and fields; the error names the frame."""
    header = make_header(fields=("error",))
    frame, error = next(make_frames(header, 1)), torch.zeros(30)
    broken = frame.clone()
    broken[3, 1] = torch.inf
    wrong = {
        "shape": ((frame[:-1],), {"error": error}),
        "finite": ((broken,), {"error": error}),
        "float32": ((frame.double() * 1e300,), {"error": error}),
        "announces": ((frame,), {}),
        "one number for each": ((frame,), {"error": error[1:]}),
        "brings the fields": ((frame,), {"error": error, "more": error}),
    }

    def add(positional, named):
        with open_writer(tmp_path / "a.vtkhdf", header) as writer:
            writer.append(frame, error=error)
            writer.append(*positional, **named)

    for words, (positional, named) in wrong.items():
        with pytest.raises(ValueError, match=words) as caught:
            add(positional, named)
        assert "frame 1 " in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame_dt": 0.0}, "frame_dt"),
        ({"frame_dt": float("nan")}, "frame_dt"),
        ({"particle_type": torch.zeros(0, dtype=torch.long)}, "at least one particle"),
        ({"particle_type": torch.tensor([5, 9])}, "Renumber"),
        ({"particle_type": torch.tensor([-1, 5])}, "Renumber"),
        ({"bounds": torch.zeros(4, 2)}, "4 axes"),
        ({"fields": ("speed",)}, "taken"),
        ({"fields": ("a", "a")}, "repeat"),
    ],
)
def test_a_header_that_no_format_can_hold_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        make_header(**change)


def test_a_motion_larger_than_the_disk_is_refused(tmp_path):
    """Before the folder is made."""
    with pytest.raises(ValueError, match="GiB free"):
        check_room(tmp_path / "new" / "a.h5", make_header(), frames=10**15)
    assert list(tmp_path.iterdir()) == []


FULL_DISK = """
import resource, sys, torch
from pathlib import Path
from giorom.export import MotionHeader, open_writer
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
header = MotionHeader(
    particle_type=torch.full((2000,), 5), frame_dt=0.1, bounds=torch.tensor([[0.0, 1.0]] * 3)
)
for extension in sys.argv[1:]:
    frames = 0
    try:
        with open_writer(Path("a" + extension), header) as writer:
            for frames in range(50):
                writer.append(torch.rand(2000, 3))
    except OSError as error:
        print(extension, "\\n" in str(error), frames < 49)
"""


def test_a_full_disk_is_an_error_and_not_a_crash(tmp_path):
    """The system refuses to make files larger than 200 kB; 1.2 MB are written to each.

    Nothing is left, and the process ends well (HDF5 would crash at exit). The formats that keep
    nothing say so before the last frame.
    """
    pytest.importorskip("resource")
    pytest.importorskip("pxr")
    extensions = [".h5", ".vtkhdf", ".npz", ".usdc", ".usda"]
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", FULL_DISK, *extensions],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([os.getcwd(), *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    found = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines()}
    assert list(found) == extensions
    assert {lines for lines, _ in found.values()} == {"False"}
    assert found[".npz"] == ["False", "True"]
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_was_cut_off_is_noticed(tmp_path):
    """The encoder reports no failure: every shorter file is refused."""

    def box(kind: bytes, content: bytes) -> bytes:
        return (8 + len(content)).to_bytes(4, "big") + kind + content

    film = box(b"ftyp", b"isom") + box(b"moov", b"index") + box(b"mdat", b"pictures")
    path = tmp_path / "a.mp4"
    path.write_bytes(film)
    _check_film(path)
    endless = b"\0\0\0\1mdat" + bytes(8)
    for cut in (endless, *(film[:length] for length in range(len(film)))):
        path.write_bytes(cut)
        with pytest.raises(OSError, match="disk full"):
            _check_film(path)
