"""What is exported can be read back, and pictures show something."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from giorom.data.trajectory_file import read_trajectory_file
from giorom.export import EXTENSIONS, write_contact_sheet, write_trajectory
from giorom.export.scene import frame_scene, particle_diameter
from giorom.state import ELASTIC, KINEMATIC, Trajectory


def make_trajectory(*, frames: int = 4, dim: int = 3, shift: float = 0.0, kinematic: int = 40):
    """A block of 10^dim particles that falls and shears; the first ones are prescribed."""
    axis = torch.linspace(0.4, 0.6, 10)
    block = torch.stack(torch.meshgrid(*[axis] * dim, indexing="ij"), dim=-1).reshape(-1, dim)
    time = torch.arange(frames, dtype=torch.float32)[:, None, None] / max(1, frames - 1)
    motion = torch.zeros(frames, len(block), dim)
    motion[..., 1:2] = -0.3 * time**2
    motion[..., 0:1] = shift * time + 0.2 * time * block[:, 1:2]
    particle_type = torch.full((len(block),), ELASTIC)
    particle_type[:kinematic] = KINEMATIC
    return Trajectory(
        position=block + motion,
        particle_type=particle_type,
        frame_dt=2.5e-3,
        bounds=torch.tensor([[0.0, 1.0]] * dim),
    )


def read_film(path) -> np.ndarray:
    """Every frame of a film of two panels, 1280 x 648 pixels, shape (frames, 648, 1280, 3)."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [ffmpeg, "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = subprocess.run(command, capture_output=True, check=True).stdout  # noqa: S603
    return np.frombuffer(pixels, np.uint8).reshape(-1, 648, 1280, 3)


def speed(trajectory) -> np.ndarray:
    """Distance per time of the step that ends at each frame; the first takes the second's."""
    position = trajectory.position.double().numpy()
    steps = np.linalg.norm(np.diff(position, axis=0), axis=2) / trajectory.frame_dt
    return np.concatenate([steps[:1], steps])


def inked(image: np.ndarray) -> float:
    """Share of coloured pixels: neither white nor grey."""
    return float((np.ptp(image.astype(int), axis=-1) > 40).mean())


@pytest.mark.parametrize("dim", [2, 3])
def test_vtk_reads_a_vtkhdf_file_back(tmp_path, dim):
    """VTK's own reader gives every frame's points and numbers, exactly."""
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    trajectory = make_trajectory(dim=dim)
    truth = make_trajectory(dim=dim, shift=0.1)
    path = write_trajectory(trajectory, tmp_path / "motion.vtkhdf", truth=truth)
    reader = hdf.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 4
    error = (trajectory.position - truth.position).norm(dim=2)
    for frame in (3, 0, 2):
        reader.SetStep(frame)
        reader.Update()
        data = reader.GetOutputDataObject(0)
        assert reader.GetTimeValue() == pytest.approx(frame * 2.5e-3)
        assert data.GetNumberOfVerts() == trajectory.position.shape[1]
        points = vtk_to_numpy(data.GetPoints().GetData())
        np.testing.assert_array_equal(points[:, :dim], trajectory.position[frame])
        assert not points[:, dim:].any()
        fields = data.GetPointData()
        found = {name: vtk_to_numpy(fields.GetArray(name)) for name in ("speed", "error")}
        np.testing.assert_allclose(found["speed"], speed(trajectory)[frame], rtol=2e-5)
        np.testing.assert_allclose(found["error"], error[frame], rtol=1e-6)
        types = vtk_to_numpy(fields.GetArray("particle_type"))
        np.testing.assert_array_equal(types, trajectory.particle_type)


def test_vtk_reads_a_ply_sequence_back(tmp_path):
    """One file per frame with the frame's points; an earlier, longer sequence is gone."""
    pyvista = pytest.importorskip("pyvista")
    write_trajectory(make_trajectory(frames=6), tmp_path / "motion.ply")
    trajectory = make_trajectory()
    folder = write_trajectory(trajectory, tmp_path / "motion.ply")
    files = sorted(folder.iterdir())
    assert [path.name for path in files] == [f"motion_{i:05d}.ply" for i in range(4)]
    points = pyvista.read(files[2]).points
    np.testing.assert_array_equal(points, trajectory.position[2])
    header, _, content = files[2].read_bytes().partition(b"end_header\n")
    kind = [("xyz", "<f4", 3), ("speed", "<f4"), ("particle_type", "u1")]
    record = np.frombuffer(content, dtype=kind)
    assert b"property uchar particle_type" in header
    np.testing.assert_allclose(record["speed"], speed(trajectory)[2], rtol=2e-5)
    np.testing.assert_array_equal(record["particle_type"], trajectory.particle_type)


def test_a_ply_sequence_does_not_replace_a_folder_of_other_things(tmp_path):
    (tmp_path / "motion").mkdir()
    (tmp_path / "motion" / "thesis.tex").write_text("precious")
    with pytest.raises(ValueError, match="nothing is written over it"):
        write_trajectory(make_trajectory(), tmp_path / "motion.ply")


