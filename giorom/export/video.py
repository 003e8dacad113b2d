"""Pictures and films of a motion, beside the truth if there is one, without a display.

Particles are shaded spheres coloured by their displacement from the first frame, on a scale that
colour-blind readers can follow; prescribed particles are grey. All panels share the camera and the
colour range (``giorom.export.scene``). Axis 1 points up. A film is H.264 in yuv420p at an even
size, which every player opens; a contact sheet shows a few frames in one PNG.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.atomic import replacing
from giorom.export.scene import Scene, displacement, frame_scene, in_space, particle_diameter
from giorom.state import Trajectory

__all__ = ["write_contact_sheet", "write_film"]

COLOR_MAP = "viridis"
"""Perceptually even and legible with every common colour blindness."""

KINEMATIC_COLOR = "#a8a8a8"
INK = "#202020"

STRIP_HEIGHT = 84
"""Height of the strip with the colour scale and the time [pixels]."""

FILM_PANEL = (640, 560)
SHEET_PANEL = (400, 400)
"""Width and height of one panel [pixels]."""

TITLES = ("predicted", "ground truth")


def write_film(
    trajectory: Trajectory, path: Path, *, truth: Trajectory | None = None, frame_rate: int = 30
) -> Path:
    """Film every frame of a motion as MP4.

    Args:
        trajectory: The motion; the left panel.
        path: File to create or replace, ending in ``.mp4``.
        truth: The motion it should have been, at the same frames; the right panel.
        frame_rate: Frames per second of the film.

    Returns:
        The path.

    Raises:
        ValueError: If the two motions differ in frames or dimension.
    """
    import imageio_ffmpeg

    motions, titles = _motions(trajectory, truth)
    size = (FILM_PANEL[0] * len(motions), FILM_PANEL[1] + STRIP_HEIGHT)
    with replacing(path) as temporary, _plotter(size, (1, len(motions))) as plotter:
        scene = frame_scene(motions)
        panels = []
        for column, (motion, title) in enumerate(zip(motions, titles, strict=True)):
            plotter.subplot(0, column)
            panels.append(_add_panel(plotter, scene, motion, frame=0, size=FILM_PANEL))
            _label(plotter, title, (0.5, 0.965), size=20)
        clock = _add_strip(plotter, scene, row=1, text=_time(motions[0], 0))
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            size,
            fps=frame_rate,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            quality=None,
            ffmpeg_log_level="error",
            output_params=["-crf", "18", "-preset", "veryfast", "-movflags", "+faststart"],
        )
        writer.send(None)
        try:
            for frame in range(motions[0].frame_count):
                for panel in panels:
                    panel.show(frame)
                clock.SetInput(_time(motions[0], frame))
                writer.send(_image(plotter))
        finally:
            writer.close()
    return path


def write_contact_sheet(
    trajectory: Trajectory,
    path: Path,
    *,
    truth: Trajectory | None = None,
    frames: Sequence[int] | None = None,
) -> Path:
    """Show a few frames of a motion in one PNG, a row for the motion and one for the truth.

    Args:
        trajectory: The motion; the upper row.
        path: File to create or replace, ending in ``.png``.
        truth: The motion it should have been, at the same frames; the lower row.
        frames: Which frames; five from the first to the last by default.

    Returns:
        The path.

    Raises:
        ValueError: If the motions differ in frames or dimension.
    """
    motions, titles = _motions(trajectory, truth)
    last = trajectory.frame_count - 1
    chosen = sorted(set(np.linspace(0, last, 5).round().astype(int).tolist()))
    chosen = list(frames) if frames is not None else chosen
    width, height = SHEET_PANEL
    size = (width * len(chosen), height * len(motions) + STRIP_HEIGHT)
    with replacing(path) as temporary, _plotter(size, (len(motions), len(chosen))) as plotter:
        scene = frame_scene(motions)
        for row, (motion, title) in enumerate(zip(motions, titles, strict=True)):
            for column, frame in enumerate(chosen):
                plotter.subplot(row, column)
                _add_panel(plotter, scene, motion, frame=frame, size=SHEET_PANEL)
                if row == 0:
                    _label(plotter, _time(motion, frame), (0.5, 0.955), size=16)
                if column == 0 and title:
                    _label(plotter, title, (0.05, 0.5), size=18, angle=90.0)
        _add_strip(plotter, scene, row=len(motions), text="")
        _write_png(_image(plotter), temporary)
    return path


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """One motion in one panel: the points on the screen and where they come from."""

    motion: Trajectory
    free: Any
    fixed: Any

    def show(self, frame: int) -> None:
        """Move the points to a frame."""
        kinematic = self.motion.kinematic
        position = self.motion.position[frame]
        if self.fixed is not None:
            self.fixed.points = in_space(position[kinematic])
        if self.free is not None:
            self.free.points = in_space(position[~kinematic])
            self.free["displacement"] = _numbers(displacement(self.motion, frame)[~kinematic])


@contextmanager
def _plotter(size: tuple[int, int], panels: tuple[int, int]) -> Iterator[Any]:
    """An off-screen plotter with a strip under rows and columns of panels."""
    import pyvista

    rows, columns = panels
    height = (size[1] - STRIP_HEIGHT) / rows
    with _without_display():
        plotter = pyvista.Plotter(
            off_screen=True,
            window_size=list(size),
            shape=(rows + 1, columns),
            row_weights=[height] * rows + [STRIP_HEIGHT],
            groups=[(rows, list(range(columns)))],
            border=False,
            lighting="none",
        )
    plotter.set_background("white", all_renderers=True)
    try:
        yield plotter
    finally:
        plotter.close()


@contextmanager
def _without_display() -> Iterator[None]:
    """Let VTK choose EGL at once where there is no X server, instead of complaining first."""
    name = "VTK_DEFAULT_OPENGL_WINDOW"
    if os.name != "posix" or os.environ.get("DISPLAY") or name in os.environ:
        yield
        return
    os.environ[name] = "vtkEGLRenderWindow"
    try:
        yield
    finally:
        del os.environ[name]


def _add_panel(
    plotter: Any, scene: Scene, motion: Trajectory, *, frame: int, size: tuple[int, int]
) -> _Panel:
    """Draw one motion into the current panel."""
    import pyvista

    scale = scene.parallel_scale(aspect=size[0] / size[1])
    style = {
        "style": "points",
        "render_points_as_spheres": True,
        "point_size": max(2.0, particle_diameter(motion) * size[1] / (2.0 * scale)),
        "show_scalar_bar": False,
        "ambient": 0.25,
        "diffuse": 0.75,
        "specular": 0.15,
        "specular_power": 15.0,
    }
    kinematic = motion.kinematic
    free = fixed = None
    if bool(kinematic.any()):
        fixed = pyvista.PolyData(in_space(motion.position[frame][kinematic]))
        plotter.add_mesh(fixed, color=KINEMATIC_COLOR, **style)
    if not bool(kinematic.all()):
        free = pyvista.PolyData(in_space(motion.position[frame][~kinematic]))
        free["displacement"] = _numbers(displacement(motion, frame)[~kinematic])
        limits = [0.0, scene.color_limit]
        plotter.add_mesh(free, scalars="displacement", cmap=COLOR_MAP, clim=limits, **style)
    _draw_domain(plotter, motion)
    _set_camera(plotter, scene, scale)
    return _Panel(motion=motion, free=free, fixed=fixed)


def _draw_domain(plotter: Any, motion: Trajectory) -> None:
    """Draw the floor of the domain, or its outline in 2-D."""
    import pyvista

    low, high = in_space(motion.bounds.T)
    if motion.position.shape[2] == 2:
        corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
        outline = np.array([[x, y, 0.0] for x, y in [*corners, corners[0]]], dtype=np.float32)
        plotter.add_mesh(pyvista.lines_from_points(outline), color="#808080", line_width=1.5)
        return
    middle = (low + high) / 2
    floor = pyvista.Plane(
        center=(middle[0], low[1], middle[2]),
        direction=(0.0, 1.0, 0.0),
        i_size=high[2] - low[2],
        j_size=high[0] - low[0],
    )
    plotter.add_mesh(floor, color="#ececec", lighting=False)
    plotter.add_mesh(floor.extract_feature_edges(), color="#b0b0b0", line_width=1.5)


def _set_camera(plotter: Any, scene: Scene, scale: float) -> None:
    """Aim the current panel's camera and put the light beside it."""
    import pyvista

    center, direction = np.array(scene.center), np.array(scene.direction)
    camera = plotter.camera
    camera.focal_point = tuple(center)
    camera.position = tuple(center + scene.depth * direction)
    camera.up = (0.0, 1.0, 0.0)
    camera.parallel_projection = True
    camera.parallel_scale = scale
    camera.clipping_range = (0.01 * scene.depth, 3.0 * scene.depth)
    plotter.add_light(pyvista.Light(light_type="headlight", intensity=0.55))
    key = pyvista.Light(light_type="camera light", intensity=0.65)
    key.position = (-0.5, 1.0, 1.0)
    plotter.add_light(key)


