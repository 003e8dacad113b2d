"""Draw motions off-screen with VTK: panels, labels and the colour scale of one picture.

Particles are shaded spheres coloured by displacement; prescribed particles are grey. Everything is
drawn larger than needed by ``sharpness`` and scaled down by whoever stores the picture, because
neither the edges of spheres nor software rendering are smoothed otherwise. Sizes in
this module are pixels of the stored picture.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from giorom.export.scene import Scene, displacement, in_space, particle_diameter
from giorom.state import Trajectory

__all__ = ["STRIP_HEIGHT", "Canvas", "Panel", "canvas"]

COLOR_MAP = "viridis"
"""Perceptually even and legible with every common colour blindness."""

KINEMATIC_COLOR, INK, LINE, FLOOR, SHADOW = "#8c8c8c", "#202020", "#a8a8a8", "#f1f1f1", "#d9d9d9"

STRIP_HEIGHT = 88
"""Height of the strip with the colour scale under the panels."""

FLOOR_LIFT = 1e-3
"""How far edge and shadow lie above the floor, as a share of the picture's height."""

MATERIAL = {"ambient": 0.38, "diffuse": 0.68, "specular": 0.12, "specular_power": 20.0}


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One motion in one panel: the points on the screen and where they come from."""

    motion: Trajectory
    free: Any
    fixed: Any
    shadow: Any

    def show(self, frame: int) -> None:
        """Move the points to a frame.

        Args:
            frame: Number of the frame.
        """
        kinematic = self.motion.kinematic
        position = self.motion.position[frame]
        if self.shadow is not None:
            points = in_space(position)
            points[:, 1] = self.shadow.bounds.y_min
            self.shadow.points = points
        if self.fixed is not None:
            self.fixed.points = in_space(position[kinematic])
        if self.free is not None:
            self.free.points = in_space(position[~kinematic])
            moved = displacement(self.motion, frame)[~kinematic]
            self.free["displacement"] = moved.detach().cpu().numpy().astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """A picture of rows and columns of panels over a strip with the colour scale."""

    plotter: Any
    scene: Scene
    panel_size: tuple[int, int]
    sharpness: float
    reader: Any

    def add_panel(self, motion: Trajectory, *, row: int, column: int) -> Panel:
        """Draw the first frame of a motion.

        Args:
            motion: The motion.
            row: Row of the panel.
            column: Column of the panel.

        Returns:
            The panel, which can show other frames.
        """
        import pyvista

        self.plotter.subplot(row, column)
        width, height = self.panel_size
        scale = self._set_camera(aspect=width / height)
        pixels = particle_diameter(motion) * self.sharpness * height / (2.0 * scale)
        style = {
            "style": "points",
            "render_points_as_spheres": True,
            "point_size": max(2.0, pixels),
            "show_scalar_bar": False,
            "reset_camera": False,
            **MATERIAL,
        }
        shadow = self._draw_floor(motion, pixels) if motion.position.shape[2] == 3 else None
        panel = {"motion": motion, "free": None, "fixed": None, "shadow": shadow}
        if bool(motion.kinematic.any()):
            panel["fixed"] = pyvista.PolyData(in_space(motion.position[0][motion.kinematic]))
            self.plotter.add_mesh(panel["fixed"], color=KINEMATIC_COLOR, **style)
        if not bool(motion.kinematic.all()):
            panel["free"] = pyvista.PolyData(in_space(motion.position[0][~motion.kinematic]))
            panel["free"]["displacement"] = np.zeros(panel["free"].n_points, dtype=np.float32)
            style |= {"scalars": "displacement", "cmap": COLOR_MAP}
            self.plotter.add_mesh(panel["free"], clim=[0.0, self.scene.color_limit], **style)
        self._draw_outline()
        self.plotter.renderer.ResetCameraClippingRange()
        return Panel(**panel)

    def add_label(
        self, text: str, at: tuple[float, float], *, size: int, angle: float = 0.0
    ) -> Any:
        """Write text centred at a point of the current panel.

        Args:
            text: What to write.
            at: The point, as shares of the panel's width and height.
            size: Height of the letters.
            angle: Turn against the clock [degrees].

        Returns:
            The text actor; ``SetInput`` changes what it says.
        """
        label = self.plotter.add_text(
            text or " ", position=at, viewport=True, color=INK, font="arial", render=False
        )
        label.prop.font_size = round(size * self.sharpness)
        label.prop.SetJustificationToCentered()
        label.prop.SetVerticalJustificationToCentered()
        label.prop.orientation = angle
        return label

    def add_strip(self, *, row: int, text: str = "") -> Any:
        """Draw the colour scale under the panels, and a text to its left.

        Args:
            row: Number of the strip's row.
            text: What the text says.

        Returns:
            The text actor.
        """
        import pyvista

        self.plotter.subplot(row, 0)
        mapper = pyvista.DataSetMapper(pyvista.PolyData(np.zeros((1, 3), dtype=np.float32)))
        mapper.lookup_table = pyvista.LookupTable(
            COLOR_MAP, scalar_range=(0.0, self.scene.color_limit)
        )
        self.plotter.add_scalar_bar(
            title="",
            mapper=mapper,
            color=INK,
            n_labels=5,
            fmt="%.3g",
            width=0.36,
            height=0.58,
            position_x=0.32,
            position_y=0.1,
            label_font_size=round(15 * self.sharpness),
            font_family="arial",
            unconstrained_font_size=True,
        )
        self.add_label("displacement [m]", (0.5, 0.84), size=16)
        return self.add_label(text, (0.16, 0.42), size=18)

    def image(self) -> np.ndarray:
        """Draw everything.

        Returns:
            The picture, shape (height, width, 3), ``sharpness`` times as large as stored.
        """
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self.plotter.render_window.Render()
        self.reader.Modified()
        self.reader.Update()
        picture = self.reader.GetOutput()
        width, height, _ = picture.GetDimensions()
        pixels = vtk_to_numpy(picture.GetPointData().GetScalars())
        return np.ascontiguousarray(pixels.reshape(height, width, -1)[::-1, :, :3])

    def _draw_outline(self) -> None:
        """Draw the edge of the floor, or in 2-D of the domain."""
        import pyvista

        if self.scene.floor is not None:
            corners = np.array(self.scene.floor, dtype=np.float32)
            corners[:, 1] += FLOOR_LIFT * self.scene.half_height
            outline = pyvista.lines_from_points(np.concatenate([corners, corners[:1]]))
            style = {"color": LINE, "line_width": self.sharpness, "lighting": False}
            self.plotter.add_mesh(outline, reset_camera=False, **style)

    def _draw_floor(self, motion: Trajectory, pixels: float) -> Any:
        """Draw the floor of a 3-D motion; return the points of the shadow on it."""
        import pyvista

        if self.scene.floor is None:
            return None
        corners = np.array(self.scene.floor, dtype=np.float32)
        floor = pyvista.PolyData(corners, faces=[4, 0, 1, 2, 3])
        self.plotter.add_mesh(floor, color=FLOOR, lighting=False, reset_camera=False)
        points = in_space(motion.position[0])
        points[:, 1] = corners[0, 1] + FLOOR_LIFT * self.scene.half_height
        shadow = pyvista.PolyData(points)
        style = {"style": "points", "point_size": pixels, "lighting": False}
        self.plotter.add_mesh(shadow, color=SHADOW, reset_camera=False, **style)
        return shadow

    def _set_camera(self, *, aspect: float) -> float:
        """Aim the current panel's camera and put the lights beside it; return its half height."""
        import pyvista

        camera = self.plotter.camera
        focus, place, scale = self.scene.camera(aspect=aspect)
        camera.focal_point, camera.position = tuple(focus), tuple(place)
        camera.up = (0.0, 1.0, 0.0)
        camera.parallel_projection = True
        camera.parallel_scale = scale
        self.plotter.camera_set = True
        headlight = pyvista.Light(light_type="headlight", intensity=0.35)
        self.plotter.add_light(headlight, only_active=True)
        key = pyvista.Light(light_type="camera light", intensity=0.75)
        key.position = (-0.6, 1.0, 0.8)
        self.plotter.add_light(key, only_active=True)
        return scale