@pytest.mark.parametrize("dim", [2, 3])
def test_a_film_has_a_frame_for_each_and_shows_both_motions(tmp_path, dim):
    """Both halves hold coloured pixels in every frame, and the picture changes."""
    pytest.importorskip("pyvista")
    trajectory, truth = make_trajectory(dim=dim, frames=5), make_trajectory(dim=dim, frames=5)
    film = read_film(write_trajectory(trajectory, tmp_path / "film.mp4", truth=truth))
    frames, height, width, _ = film.shape
    assert frames == 5
    panels = film[:, : height - 100]
    for image in panels:
        halves = image[:, : width // 2], image[:, width // 2 :]
        assert min(inked(half) for half in halves) > 0.01
        # The same motion in both panels: the halves agree but for the headings and compression.
        difference = np.abs(halves[0][60:].astype(int) - halves[1][60:].astype(int))
        assert difference.mean() < 1.0
    assert np.abs(panels[0].astype(int) - panels[-1].astype(int)).mean() > 1.0
    assert b"avc1" in (tmp_path / "film.mp4").read_bytes()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_contact_sheet_shows_both_motions(tmp_path, dim):
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("pyvista")
    trajectory, truth = make_trajectory(dim=dim), make_trajectory(dim=dim, shift=0.1)
    path = tmp_path / "sheet.png"
    write_contact_sheet(trajectory, path, truth=truth, frames=[0, 3])
    image = imageio.imread(path)
    assert image.shape == (2 * 400 + 88, 2 * 400, 3)
    for row in (0, 400):
        for column in (0, 400):
            assert inked(image[row : row + 400, column : column + 400]) > 0.01
    grey = np.ptp(image.astype(int), axis=-1) < 10
    assert (grey & (image[..., 0] > 60) & (image[..., 0] < 160)).any()  # kinematic particles


def test_drawing_without_a_display_is_silent(tmp_path):
    """No complaint about a missing X server on either stream."""
    pytest.importorskip("pyvista")
    code = (
        "import torch; from pathlib import Path; from giorom.state import Trajectory\n"
        "from giorom.export import write_contact_sheet\n"
        "t = Trajectory(position=torch.rand(2, 9, 2), particle_type=torch.full((9,), 5),\n"
        "    frame_dt=0.1, bounds=torch.tensor([[0.0, 1.0]] * 2))\n"
        "write_contact_sheet(t, Path('sheet.png'), frames=[1])\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    environment["PYTHONPATH"] = os.pathsep.join([os.getcwd(), *sys.path])
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_both_panels_share_the_colour_scale():
    """Its end is the next round number above the largest displacement of either motion."""
    near, far = make_trajectory(), make_trajectory(shift=1.0)
    largest = float((far.position[-1] - far.position[0]).norm(dim=1).max())
    limit = frame_scene([near, far]).color_limit
    assert largest <= limit <= 1.5 * largest
    assert limit == frame_scene([far]).color_limit


def test_spheres_have_the_spacing_of_the_particles():
    """On a regular grid the 2 d-th neighbour is one spacing away."""
    spacing = 0.2 / 9
    for dim in (2, 3):
        found = particle_diameter(make_trajectory(dim=dim, kinematic=0))
        assert found == pytest.approx(1.2 * spacing, rel=1e-3)


def test_motions_of_different_length_are_not_shown_side_by_side(tmp_path):
    pytest.importorskip("pyvista")
    with pytest.raises(ValueError, match="must agree in frames and dimension"):
        write_trajectory(make_trajectory(), tmp_path / "film.mp4", truth=make_trajectory(frames=3))
    assert list(tmp_path.iterdir()) == []


def test_a_trajectory_file_is_an_export_too(tmp_path):
    trajectory = make_trajectory()
    path = write_trajectory(trajectory, tmp_path / "motion.h5")
    assert torch.equal(read_trajectory_file(path).position, trajectory.position)


@pytest.mark.parametrize("name", ["motion.xyz", "motion"])
def test_an_unknown_extension_names_the_known_ones(tmp_path, name):
    with pytest.raises(ValueError, match="names no format") as caught:
        write_trajectory(make_trajectory(), tmp_path / name)
    assert all(extension in str(caught.value) for extension in EXTENSIONS)


@pytest.mark.parametrize("extension", [".vtkhdf", ".mp4", ".png"])
def test_a_failed_export_leaves_nothing_half_written(tmp_path, monkeypatch, extension):
    """The earlier file stays, and no temporary one."""
    pytest.importorskip("pyvista")
    path = tmp_path / f"motion{extension}"
    path.write_text("earlier")
    stops = {
        ".vtkhdf": "giorom.export.vtkhdf._write_steps",
        ".mp4": "giorom.export.drawing.Canvas.image",
        ".png": "giorom.export.drawing.Canvas.image",
    }

    def fail(*_args, **_kwargs):
        raise RuntimeError("disk full")

    monkeypatch.setattr(stops[extension], fail)
    with pytest.raises(RuntimeError, match="disk full"):
        write_trajectory(make_trajectory(), path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "earlier"
