"""Frames kept on the disk until the last one is known.

Some formats need to know the whole motion before they can write its beginning: the number of frames
(GNS .npz), the camera and the colour range (films, pictures). Their frames wait here, in an unnamed
file beside the result, which the system removes whatever happens. Memory is one frame.
"""

import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np
from torch import Tensor

__all__ = ["Spool"]


class Spool:
    """Float32 frames of one shape, first written and then read.

    Args:
        folder: Where the file without a name lies; made if need be.
        shape: Shape of a frame.
    """

    def __init__(self, folder: Path, shape: tuple[int, int]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder)
        self._shape, self._count = shape, 0

    def __enter__(self) -> "Spool":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def append(self, frame: Tensor) -> None:
        """Store a frame.

        Args:
            frame: The numbers, in float32 on the CPU.
        """
        self._file.write(frame.contiguous().numpy().tobytes())
        self._count += 1

    def frames(self) -> np.ndarray:
        """All frames, mapped from the disk and not in memory; writable, but not to the file.

        Returns:
            Float32 array of shape (t, *shape).
        """
        self._file.flush()
        shape = (self._count, *self._shape)
        return np.memmap(self._file, dtype=np.float32, mode="c", shape=shape)
