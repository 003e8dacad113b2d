"""Read DeepMind's GNS data, TFRecord files of SequenceExamples, without TensorFlow.

A file is a chain of records: length (uint64), masked CRC-32C of the length, payload, masked
CRC-32C of the payload, all little-endian. Each payload is one trajectory as a protocol-buffer
message ``tf.train.SequenceExample``: the context holds ``particle_type`` (the bytes of
int64 for each particle), the feature list ``position`` one entry of float32 bytes per frame.
``step_context`` (global forcing) has no place in this program and is left out, with a note.

Only lengths and offsets are kept; a frame is read when it is asked for. Both check sums are
compared, which takes 15 s for the 4.5 GB of WaterDrop.
"""

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource, Cursor, FileSource
from giorom.data.readers.crc32c import crc32c, masked
from giorom.data.readers.foreign_metadata import ForeignMetadata, read_foreign_metadata
from giorom.data.readers.particle_arrays import MOST_FRAMES, check_frames, checked_types
from giorom.data.readers.source import MOST_PARTICLES, ForeignTrajectory, Reader
from giorom.data.readers.split_names import split_files, split_of

__all__ = ["GNS_TFRECORD"]

STEP_BYTES = 1 << 20
"""Bytes whose check sum is computed at a time."""

MOST_FIELDS = 1_000_000
"""Most entries of a message apart from frames."""


@dataclass(slots=True)
class _Record:
    """What a SequenceExample holds."""

    types: bytes | None = None
    frames: array = field(default_factory=lambda: array("Q"))
    """First byte of each frame."""

    frame_bytes: int = 0
    other: set[str] = field(default_factory=set)
    """Names of what is left out."""


def read_tfrecord(path: Path) -> Iterator[ForeignTrajectory]:
    """The trajectories of a TFRecord file, or of all those in a folder.

    Args:
        path: The file or folder; ``metadata.json`` is looked for beside the records.

    Yields:
        One trajectory per record.

    Raises:
        DataError: If a record is cut off, fails its check sum or is no trajectory.
    """
    files = split_files(path, ".tfrecord")
    if not files:
        raise DataError(f"{path} holds no .tfrecord file. Check the path.")
    metadata = read_foreign_metadata(files[0].parent)
    for file in files:
        yield from _read_file(file, metadata)


def is_tfrecord(path: Path) -> bool:
    """Whether a file begins with a TFRecord header of the right check sum, or a folder has one.

    A damaged ``.tfrecord`` file counts, so that the reader may say what is wrong with it.

    Args:
        path: The file or folder.

    Returns:
        Whether it does.
    """
    files = split_files(path, ".tfrecord")
    try:
        return bool(files) and _record_length(FileSource(files[0]), 0) > 0
    except DataError:
        return files[0].suffix == ".tfrecord"


def _read_file(path: Path, metadata: ForeignMetadata) -> Iterator[ForeignTrajectory]:
    source = FileSource(path)
    if source.size == 0:
        raise DataError(f"{path} is empty. Copy it again.")
    offset, number = 0, 0
    while offset < source.size:
        length = _record_length(source, offset)
        start = offset + 12
        _check_payload(source, start, length, number)
        yield _trajectory(source, Cursor(source, start, start + length), number, metadata)
        offset, number = start + length + 4, number + 1


def _record_length(source: ByteSource, offset: int) -> int:
    """Length of the payload of the record at an offset, its check sum compared."""
    header = source.read_at(offset, 12)
    length, stored = struct.unpack("<QI", header)
    if masked(crc32c([header[:8]])) != stored:
        raise DataError(
            f"{source.name}: the record at byte {offset} has a damaged header (its check sum "
            f"differs), or this is no TFRecord file. Copy it again."
        )
    if offset + 16 + length > source.size:
        raise DataError(
            f"{source.name} is cut off: the record at byte {offset} announces {length} bytes, but "
            f"{max(0, source.size - offset - 16)} are left. Copy it again."
        )
    return int(length)


def _check_payload(source: ByteSource, start: int, length: int, number: int) -> None:
    """Compare the check sum of a payload."""
    steps = range(start, start + length, STEP_BYTES)
    pieces = (source.read_at(at, min(STEP_BYTES, start + length - at)) for at in steps)
    if masked(crc32c(pieces)) != int.from_bytes(source.read_at(start + length, 4), "little"):
        raise DataError(
            f"{source.name}: record {number} is damaged (its check sum differs). Copy it again."
        )


