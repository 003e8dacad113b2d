"""Write a motion to a trajectory file by the contract that all writers share."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import Tensor

from giorom.data.trajectory_writer import TrajectoryWriter, open_trajectory_writer
from giorom.export.writer import MotionHeader, MotionWriter

__all__ = ["hdf5_writer"]


class Hdf5Writer(MotionWriter):
    """Hands frames on to the writer of trajectory files, which completes the file itself.

    Args:
        writer: The open writer.
        header: What is known before the first frame.
    """

    def __init__(self, writer: TrajectoryWriter, header: MotionHeader) -> None:
        super().__init__(header)
        self._writer = writer

    def _append(self, position: Tensor, _fields: dict[str, Tensor]) -> None:
        self._writer.append(position.numpy())

    def _finish(self) -> None:
        pass


@contextmanager
def hdf5_writer(path: Path, header: MotionHeader) -> Iterator[Hdf5Writer]:
    """Open a trajectory file of one motion; fields are not stored.

    Args:
        path: File to create or replace, ending in ``.h5``.
        header: What is known before the first frame.

    Yields:
        The writer.
    """
    with open_trajectory_writer(
        path,
        particle_type=header.particle_type.cpu().numpy(),
        frame_dt=header.frame_dt,
        bounds=header.bounds.detach().cpu().numpy(),
        attributes=header.attributes,
    ) as writer:
        yield Hdf5Writer(writer, header)
