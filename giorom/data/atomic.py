"""Put files in place whole or not at all.

Every file the package leaves behind goes through here: it is written under a temporary
name in the same folder, flushed to the disk and renamed, so that a reader sees the old
file or the new one and never a half. The temporary name starts with a dot and keeps the
extension, because some writers choose their format by it.
"""

import errno
import json
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LEFTOVER = re.compile(r"\..+\.(\w+-)?\d+\.tmp(\.\w+)?", re.ASCII)
"""Names of temporary files; those of earlier versions carry no host."""

HOST_LETTERS = 16
"""Letters of the host's name in a temporary name; the last ones, in which nodes differ."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path that becomes ``path`` if the block ends without an exception.

    Args:
        path: File to create or replace; its folder is made if need be.

    Yields:
        The temporary path to write to. It is removed if the block fails.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{_writer()}.tmp{path.suffix}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
        _flush(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Give an empty temporary folder that becomes ``folder`` if the block ends well.

    Args:
        folder: Folder to create or replace.

    Yields:
        The temporary folder. It is removed if the block fails, and an earlier folder stays.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{_writer()}.tmp")
    earlier = folder.with_name(f".{folder.name}.{_writer()}.old")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        yield temporary
        for path in temporary.iterdir():
            _flush(path)
        if folder.exists():
            os.replace(folder, earlier)
        os.replace(temporary, folder)
        _flush(folder.parent)
    finally:
        if earlier.exists() and not folder.exists():
            os.replace(earlier, folder)
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` as indented JSON, atomically.

    Args:
        path: File to create or replace.
        content: JSON values; numbers must be finite.

    Raises:
        ValueError: If a value is not JSON or a number is not finite.
    """
    try:
        text = json.dumps(dict(content), indent=2, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path} can hold only JSON values with finite numbers, but {error}. "
            f"Give lists, strings, numbers, true, false or null."
        ) from error
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def disk_is_full(error: BaseException) -> bool:
    """Whether an exception says that no space is left, from the system or from HDF5.

    Args:
        error: What was raised while something was written.

    Returns:
        True also if HDF5 has put the system's answer into its own words.
    """
    number = error.errno if isinstance(error, OSError) else None
    return number == errno.ENOSPC or os.strerror(errno.ENOSPC) in str(error)


def _writer() -> str:
    """Host and process, as letters and digits around a hyphen."""
    host = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname().partition(".")[0])
    return f"{host[-HOST_LETTERS:] or 'host'}-{os.getpid()}"


def _flush(path: Path) -> None:
    """Ask the operating system to put a file or folder on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