def _trajectory(
    source: FileSource, message: Cursor, number: int, metadata: ForeignMetadata
) -> ForeignTrajectory:
    """One record as a trajectory."""
    where = f"{source.path.name}[{number}]"
    record = _parse(message, where)
    if record.types is None or not record.frames:
        raise DataError(f"{where} lacks 'particle_type' or 'position'; it is no GNS trajectory.")
    if not record.types or len(record.types) % 8:
        raise DataError(f"{where}: 'particle_type' must be the bytes of int64 for each particle.")
    count = len(record.types) // 8
    dimension = record.frame_bytes // (4 * count)
    if record.frame_bytes != 4 * count * dimension or dimension != (
        metadata.dimension or dimension
    ):
        raise DataError(
            f"{where}: a frame has {record.frame_bytes} bytes, which is not float32 for {count} "
            f"particles in {metadata.dimension or '2 or 3'} dimensions."
        )
    check_frames(len(record.frames), count, dimension, where)
    notes = list(metadata.notes)
    if record.other:
        notes.append(f"Left out: {', '.join(sorted(record.other))}.")
    return ForeignTrajectory(
        name=where,
        particle_type=checked_types(np.frombuffer(record.types, "<i8"), count, where),
        frames=lambda: _frames(source, record, (count, dimension)),
        frame_count=len(record.frames),
        split=split_of(source.path),
        frame_dt=metadata.frame_dt,
        bounds=metadata.bounds,
        identity_kept=True,
        notes=tuple(notes),
    )


def _frames(
    source: ByteSource, record: _Record, shape: tuple[int, int]
) -> Iterator[Float[np.ndarray, "p d"]]:
    """Positions of one frame after the other."""
    for offset in record.frames:
        data = source.read_at(offset, record.frame_bytes)
        yield np.frombuffer(data, "<f4").reshape(shape).astype(np.float32)


def _parse(message: Cursor, where: str) -> _Record:
    """Find the parts of a SequenceExample: context is field 1, feature_lists field 2."""
    record = _Record()
    for number, part in _fields(message, where):
        for _, entry in _fields(part, where) if number in (1, 2) else ():
            name, value = _map_entry(entry, where)
            if value is None:
                continue
            if number == 1 and name == "particle_type":
                record.types = _only_bytes(value, where)
            elif number == 2 and name == "position":
                _add_frames(record, value, where)
            elif name != "key":
                record.other.add(name[:40] if name.isprintable() else ascii(name[:40]))
    return record


def _add_frames(record: _Record, frames: Cursor, where: str) -> None:
    """Note where each frame of a FeatureList lies."""
    for number, feature in _fields(frames, where, most=MOST_FRAMES):
        values = _bytes_values(feature, where) if number == 1 else []
        if len(values) != 1:
            raise DataError(f"{where}: a frame of 'position' must be one byte string.")
        size = values[0].end - values[0].position
        if record.frames and size != record.frame_bytes:
            raise DataError(
                f"{where}: frame {len(record.frames)} has {size} bytes, the others have "
                f"{record.frame_bytes}; the number of particles must not change."
            )
        record.frame_bytes = size
        record.frames.append(values[0].position)


def _only_bytes(feature: Cursor, where: str) -> bytes:
    """The one byte string of a Feature."""
    values = _bytes_values(feature, where)
    size = values[0].end - values[0].position if len(values) == 1 else -1
    if not 0 <= size <= 8 * MOST_PARTICLES:
        raise DataError(f"{where}: 'particle_type' must be one byte string of int64 values.")
    return values[0].source.read_at(values[0].position, size)


def _bytes_values(feature: Cursor, where: str) -> list[Cursor]:
    """Entries of the bytes_list (field 1) of a Feature."""
    values: list[Cursor] = []
    for number, part in _fields(feature, where):
        if number == 1:
            values += [value for inner, value in _fields(part, where, most=4) if inner == 1]
    return values


def _map_entry(entry: Cursor, where: str) -> tuple[str, Cursor | None]:
    """Key (field 1) and value (field 2) of a map entry."""
    name, value = "", None
    for number, part in _fields(entry, where):
        if number == 1:
            length = part.end - part.position
            name = part.take(min(length, 64)).decode("utf-8", errors="replace")
        elif number == 2:
            value = part
    return name, value


def _fields(
    message: Cursor, where: str, *, most: int = MOST_FIELDS
) -> Iterator[tuple[int, Cursor]]:
    """Number and content of the length-delimited fields of a message; others are passed over."""
    for _ in range(most):
        if message.position == message.end:
            return
        tag = _varint(message, where)
        wire, number = tag & 7, tag >> 3
        if wire == 0:
            _varint(message, where)
        elif wire in (1, 5):
            message.skip(8 if wire == 1 else 4)
        elif wire == 2:
            yield number, message.part(_varint(message, where))
        else:
            raise DataError(f"{where} is no SequenceExample: it holds an unknown wire type {wire}.")
    if message.position != message.end:
        raise DataError(f"{where} holds more than {most} entries in one message. It is damaged.")


def _varint(message: Cursor, where: str) -> int:
    """A base-128 integer of at most ten bytes."""
    value = 0
    for shift in range(0, 70, 7):
        byte = message.take(1)[0]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value
    raise DataError(f"{where} is no SequenceExample: an integer in it has no end.")


GNS_TFRECORD = Reader(
    name="gns-tfrecord",
    title="DeepMind GNS, TFRecord",
    detect=is_tfrecord,
    read=read_tfrecord,
)
"""Reader of DeepMind's TFRecord files."""
