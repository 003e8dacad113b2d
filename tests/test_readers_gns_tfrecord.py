"""DeepMind's TFRecord files, laid out here byte by byte from the published formats.

The encoder below is written from the description of TFRecord (length, masked CRC-32C, payload,
masked CRC-32C) and of the protocol-buffer wire format; the check sum is computed bit by bit. It
shares nothing with the reader.
"""

import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.crc32c import crc32c
from giorom.data.readers.gns_tfrecord import GNS_TFRECORD

METADATA = {
    "bounds": [[0.1, 0.9], [0.1, 0.9]],
    "sequence_length": 4,
    "default_connectivity_radius": 0.015,
    "dim": 2,
    "dt": 0.0025,
}


def bitwise_crc32c(data: bytes) -> int:
    """Polynomial division, one bit at a time."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (0x82F63B78 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def masked_sum(data: bytes) -> bytes:
    sum_ = bitwise_crc32c(data)
    return struct.pack("<I", (((sum_ >> 15) | (sum_ << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def framed(payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    return length + masked_sum(length) + payload + masked_sum(payload)


def varint(number: int) -> bytes:
    low, rest = number & 0x7F, number >> 7
    return bytes([low]) if not rest else bytes([low | 0x80]) + varint(rest)


def delimited(field: int, content: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(content)) + content


def bytes_feature(value: bytes) -> bytes:
    return delimited(1, delimited(1, value))


def map_entry(key: str, value: bytes) -> bytes:
    return delimited(1, delimited(1, key.encode()) + delimited(2, value))


def example(
    positions: np.ndarray, types: np.ndarray, *, step_context: np.ndarray | None = None
) -> bytes:
    """A tf.train.SequenceExample as DeepMind writes it."""
    key = delimited(3, delimited(1, varint(7)))
    context = map_entry("key", key)
    context += map_entry("particle_type", bytes_feature(types.astype("<i8").tobytes()))
    frames = b"".join(
        delimited(1, bytes_feature(frame.astype("<f4").tobytes())) for frame in positions
    )
    lists = map_entry("position", frames)
    if step_context is not None:
        values = b"".join(
            delimited(1, bytes_feature(value.astype("<f4").tobytes())) for value in step_context
        )
        lists = map_entry("step_context", values) + lists
    return delimited(1, context) + delimited(2, lists)


def motion(seed: int, shape: tuple[int, ...] = (5, 7, 2)) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def types_of(seed: int, count: int = 7) -> np.ndarray:
    return np.random.default_rng(seed).choice([0, 3, 5, 6, 7], size=count)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A training file of two trajectories, one of them with other particles, and a test file."""
    first = framed(example(motion(0), types_of(0)))
    second = framed(example(motion(1, (3, 4, 2)), types_of(1, 4)))
    (tmp_path / "train.tfrecord").write_bytes(first + second)
    context = np.arange(5, dtype=np.float32)[:, None]
    (tmp_path / "test.tfrecord").write_bytes(
        framed(example(motion(2), types_of(2), step_context=context))
    )
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    return tmp_path


