"""Bytes of a file, of a stretch of one, or of a packed zip member, read by offset.

The readers of foreign formats never load a file: they note where an array lies and fetch a frame
when it is asked for. Every read goes through here, so that a file that ends too early, a packed
member that does not unpack and a disk that fails are all one ``DataError`` in one line, and no
length a file claims is believed before it is compared with the bytes that are there.
"""

import io
import zipfile
import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from giorom.data.metadata import DataError

__all__ = ["ByteSource", "Cursor", "FileSource", "PackedSource", "Part", "first_line"]

STEP_BYTES = 1 << 18
"""Bytes unpacked at a time when a stretch of a packed member is passed over."""

BUFFER_BYTES = 4096
"""Bytes a cursor reads at once."""

ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    EOFError,
    ValueError,
    NotImplementedError,
    RuntimeError,
    LookupError,
    OverflowError,
)
"""What ``zipfile`` raises on damaged archives."""


class ByteSource(ABC):
    """Read-only bytes with a known length."""

    name: str
    size: int

    @abstractmethod
    def _fetch(self, offset: int, count: int) -> bytes:
        """Bytes from an offset on, perhaps fewer than asked for."""

    def read_at(self, offset: int, count: int) -> bytes:
        """Exactly ``count`` bytes from ``offset`` on.

        Args:
            offset: First byte.
            count: How many.

        Returns:
            The bytes.

        Raises:
            DataError: If they are not all there; nothing is allocated in that case.
        """
        if offset < 0 or count < 0 or offset + count > self.size:
            raise DataError(
                f"{self.name} is cut off or damaged: {count} bytes are announced at byte {offset}, "
                f"but it has {self.size}. Copy it again."
            )
        data = self._fetch(offset, count)
        if len(data) != count:
            raise DataError(f"{self.name} ended while it was being read, at byte {offset}.")
        return data


class FileSource(ByteSource):
    """A whole file."""

    def __init__(self, path: Path) -> None:
        """Open a file.

        Args:
            path: The file.

        Raises:
            DataError: If it cannot be opened.
        """
        self.path, self.name = path, str(path)
        self._file: io.RawIOBase | None = None
        try:
            self._file = path.open("rb", buffering=0)
            self.size = self._file.seek(0, 2)
        except OSError as error:
            raise DataError(f"{path} cannot be read ({error.strerror}).") from None

    def _fetch(self, offset: int, count: int) -> bytes:
        assert self._file is not None  # noqa: S101 - set by every successful construction
        try:
            self._file.seek(offset)
            return _gather(self._file, count)
        except OSError as error:
            raise DataError(f"{self.name} cannot be read ({error.strerror}).") from None

    def __del__(self) -> None:
        """Close the file with its last user."""
        if getattr(self, "_file", None) is not None:
            self._file.close()  # type: ignore[union-attr]


class Part(ByteSource):
    """A stretch of another source."""

    def __init__(self, source: ByteSource, *, start: int, size: int, name: str) -> None:
        """Mark a stretch.

        Args:
            source: Where it lies.
            start: Its first byte.
            size: Its length [bytes].
            name: What to call it in messages.

        Raises:
            DataError: If it does not lie within the source.
        """
        self.name, self.size = name, size
        self._source, self._start = source, start
        if start < 0 or size < 0 or start + size > source.size:
            raise DataError(f"{name} is cut off or damaged: it does not lie within its file.")

    def _fetch(self, offset: int, count: int) -> bytes:
        return self._source.read_at(self._start + offset, count)