@contextmanager
def canvas(
    scene: Scene,
    *,
    panel_size: tuple[int, int],
    rows: int,
    columns: int,
    sharpness: float,
) -> Iterator[Canvas]:
    """Open an empty picture, and close it at the end of the block.

    Args:
        scene: Camera and colour range.
        panel_size: Width and height of one panel.
        rows: Rows of panels.
        columns: Columns of panels.
        sharpness: How much larger than stored to draw.

    Yields:
        The canvas.
    """
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    width, height = panel_size
    size = (width * columns, height * rows + STRIP_HEIGHT)
    with _without_display():
        plotter = pyvista.Plotter(
            off_screen=True,
            window_size=[round(length * sharpness) for length in size],
            shape=(rows + 1, columns),
            row_weights=[height] * rows + [STRIP_HEIGHT],
            groups=[(rows, list(range(columns)))],
            border=False,
            lighting="none",
        )
    try:
        plotter.set_background("white", all_renderers=True)
        plotter.render_window.SetMultiSamples(0)
        reader = vtkWindowToImageFilter()
        reader.SetInput(plotter.render_window)
        reader.ReadFrontBufferOff()
        reader.ShouldRerenderOff()
        yield Canvas(
            plotter=plotter,
            scene=scene,
            panel_size=panel_size,
            sharpness=sharpness,
            reader=reader,
        )
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