@pytest.mark.parametrize("length", [0, 9, 255, 512, 513, 4096, 70_001])
def test_the_check_sum_agrees_with_division_bit_by_bit(length: int):
    """Lanes and tables against the definition; pieces may be cut anywhere."""
    data = np.random.default_rng(length).integers(0, 256, length, dtype=np.uint8).tobytes()
    assert crc32c([data]) == bitwise_crc32c(data)
    assert crc32c([data[: length // 3], data[length // 3 :]]) == bitwise_crc32c(data)


def test_the_check_sum_gives_the_published_value():
    """The check value of CRC-32C, and of 32 zero bytes (RFC 3720, B.4)."""
    assert crc32c([b"123456789"]) == 0xE3069283
    assert crc32c([bytes(32)]) == 0x8A9136AA


def test_trajectories_come_back_bit_by_bit(folder: Path):
    """What was laid out by hand is what is read, in the order of the files."""
    trajectories = list(GNS_TFRECORD.read(folder))
    assert [t.name for t in trajectories] == [
        "train.tfrecord[0]",
        "train.tfrecord[1]",
        "test.tfrecord[0]",
    ]
    expected = [motion(0), motion(1, (3, 4, 2)), motion(2)]
    for trajectory, positions in zip(trajectories, expected, strict=True):
        assert np.array_equal(np.stack(list(trajectory.frames())), positions)
        assert np.array_equal(np.stack(list(trajectory.frames())), positions)
        assert trajectory.frame_count == len(positions)
    assert np.array_equal(trajectories[1].particle_type, types_of(1, 4))
    assert [t.split for t in trajectories] == ["train", "train", "test"]
    assert trajectories[0].frame_dt == METADATA["dt"]
    assert np.array_equal(trajectories[0].bounds, METADATA["bounds"])
    assert any("step_context" in note for note in trajectories[2].notes)


def test_a_single_file_without_metadata_is_three_dimensional_by_its_sizes(tmp_path: Path):
    """The bytes of a frame and the number of types fix the dimension."""
    path = tmp_path / "anything.tfrecord"
    path.write_bytes(framed(example(motion(3, (2, 5, 3)), types_of(3, 5))))
    assert detect_format(path) is GNS_TFRECORD
    (trajectory,) = GNS_TFRECORD.read(path)
    assert next(trajectory.frames()).shape == (5, 3)
    assert trajectory.split is None
    assert trajectory.frame_dt is None


def test_a_number_that_is_not_finite_passes(tmp_path: Path):
    """The report has to see it."""
    positions = motion(4)
    positions[1, 2, 0], positions[2, 0, 1] = np.nan, np.inf
    path = tmp_path / "train.tfrecord"
    path.write_bytes(framed(example(positions, types_of(4))))
    (trajectory,) = GNS_TFRECORD.read(path)
    assert np.array_equal(np.stack(list(trajectory.frames())), positions, equal_nan=True)


def read_all(path: Path) -> None:
    """Every frame of every trajectory."""
    for trajectory in GNS_TFRECORD.read(path):
        list(trajectory.frames())


def damaged_files() -> dict[str, bytes]:
    good = framed(example(motion(0), types_of(0)))
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    length = struct.pack("<Q", 1 << 60)
    backward = np.array([5] * 7, ">i8").view("<i8")
    few = motion(0)[:, :6]
    ragged = delimited(1, bytes_feature(bytes(56))) + delimited(1, bytes_feature(bytes(48)))
    context = delimited(1, map_entry("particle_type", bytes_feature(bytes(56))))
    return {
        "empty": b"",
        "cut off": good[:-9],
        "damaged": bytes(flipped),
        "announces": length + masked_sum(length) + good,
        "check sum": struct.pack("<Q", 5) + bytes(4) + good,
        "byte order": framed(example(motion(0), backward)),
        "not float32": framed(example(few, types_of(0))),
        "must not change": framed(context + delimited(2, map_entry("position", ragged))),
        "lacks": framed(b""),
        "wire type": framed(b"\x0f\x00"),
        "no end": framed(b"\xff" * 20),
        "at least one": framed(example(motion(0)[:, :, :1], types_of(0))),
    }


@pytest.mark.parametrize("finding", [*damaged_files()])
def test_a_damaged_record_is_refused_in_one_line(finding: str, tmp_path: Path):
    """Each kind of damage by hand; the message says what was found."""
    path = tmp_path / "train.tfrecord"
    path.write_bytes(damaged_files()[finding])
    with pytest.raises(DataError) as refusal:
        read_all(path)
    message = str(refusal.value)
    assert "\n" not in message
    assert finding in message or finding == "at least one"
    assert "train.tfrecord" in message


@pytest.mark.parametrize(
    "text",
    ["[1]", "{", "[" * 100_000, '{"dt": NaN}', '{"dt": 1e999}', '{"bounds": [[1, 0], [0, 1]]}'],
)
def test_damaged_metadata_are_refused(folder: Path, text: str):
    """Metadata that are there must make sense."""
    (folder / "metadata.json").write_text(text)
    with pytest.raises(DataError, match=r"metadata\.json"):
        list(GNS_TFRECORD.read(folder))


def test_a_record_of_many_frames_is_read_within_a_small_memory(tmp_path: Path):
    """Memory of a frame and of a block of the check sum, not of the file (24 MB)."""
    frame = np.zeros((20_000, 3), np.float32)
    lists = delimited(1, bytes_feature(frame.tobytes())) * 100
    context = delimited(1, map_entry("particle_type", bytes_feature(types_of(0, 20_000).tobytes())))
    payload = context + delimited(2, map_entry("position", lists))
    length = struct.pack("<Q", len(payload))
    path = tmp_path / "train.tfrecord"
    sum_ = crc32c([payload])
    sum_ = (((sum_ >> 15) | (sum_ << 17)) + 0xA282EAD8) & 0xFFFFFFFF
    path.write_bytes(length + masked_sum(length) + payload + struct.pack("<I", sum_))
    size = path.stat().st_size
    del payload, lists
    list(GNS_TFRECORD.read(path))  # the tables of the check sum are made once
    tracemalloc.start()
    (trajectory,) = GNS_TFRECORD.read(path)
    frames = sum(1 for _ in trajectory.frames())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert frames == 100
    assert peak < size / 3
