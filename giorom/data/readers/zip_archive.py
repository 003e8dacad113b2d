"""Members of zip archives (``.npz``, ``torch.save``) as byte sources, guarded against bombs.

A zip file may announce anything. The directory of the archive is limited before it is read, each
member's size is limited and compared with its packed size, only stored and deflated members
are accepted, and nothing is unpacked beyond what is being read.
"""

import struct
import zipfile
import zlib
from pathlib import Path

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import (
    ZIP_ERRORS,
    ByteSource,
    FileSource,
    PackedSource,
    Part,
    first_line,
)

__all__ = ["ZipArchive", "is_zip"]

MOST_DIRECTORY_BYTES = 8 << 20
"""Longest list of members; some hundred thousand."""

ZIP64_BYTES = 56 + 20
"""The wide record of the directory and its locator, which stand before the short record."""

MOST_MEMBER_BYTES = 16 << 30
"""Longest member, unpacked."""

MOST_RATIO = 400
"""Strongest compression of a large member; positions that move compress less than tenfold."""

SMALL_BYTES = 16 << 20
"""Members up to this size may compress as strongly as they like."""

STEP_BYTES = 1 << 20
"""Bytes checked at a time."""


class ZipArchive:
    """An archive of a data file."""

    def __init__(self, path: Path) -> None:
        """Read the directory of an archive.

        Args:
            path: The file.

        Raises:
            DataError: If it is no archive, is damaged, or announces absurd sizes.
        """
        self.path, self._file = path, FileSource(path)
        self._archive: zipfile.ZipFile | None = None
        _check_directory(self._file)
        try:
            self._archive = zipfile.ZipFile(path)
            self.members = {member.filename: member for member in self._archive.infolist()}
        except ZIP_ERRORS as error:
            raise DataError(
                f"{path} is a truncated or damaged zip archive ({first_line(error)}). "
                f"Copy it again."
            ) from None
        for member in self.members.values():
            _check_member(member, path)

    def source(self, name: str) -> ByteSource:
        """A member's bytes.

        Args:
            name: The member.

        Returns:
            A source; a stored member is read in place, a deflated one as it is unpacked.

        Raises:
            DataError: If there is no such member or its header is damaged.
        """
        member = self.members.get(name)
        if member is None or self._archive is None:
            raise DataError(f"{self.path} lacks the member {name!r}. It is cut off or damaged.")
        label = f"{self.path}[{name}]"
        if member.compress_type == zipfile.ZIP_STORED:
            return Part(self._file, start=self._start(member), size=member.file_size, name=label)
        return PackedSource(self._archive, member, name=label)

    def check_sum(self, name: str) -> None:
        """Compare a stored member with its check sum; a deflated one is checked as it is read.

        Args:
            name: The member.

        Raises:
            DataError: If they differ.
        """
        member = self.members[name]
        if member.compress_type != zipfile.ZIP_STORED:
            return
        source, total = self.source(name), 0
        for offset in range(0, source.size, STEP_BYTES):
            data = source.read_at(offset, min(STEP_BYTES, source.size - offset))
            total = zlib.crc32(data, total)
        if total != member.CRC:
            raise DataError(f"{source.name} does not match its check sum. Copy it again.")

    def _start(self, member: zipfile.ZipInfo) -> int:
        """Where the bytes of a stored member begin."""
        header = self._file.read_at(member.header_offset, 30)
        if header[:4] != b"PK\x03\x04":
            raise DataError(f"{self.path}[{member.filename}] has no header. It is damaged.")
        name_length, extra_length = struct.unpack("<HH", header[26:30])
        return member.header_offset + 30 + int(name_length) + int(extra_length)


def is_zip(path: Path) -> bool:
    """Whether a file begins like a zip archive.

    Args:
        path: The file.

    Returns:
        Whether it does; False if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(4) == b"PK\x03\x04"
    except OSError:
        return False


def _check_directory(source: FileSource) -> None:
    """Reject a directory so long that reading it would take the memory."""
    length = min(source.size, ZIP64_BYTES + 22 + 65535)
    tail = source.read_at(source.size - length, length)
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or place + 22 > len(tail):
        raise DataError(f"{source.name} is a zip archive cut off before its end. Copy it again.")
    announced = struct.unpack_from("<L", tail, place + 12)[0]
    # With a ZIP64 locator before it, zipfile believes the wide record and not this one.
    wide = tail[max(0, place - ZIP64_BYTES) : place]
    if len(wide) == ZIP64_BYTES and wide[56:60] == b"PK\x06\x07":
        if wide[:4] != b"PK\x06\x06":
            raise DataError(f"{source.name} is a zip archive without its directory. Copy it again.")
        announced = struct.unpack_from("<Q", wide, 40)[0]
    if announced > MOST_DIRECTORY_BYTES:
        raise DataError(
            f"{source.name} announces a directory of {announced} bytes, more than "
            f"{MOST_DIRECTORY_BYTES}. It is damaged or hostile."
        )


def _check_member(member: zipfile.ZipInfo, path: Path) -> None:
    """Reject members that no data file has."""
    name = member.filename[:100]
    if not name.isprintable():
        raise DataError(f"{path} has a member of the name {name!a}. It is damaged.")
    if member.flag_bits & 1:
        raise DataError(f"{path}[{name}] is encrypted. Store it without a password.")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(
            f"{path}[{name}] is packed by method {member.compress_type}; stored and deflated "
            f"members are read. Write it with numpy.savez_compressed."
        )
    size, packed = member.file_size, member.compress_size
    if size > MOST_MEMBER_BYTES or (size > SMALL_BYTES and size > MOST_RATIO * packed):
        raise DataError(
            f"{path}[{name}] announces {size} bytes out of {packed} packed ones; at most "
            f"{MOST_MEMBER_BYTES} and {MOST_RATIO} to 1 are accepted. It is damaged or a zip bomb."
        )