class PackedSource(ByteSource):
    """A deflated member of a zip archive.

    It is unpacked as it is read. Reading onward is cheap, reading backward starts again from the
    first byte. Two places are kept, so that a reader may look at what follows an array and
    then go through the array, and so on through the file, without ever starting again.
    """

    def __init__(self, archive: zipfile.ZipFile, member: zipfile.ZipInfo, *, name: str) -> None:
        """Prepare to read a member.

        Args:
            archive: The open archive, which closes itself with its last user.
            member: Which member.
            name: What to call it in messages.
        """
        self.name, self.size = name, member.file_size
        self._archive, self._member = archive, member
        self._places: list[_Place] = []

    def _fetch(self, offset: int, count: int) -> bytes:
        try:
            place = self._place_before(offset)
            while place.position < offset:
                passed = len(place.stream.read(min(STEP_BYTES, offset - place.position)))
                if not passed:
                    return b""
                place.position += passed
            data = _gather(place.stream, count)
        except ZIP_ERRORS as error:
            raise DataError(f"{self.name} does not unpack ({first_line(error)}).") from None
        place.position += len(data)
        return data

    def _place_before(self, offset: int) -> "_Place":
        """The nearest place before an offset, or a new one at the beginning."""
        before = [place for place in self._places if place.position <= offset]
        if before:
            return max(before, key=lambda place: place.position)
        if len(self._places) == 2:
            furthest = max(self._places, key=lambda place: place.position)
            furthest.stream.close()
            self._places.remove(furthest)
        self._places.append(_Place(self._archive.open(self._member)))
        return self._places[-1]

    def __del__(self) -> None:
        """Close the streams, so that the archive can be closed with its last user."""
        for place in getattr(self, "_places", ()):
            place.stream.close()


@dataclass(slots=True)
class _Place:
    """How far a member has been unpacked."""

    stream: io.BufferedIOBase
    position: int = 0


class Cursor:
    """Goes through small fields of a source, with few reads."""

    def __init__(self, source: ByteSource, position: int = 0, end: int | None = None) -> None:
        """Stand at a byte of a source.

        Args:
            source: What to read.
            position: First byte.
            end: Where the stretch ends; nothing beyond it is read.
        """
        self.source, self.position = source, position
        self.end = source.size if end is None else end
        self._buffer, self._start = b"", 0

    def take(self, count: int) -> bytes:
        """The next bytes.

        Args:
            count: How many; small.

        Returns:
            The bytes.

        Raises:
            DataError: If the stretch ends before.
        """
        begin = self.position - self._start
        if count > self.end - self.position:
            self._refuse(count)
        if begin < 0 or begin + count > len(self._buffer):
            self._fill(count)
            begin = 0
        self.position += count
        return self._buffer[begin : begin + count]

    def skip(self, count: int) -> None:
        """Pass over bytes without reading them.

        Args:
            count: How many.

        Raises:
            DataError: If the stretch ends before.
        """
        if count > self.end - self.position:
            self._refuse(count)
        self.position += count

    def part(self, length: int) -> "Cursor":
        """A cursor on the next bytes, which are passed over here.

        Args:
            length: How many bytes.

        Returns:
            The cursor; it shares what has been read already.

        Raises:
            DataError: If the stretch ends before.
        """
        inner = Cursor(self.source, self.position, self.position + length)
        inner._buffer, inner._start = self._buffer, self._start
        self.skip(length)
        return inner

    def _fill(self, count: int) -> None:
        self._start = self.position
        wanted = min(self.end - self.position, max(count, BUFFER_BYTES))
        self._buffer = self.source.read_at(self.position, wanted)

    def _refuse(self, count: int) -> None:
        raise DataError(
            f"{self.source.name} is cut off or damaged: {count} bytes are announced at byte "
            f"{self.position}, but only {self.end - self.position} are left. Copy it again."
        )


def _gather(stream: io.RawIOBase | io.BufferedIOBase, count: int) -> bytes:
    """``count`` bytes of a stream, or what there is."""
    pieces, missing = [], count
    while missing and (piece := stream.read(missing)):
        pieces.append(piece)
        missing -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def first_line(error: BaseException) -> str:
    """What a library says was wrong, in one line.

    Args:
        error: Its exception.

    Returns:
        The first line of its message, or the name of the exception.
    """
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
