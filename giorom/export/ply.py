"""Write a motion as a sequence of binary PLY files, one per frame, for 3-D programs.

The sequence is a folder ``NAME`` of files ``NAME_00000.ply`` ...; each holds the points [m], the
speed [m/s], the particle type and the caller's fields. The folder appears whole or not at all.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from giorom.data.atomic import replacing_folder
from giorom.export.points import point_fields
from giorom.export.scene import in_space
from giorom.state import Trajectory

__all__ = ["write_ply"]


def write_ply(
    trajectory: Trajectory,
    path: Path,
    *,
    fields: Mapping[str, Float[Tensor, "t p"]] | None = None,
) -> Path:
    """Write one PLY file per frame.

    Args:
        trajectory: The motion; a 2-D one lies in z = 0.
        path: ``NAME.ply``; the files go into the folder ``NAME`` beside it.
        fields: More numbers for each particle and frame, such as an error.

    Returns:
        The folder.

    Raises:
        ValueError: If the folder exists and holds anything but such a sequence, or a field has a
            name that is taken or a wrong shape.
    """
    folder = path.with_suffix("")
    values = point_fields(trajectory, fields)
    _check_free(folder)
    types = trajectory.particle_type.cpu().numpy().astype(np.uint8)
    with replacing_folder(folder) as temporary:
        for frame, position in enumerate(trajectory.position):
            point = np.empty(len(types), dtype=_point_type(list(values)))
            point["x"], point["y"], point["z"] = in_space(position).T
            point["particle_type"] = types
            for name, numbers in values.items():
                point[name] = numbers[frame]
            content = _header(point, time=frame * trajectory.frame_dt) + point.tobytes()
            (temporary / f"{folder.name}_{frame:05d}.ply").write_bytes(content)
    return folder


def _check_free(folder: Path) -> None:
    """Refuse to replace anything but an earlier sequence of the same name."""
    if not folder.exists():
        return
    pattern = re.compile(re.escape(folder.name) + r"_\d{5,}\.ply")
    foreign = not folder.is_dir() or any(not pattern.fullmatch(p.name) for p in folder.iterdir())
    if foreign:
        raise ValueError(
            f"{folder} exists and is not an earlier sequence of PLY files; nothing is written "
            f"over it. Choose another name."
        )


def _point_type(names: list[str]) -> np.dtype:
    """Record of one point, little-endian and packed."""
    numbers = [(name, "<f4") for name in ("x", "y", "z", *names)]
    return np.dtype([*numbers, ("particle_type", "u1")])


def _header(point: np.ndarray, *, time: float) -> bytes:
    """The text before the records."""
    kinds = {"<f4": "float", "|u1": "uchar"}
    fields = point.dtype.fields or {}
    properties = [f"property {kinds[fields[name][0].str]} {name}" for name in fields]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment time {time:.9g} s",
        f"element vertex {len(point)}",
        *properties,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")
