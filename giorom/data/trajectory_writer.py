"""Write a trajectory file frame by frame, whatever its length.

One compressed block of frames is in memory at a time (a MiB, or one frame where that is larger).
The file is the one of ``giorom.data.trajectory_file``: it appears whole under its name when the
block ends well, and not at all when it does not. Positions are metres, rounded to float32.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from giorom.data.atomic import replacing
from giorom.data.hdf5_output import check_written
from giorom.data.metadata import DataError
from giorom.data.trajectory_file import CHUNK_BYTES, attributes_text, new_trajectory_file

__all__ = ["TrajectoryWriter", "open_trajectory_writer"]


class TrajectoryWriter:
    """Takes the frames of one trajectory; made by ``open_trajectory_writer``.

    ``bounds`` and ``attributes`` may be changed until the block ends.
    """

    def __init__(
        self,
        file: Any,
        *,
        particle_type: Integer[np.ndarray, " p"],
        frame_dt: float,
        bounds: Float[np.ndarray, "d 2"],
        attributes: dict[str, Any],
    ) -> None:
        self.bounds, self.attributes = bounds, attributes
        self.frame_count = 0
        group = file.create_group("00000")
        self._file, self._group, self._filled = file, group, 0
        shape = (len(particle_type), len(bounds))
        frames = max(1, CHUNK_BYTES // max(1, 4 * shape[0] * shape[1]))
        self._block = np.empty((frames, *shape), np.float32)
        self._position = group.create_dataset(
            "position",
            shape=(0, *shape),
            maxshape=(None, *shape),
            dtype=np.float32,
            chunks=self._block.shape,
            compression="gzip",
            compression_opts=4,
            shuffle=True,
        )
        group["particle_type"] = particle_type.astype(np.int32)
        group.attrs["frame_dt"] = frame_dt

    def append(self, frame: Float[np.ndarray, "p d"]) -> None:
        """Add the positions of all particles at the next frame [m].

        Raises:
            DataError: If the shape is not that of the trajectory or a position is not finite.
        """
        if frame.shape != self._block.shape[1:]:
            raise DataError(
                f"frame {self.frame_count} has shape {frame.shape}, but the trajectory has "
                f"{self._block.shape[1:]}; particles may neither appear nor vanish."
            )
        with np.errstate(over="ignore"):
            self._block[self._filled] = frame
        if not np.isfinite(self._block[self._filled]).all():
            raise DataError(
                f"frame {self.frame_count} holds a position that is not a finite float32 number. "
                f"Repair or drop the trajectory."
            )
        self._filled += 1
        self.frame_count += 1
        if self._filled == len(self._block):
            self._empty()

    def finish(self) -> None:
        """Write what is left; called once, by ``open_trajectory_writer``."""
        if self.frame_count == 0:
            raise DataError("the trajectory has no frame; nothing is written.")
        self._empty()
        self._group.attrs["bounds"] = np.asarray(self.bounds, np.float32)
        self._group.attrs["attributes"] = attributes_text(self.attributes)

    def _empty(self) -> None:
        """Store the frames held back."""
        stored = len(self._position)
        self._position.resize(stored + self._filled, axis=0)
        self._position[stored:] = self._block[: self._filled]
        self._filled = 0
        check_written(self._file)


@contextmanager
def open_trajectory_writer(
    path: Path,
    *,
    particle_type: Integer[np.ndarray, " p"],
    frame_dt: float,
    bounds: Float[np.ndarray, "d 2"],
    attributes: dict[str, Any] | None = None,
) -> Iterator[TrajectoryWriter]:
    """Open a trajectory file for frames that come one by one.

    Args:
        path: File to create or replace when the block ends well.
        particle_type: GNS particle types.
        frame_dt: Time between frames [s].
        bounds: Lower and upper wall of each axis [m].
        attributes: What made it (JSON values).

    Yields:
        The writer.

    Raises:
        DataError: If no frame came, or the attributes are no JSON.
    """
    with replacing(path) as temporary, new_trajectory_file(temporary) as file:
        writer = TrajectoryWriter(
            file,
            particle_type=particle_type,
            frame_dt=frame_dt,
            bounds=bounds,
            attributes=dict(attributes or {}),
        )
        yield writer
        writer.finish()
