"""Open an HDF5 file for writing so that a full disk is an error and not a crash.

If the system refuses a write, the HDF5 library keeps what it could not store, tries again when the
program ends, fails again and takes the process down with it. Here the library writes through a file
that never fails: it remembers the first refusal and lets go of everything after it. The file is
lost anyway; ``check_written`` and the end of the block say so.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["check_written", "hdf5_output"]


class _OutputFile(io.FileIO):
    """A file that remembers its failure."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+b")
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of the data, or nothing after a failure."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += super().write(view[done:]) or 0
            except OSError as error:
                self.error = error
        return len(view)


@contextmanager
def hdf5_output(path: Path) -> Iterator[Any]:
    """Create an HDF5 file; use a temporary name (``giorom.data.atomic.replacing``).

    Args:
        path: The file.

    Yields:
        The open ``h5py.File``.

    Raises:
        OSError: If the system refused to store something.
    """
    import h5py

    with _OutputFile(path) as output:
        try:
            with h5py.File(output, "w") as file:
                file.giorom_output = output
                yield file
        finally:
            if output.error is not None:
                raise OSError(output.error.errno, output.error.strerror, str(path)) from None


def check_written(file: Any) -> None:
    """Raise as soon as the system has refused to store something; a long run need not go on.

    Args:
        file: The ``h5py.File`` that ``hdf5_output`` gave.

    Raises:
        OSError: What the system said.
    """
    if file.giorom_output.error is not None:
        raise file.giorom_output.error
