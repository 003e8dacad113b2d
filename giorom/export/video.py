"""Pictures and films of a motion, beside the truth if there is one, without a display.

Particles are coloured by their displacement from the first frame; all panels share the camera and
the colour range (``giorom.export.scene``). Axis 1 points up. A film is H.264 in yuv420p at an even
size, which every player opens; a contact sheet shows a few frames in one PNG. Frames that arrive
one by one wait on the disk, because the camera and the colours need the whole motion.
"""

import io
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from giorom.data.atomic import replacing
from giorom.export.drawing import STRIP_HEIGHT, canvas
from giorom.export.scene import frame_scene
from giorom.export.spool import Spool
from giorom.export.writer import MotionHeader, MotionWriter
from giorom.state import Trajectory

__all__ = ["picture_writer", "write_contact_sheet", "write_film"]

FILM_PANEL, FILM_SHARPNESS = (640, 560), 1.25
"""Width and height of a film's panel [pixels], and how much larger it is drawn."""

SHEET_PANEL, SHEET_SHARPNESS = (400, 400), 2
"""The same of a contact sheet."""

SHEET_FRAMES = 5
"""Frames of a contact sheet."""

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
    motions, titles = _motions(trajectory, truth)
    scene = frame_scene(motions)
    picture = canvas(
        scene, panel_size=FILM_PANEL, rows=1, columns=len(motions), sharpness=FILM_SHARPNESS
    )
    size = (FILM_PANEL[0] * len(motions), FILM_PANEL[1] + STRIP_HEIGHT)
    with (
        replacing(path) as temporary,
        picture as drawing,
        _encoder(temporary, size, frame_rate) as encoder,
    ):
        panels = []
        for column, (motion, title) in enumerate(zip(motions, titles, strict=True)):
            panels.append(drawing.add_panel(motion, row=0, column=column))
            drawing.add_label(title, (0.5, 0.96), size=22)
        clock = drawing.add_strip(row=1)
        for frame in range(trajectory.frame_count):
            for panel in panels:
                panel.show(frame)
            clock.SetInput(_time(trajectory, frame))
            encoder.send(drawing.image())
        encoder.close()
        _check_film(temporary)
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
    import imageio.v3

    motions, titles = _motions(trajectory, truth)
    chosen = _evenly(trajectory.frame_count) if frames is None else list(frames)
    picture = canvas(
        frame_scene(motions),
        panel_size=SHEET_PANEL,
        rows=len(motions),
        columns=len(chosen),
        sharpness=float(SHEET_SHARPNESS),
    )
    with replacing(path) as temporary, picture as drawing:
        for row, (motion, title) in enumerate(zip(motions, titles, strict=True)):
            for column, frame in enumerate(chosen):
                drawing.add_panel(motion, row=row, column=column).show(frame)
                if row == 0:
                    drawing.add_label(_time(motion, frame), (0.5, 0.95), size=18)
                if column == 0:
                    drawing.add_label(title, (0.05, 0.5), size=20, angle=90.0)
        drawing.add_strip(row=len(motions))
        imageio.v3.imwrite(temporary, _shrink(drawing.image(), SHEET_SHARPNESS))
    return path


class PictureWriter(MotionWriter):
    """Keeps the frames on the disk and draws them at the end.

    Args:
        path: File to create or replace, ending in ``.mp4`` or ``.png``.
        spool: Where the frames wait.
        header: What is known before the first frame.
    """

    def __init__(self, path: Path, spool: Spool, header: MotionHeader) -> None:
        super().__init__(header)
        self._path, self._spool = path, spool

    def _append(self, position: Tensor, _fields: dict[str, Tensor]) -> None:
        self._spool.append(position)

    def _finish(self) -> None:
        draw = write_film if self._path.suffix.lower() == ".mp4" else write_contact_sheet
        header = self.header
        motion = Trajectory(
            position=torch.from_numpy(self._spool.frames()),
            particle_type=header.particle_type.cpu(),
            frame_dt=header.frame_dt,
            bounds=header.bounds.detach().cpu(),
        )
        draw(motion, self._path)


@contextmanager
def picture_writer(path: Path, header: MotionHeader) -> Iterator[PictureWriter]:
    """Open a film or a contact sheet; fields are not shown.

    Args:
        path: File to create or replace, ending in ``.mp4`` or ``.png``.
        header: What is known before the first frame.

    Yields:
        The writer.
    """
    import imageio_ffmpeg  # noqa: F401  (a missing extra is said before the work)
    import pyvista  # noqa: F401

    with Spool(path.parent, (header.particle_count, header.dimension)) as spool:
        yield PictureWriter(path, spool, header)


@contextmanager
def _encoder(path: Path, size: tuple[int, int], frame_rate: int) -> Iterator[Any]:
    """Give a generator that takes large pictures and makes a film of the given size of them."""
    import imageio_ffmpeg

    encoder = imageio_ffmpeg.write_frames(
        str(path),
        tuple(round(length * FILM_SHARPNESS) for length in size),
        fps=frame_rate,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=[
            *("-vf", f"scale={size[0]}:{size[1]}:flags=area"),
            *("-crf", "18", "-preset", "veryfast", "-movflags", "+faststart"),
        ],
    )
    encoder.send(None)
    try:
        yield encoder
    finally:
        encoder.close()


def _check_film(path: Path) -> None:
    """Raise if the encoder, which does not say so, could not write the film to its end.

    An MP4 file is a row of boxes, each beginning with its length; ``moov`` is the index.
    """
    size, offset, kinds = path.stat().st_size if path.exists() else 0, 0, []
    with path.open("rb") if size else io.BytesIO() as file:
        while offset + 8 <= size:
            file.seek(offset)
            length, kind, wide = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
            offset += max(wide if length == 1 else length, 8)
            kinds.append(kind)
    if offset != size or b"moov" not in kinds or b"mdat" not in kinds:
        raise OSError(f"the encoder could not write the film {path.name}. Is the disk full?")


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Average squares of ``factor`` pixels."""
    height, width, channels = image.shape
    blocks = image.reshape(height // factor, factor, width // factor, factor, channels)
    return blocks.mean(axis=(1, 3)).round().astype(np.uint8)


def _evenly(count: int) -> list[int]:
    """A few frames from the first to the last, without repeats."""
    frames = np.linspace(0, count - 1, SHEET_FRAMES).round().astype(int)
    return sorted(set(frames.tolist()))


def _motions(
    trajectory: Trajectory, truth: Trajectory | None
) -> tuple[list[Trajectory], list[str]]:
    """The motions of a picture and their titles; one alone needs none."""
    if truth is None:
        return [trajectory], [""]
    return [trajectory, truth], list(TITLES)


def _time(motion: Trajectory, frame: int) -> str:
    """The time stamp of a frame, with the decimals that tell two frames apart."""
    decimals = max(2, 1 - math.floor(math.log10(motion.frame_dt)))
    return f"t = {frame * motion.frame_dt:.{decimals}f} s"