def _add_strip(plotter: Any, scene: Scene, *, row: int, text: str) -> Any:
    """Draw the colour scale and a line of text under the panels; return the text."""
    import pyvista

    plotter.subplot(row, 0)
    table = pyvista.LookupTable(COLOR_MAP, scalar_range=(0.0, scene.color_limit))
    mapper = pyvista.DataSetMapper(pyvista.PolyData(np.zeros((1, 3), dtype=np.float32)))
    mapper.lookup_table = table
    plotter.add_scalar_bar(
        title="displacement [m]",
        mapper=mapper,
        color=INK,
        n_labels=5,
        fmt="%.2f",
        width=0.4,
        height=0.75,
        position_x=0.3,
        position_y=0.12,
        title_font_size=17,
        label_font_size=15,
        unconstrained_font_size=True,
    )
    return _label(plotter, text, (0.12, 0.5), size=18)


def _label(
    plotter: Any, text: str, at: tuple[float, float], *, size: int, angle: float = 0.0
) -> Any:
    """Write text centred at a point of the current panel, in shares of its size."""
    import pyvista

    label = pyvista.Text(text, prop=pyvista.TextProperty(color=INK, font_size=size, bold=False))
    label.prop.justification_horizontal = "center"
    label.prop.justification_vertical = "center"
    label.prop.orientation = angle
    label.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
    label.GetPositionCoordinate().SetValue(*at)
    plotter.add_actor(label)
    return label


def _image(plotter: Any) -> np.ndarray:
    """Draw and read back the picture, shape (height, width, 3)."""
    plotter.render()
    return np.ascontiguousarray(plotter.screenshot(None, return_img=True))


def _write_png(image: np.ndarray, path: Path) -> None:
    """Store a picture."""
    import imageio.v3

    imageio.v3.imwrite(path, image)


def _motions(
    trajectory: Trajectory, truth: Trajectory | None
) -> tuple[list[Trajectory], list[str]]:
    """The motions of a picture and their titles; one alone needs none."""
    if truth is None:
        return [trajectory], [""]
    return [trajectory, truth], list(TITLES)


def _time(motion: Trajectory, frame: int) -> str:
    """The time stamp of a frame."""
    return f"t = {frame * motion.frame_dt:.3f} s"


def _numbers(values: Any) -> np.ndarray:
    """A tensor as a float32 array."""
    return values.detach().cpu().numpy().astype(np.float32)
