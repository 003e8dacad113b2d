"""Write a motion as a sequence of binary PLY files, one per frame, for 3-D programs.

The sequence is a folder ``NAME`` of files ``NAME_00000.ply`` ...; each holds the points [m], the
speed [m/s], the particle type and the caller's fields. The folder appears whole or not at all.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from torch import Tensor

from giorom.data.atomic import replacing_folder
from giorom.export.scene import in_space
from giorom.export.writer import MotionHeader, PointWriter

__all__ = ["ply_folder", "ply_writer"]


class PlyWriter(PointWriter):
    """Writes one file per frame into a folder.

    Args:
        folder: An empty folder.
        name: What the names of the files begin with.
        header: What is known before the first frame.
    """

    def __init__(self, folder: Path, name: str, header: MotionHeader) -> None:
        super().__init__(header)
        self._folder, self._name, self._stored = folder, name, 0
        self._point = np.empty(header.particle_count, dtype=_point_type(header.fields))
        self._point["particle_type"] = header.particle_type.cpu().numpy()

    def _put(self, position: Tensor, numbers: dict[str, Tensor]) -> None:
        point = self._point
        point["x"], point["y"], point["z"] = in_space(position).T
        for name, values in numbers.items():
            point[name] = values.numpy()
        text = _header(point, time=self._stored * self.header.frame_dt)
        path = self._folder / f"{self._name}_{self._stored:05d}.ply"
        path.write_bytes(text + point.tobytes())
        self._stored += 1

    def _complete(self) -> None:
        pass


def ply_folder(path: Path) -> Path:
    """The folder that a sequence named ``NAME.ply`` goes into: ``NAME`` beside it.

    Args:
        path: ``NAME.ply``.
    """
    return path.with_suffix("")


@contextmanager
def ply_writer(path: Path, header: MotionHeader) -> Iterator[PlyWriter]:
    """Open a sequence of PLY files.

    Args:
        path: ``NAME.ply``; the files go into the folder ``NAME`` beside it.
        header: What is known before the first frame; a 2-D motion lies in z = 0.

    Yields:
        The writer.

    Raises:
        ValueError: If the folder exists and holds anything but such a sequence.
    """
    folder = ply_folder(path)
    _check_free(folder)
    with replacing_folder(folder) as temporary:
        yield PlyWriter(temporary, folder.name, header)


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


def _point_type(names: tuple[str, ...]) -> np.dtype:
    """Record of one point, little-endian and packed."""
    numbers = [(name, "<f4") for name in ("x", "y", "z", "speed", *names)]
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
