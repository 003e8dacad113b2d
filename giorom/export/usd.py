"""Write a motion as USD points with time samples, for Blender, Houdini, Omniverse and usdview.

One ``UsdGeomPoints`` prim ``/motion`` in a stage of metres with Y up. A time code is a frame, and
``timeCodesPerSecond`` is 1 / ``frame_dt``, so that the motion plays in real time. Points, extent,
speed and fields are sampled in time; ids, widths, colours and particle types are stored once.

The binary layer is saved every ``SAVE_BYTES``, after which USD drops the samples from memory. Text
(``.usda``) is made from such a layer at the end.
"""

import itertools
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from giorom.data.atomic import replacing
from giorom.data.trajectory_file import attributes_text
from giorom.export.scene import diameter_from_spacing, in_space
from giorom.export.writer import MotionHeader, PointWriter
from giorom.version import __version__

__all__ = ["usd_writer"]

SAVE_BYTES = 16 << 20
"""Samples held in memory before the layer is saved [bytes]."""

TYPE_COLORS = (
    (0.55, 0.40, 0.30),
    (0.85, 0.60, 0.25),
    (0.60, 0.35, 0.60),
    (0.55, 0.55, 0.55),
    (0.30, 0.60, 0.45),
    (0.20, 0.45, 0.80),
    (0.85, 0.72, 0.45),
    (0.45, 0.70, 0.25),
    (0.80, 0.35, 0.30),
)
"""Display colour (linear RGB) of each GNS particle type: 3 kinematic grey, 5 water blue ..."""


_NUMBERS = itertools.count()
"""USD knows a layer by its path as long as anybody holds it, so that no two may share one."""


class UsdWriter(PointWriter):
    """Adds time samples to an open stage.

    Args:
        stage: The open ``Usd.Stage`` of a binary layer.
        header: What is known before the first frame.
    """

    def __init__(self, stage: Any, header: MotionHeader) -> None:
        super().__init__(header)
        self._stage, self._stored, self._unsaved, self._width = stage, 0, 0, 0.0
        self._points = _define(stage, header)
        self._numbers = {
            name: _primvar(self._points, name, "FloatArray") for name in ("speed", *header.fields)
        }

    def _put(self, position: Tensor, numbers: dict[str, Tensor]) -> None:
        from pxr import Vt

        if self._stored == 0:
            self._write_width(position)
        points, time = in_space(position), float(self._stored)
        room = self._width / 2.0
        extent = np.stack([points.min(axis=0) - room, points.max(axis=0) + room])
        self._points.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), time)
        self._points.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)), time)
        for name, values in numbers.items():
            self._numbers[name].Set(Vt.FloatArray.FromNumpy(values.numpy()), time)
        self._stored += 1
        self._unsaved += points.nbytes + 4 * len(points) * len(numbers)
        if self._unsaved >= SAVE_BYTES:
            self._stage.GetRootLayer().Save()
            self._unsaved = 0

    def _complete(self) -> None:
        self._stage.SetEndTimeCode(self._stored - 1)
        self._stage.GetRootLayer().Save()

    def _write_width(self, position: Tensor) -> None:
        """One diameter for all points: the spacing of the first frame."""
        from pxr import UsdGeom, Vt

        header = self.header
        self._width = diameter_from_spacing(
            position, kinematic=header.kinematic.cpu(), bounds=header.bounds.detach().cpu()
        )
        self._points.GetWidthsAttr().Set(Vt.FloatArray([self._width]))
        self._points.SetWidthsInterpolation(UsdGeom.Tokens.constant)


@contextmanager
def usd_writer(path: Path, header: MotionHeader) -> Iterator[UsdWriter]:
    """Open a USD layer of one motion.

    Args:
        path: File to create or replace, ending in ``.usd``, ``.usdc`` (binary) or ``.usda`` (text).
        header: What is known before the first frame; a 2-D motion lies in z = 0.

    Yields:
        The writer.
    """
    from pxr import Tf, Usd

    with replacing(path) as temporary:
        binary = temporary.with_suffix(f".{next(_NUMBERS)}.usdc")
        try:
            stage = Usd.Stage.CreateNew(str(binary))
            yield UsdWriter(stage, header)
            if path.suffix.lower() == ".usda":
                stage.GetRootLayer().Export(str(temporary))
            else:
                os.replace(binary, temporary)
        except Tf.ErrorException as error:
            said = re.findall(r" : '(.*?)'(?: Error in|$)", " ".join(str(error).split()))
            raise OSError(
                f"USD cannot write {path} ({said[0][:200] if said else 'no reason given'}). Is the "
                f"disk full, or the folder closed to you?"
            ) from None
        finally:
            stage = None
            binary.unlink(missing_ok=True)


def _define(stage: Any, header: MotionHeader) -> Any:
    """The stage's units and the prim with all that does not move."""
    from pxr import UsdGeom, Vt

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rate = 1.0 / header.frame_dt
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    points = UsdGeom.Points.Define(stage, "/motion")
    stage.SetDefaultPrim(points.GetPrim())
    types = header.particle_type.cpu().numpy().astype(np.int32)
    points.GetIdsAttr().Set(Vt.Int64Array.FromNumpy(np.arange(len(types), dtype=np.int64)))
    colors = np.array(TYPE_COLORS, dtype=np.float32)[types]
    points.GetDisplayColorAttr().Set(Vt.Vec3fArray.FromNumpy(colors))
    points.GetDisplayColorPrimvar().SetInterpolation(UsdGeom.Tokens.vertex)
    _primvar(points, "particle_type", "IntArray").Set(Vt.IntArray.FromNumpy(types))
    layer = stage.GetRootLayer()
    layer.customLayerData = {
        "giorom": __version__,
        "giorom_frame_dt": header.frame_dt,
        "giorom_bounds": str(header.bounds.tolist()),
        "giorom_attributes": attributes_text(header.attributes),
    }
    return points


def _primvar(points: Any, name: str, kind: str) -> Any:
    """A number of each point, under a name programs show."""
    from pxr import Sdf, UsdGeom

    view = UsdGeom.PrimvarsAPI(points)
    return view.CreatePrimvar(name, getattr(Sdf.ValueTypeNames, kind), UsdGeom.Tokens.vertex)
