"""Arrays that lie in a file and are read frame by frame.

A ``LazyArray`` knows the type, the shape and the place of an array and nothing else; a million of
them cost little memory. The order of the axes in memory is free: C order, Fortran order, or
the permuted strides of a tensor. ``frames`` slices along any axis within a fixed budget of
memory: if time is not the slowest axis, it goes through the array several times and keeps
a block of frames each time.

Bytes lie in the file as such, or as the Latin-1 text (stored in UTF-8) into which pickle
protocol 2 turns them, which has no fixed width and is therefore decoded from its beginning.
"""

import codecs
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource

__all__ = ["LazyArray", "Slice", "StorageSlice", "TensorStorage", "c_order"]

BLOCK_BYTES = 64 << 20
"""Most memory for a block of frames where time is not the slowest axis."""

MOST_PASSES = 64
"""Most often an array is gone through; that is 4 GiB."""

STEP_BYTES = 1 << 18
"""Bytes read or decoded at a time."""

BFLOAT16 = "bfloat16"
"""PyTorch's half-width float32, which NumPy lacks."""


@dataclass(frozen=True, slots=True)
class Slice:
    """A stretch of a source."""

    source: ByteSource
    offset: int
    length: int
    """Length in the source [bytes]."""

    is_text: bool = False
    """Whether it is UTF-8 text whose Latin-1 code is meant."""


@dataclass(slots=True)
class TensorStorage:
    """The flat memory behind PyTorch tensors; its place is known once the file is read."""

    key: str
    dtype: str
    count: int
    source: ByteSource | None = None
    offset: int = 0
    is_big: bool = False
    """Whether a big-endian machine wrote it."""


@dataclass(frozen=True, slots=True)
class StorageSlice:
    """Elements of a tensor storage."""

    storage: TensorStorage
    first: int


@dataclass(frozen=True, slots=True)
class LazyArray:
    """An array in a file."""

    dtype: str
    """NumPy's code with its byte order (``<f4``), or ``bfloat16``."""

    shape: tuple[int, ...]

    order: tuple[int, ...]
    """Axes from the slowest to the fastest in memory."""

    payload: bytes | Slice | StorageSlice

    @property
    def item_size(self) -> int:
        """Bytes of one element."""
        return 2 if self.dtype == BFLOAT16 else int(np.dtype(self.dtype).itemsize)

    @property
    def is_float(self) -> bool:
        """Whether the elements are real numbers of a width NumPy computes with."""
        return self.dtype == BFLOAT16 or (self.dtype[1] == "f" and self.item_size <= 8)

    @property
    def is_integer(self) -> bool:
        """Whether the elements are integers."""
        return self.dtype != BFLOAT16 and self.dtype[1] in "iu"

    @property
    def byte_count(self) -> int:
        """Bytes of the whole array."""
        return math.prod(self.shape) * self.item_size

    def read(self, *, most_bytes: int) -> np.ndarray:
        """The whole array.

        Args:
            most_bytes: Refuse a larger one.

        Returns:
            The values, in native byte order and C order.

        Raises:
            DataError: If it is too large or its bytes are not all there.
        """
        if self.byte_count > most_bytes:
            raise DataError(
                f"an array of shape {self.shape} takes {self.byte_count} bytes, more than the "
                f"{most_bytes} that are sensible here. The file is damaged."
            )
        data = _PayloadReader(self).read(self.byte_count)
        flat = _native(np.frombuffer(data, _element_type(self)), self.dtype)
        memory = flat.reshape([self.shape[axis] for axis in self.order])
        return np.ascontiguousarray(memory.transpose(np.argsort(self.order, kind="stable")))

    def frames(self, *, time_axis: int) -> Iterator[Float[np.ndarray, "p d"]]:
        """The slices of a three-axis array along time.

        Args:
            time_axis: Which axis is time; the other two are particles and space, in this order.

        Yields:
            Positions, in native byte order, in the precision of the file.

        Raises:
            DataError: If bytes are missing or are not Latin-1 text.
        """
        slowest = self.order.index(time_axis)
        memory = [self.shape[axis] for axis in self.order]
        outer, inner = math.prod(memory[:slowest]), math.prod(memory[slowest + 1 :])
        frame_bytes = max(1, outer * inner * self.item_size)
        budget = STEP_BYTES if outer == 1 else BLOCK_BYTES
        block = max(1, budget // frame_bytes)
        if outer > 1 and memory[slowest] > MOST_PASSES * block:
            raise DataError(
                f"an array of shape {self.shape} takes {self.byte_count} bytes and is not stored "
                f"frame after frame; it would have to be read {memory[slowest] // block} times. "
                f"Store time as the first axis, in C order."
            )
        back = np.argsort(self.order, kind="stable")
        reader = _PayloadReader(self)
        for first in range(0, memory[slowest], block):
            count = min(block, memory[slowest] - first)
            if outer > 1:
                reader = _PayloadReader(self)
            flat = self._block(reader, outer=outer, inner=inner, first=first, count=count)
            shaped = flat.reshape([*memory[:slowest], count, *memory[slowest + 1 :]])
            yield from map(np.ascontiguousarray, np.moveaxis(shaped.transpose(back), time_axis, 0))

    def _block(
        self, reader: "_PayloadReader", *, outer: int, inner: int, first: int, count: int
    ) -> np.ndarray:
        """``count`` frames from ``first`` on, in memory order."""
        element, size = _element_type(self), self.item_size
        wanted = count * inner
        if outer == 1:
            return _native(np.frombuffer(reader.read(wanted * size), element), self.dtype)
        row = self.byte_count // (outer * size)
        block = np.empty((outer, wanted), element)
        rows = max(1, STEP_BYTES // max(1, row * size))
        start = first * inner
        for index in range(0, outer, rows):
            some = min(rows, outer - index)
            if row * size <= STEP_BYTES:
                data = np.frombuffer(reader.read(some * row * size), element).reshape(some, row)
                block[index : index + some] = data[:, start : start + wanted]
            else:
                reader.skip(start * size)
                block[index] = np.frombuffer(reader.read(wanted * size), element)
                reader.skip((row - start - wanted) * size)
        return _native(block, self.dtype)


def c_order(axes: int) -> tuple[int, ...]:
    """Axes of a C-ordered array from the slowest to the fastest.

    Args:
        axes: How many.

    Returns:
        Their numbers.
    """
    return tuple(range(axes))


def _element_type(array: LazyArray) -> np.dtype:
    """The type in which the bytes are read."""
    dtype = np.dtype("<u2" if array.dtype == BFLOAT16 else array.dtype)
    is_big = isinstance(array.payload, StorageSlice) and array.payload.storage.is_big
    return dtype.newbyteorder(">") if is_big else dtype


def _native(values: np.ndarray, dtype: str) -> np.ndarray:
    """The values in native byte order; half-width ones widened where NumPy lacks them."""
    if dtype == BFLOAT16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(values.dtype.newbyteorder("="), copy=False)


class _PayloadReader:
    """Goes through the bytes of an array from the first to the last."""

    def __init__(self, array: LazyArray) -> None:
        self._array = array
        payload = array.payload
        self._memory = payload if isinstance(payload, bytes) else None
        if isinstance(payload, StorageSlice):
            payload = _storage_slice(payload, array)
        self._slice = payload if isinstance(payload, Slice) else None
        self._position, self._left = 0, array.byte_count
        self._pending = b""
        is_text = self._slice is not None and self._slice.is_text
        self._decoder = codecs.getincrementaldecoder("utf-8")() if is_text else None

    def read(self, count: int) -> bytes | bytearray:
        """The next bytes; the text must end with the array."""
        self._left -= count
        if self._memory is not None:
            data = self._memory[self._position : self._position + count]
            self._position += count
            return data
        assert self._slice is not None  # noqa: S101 - a payload is one of the three
        if self._decoder is None:
            data = self._slice.source.read_at(self._slice.offset + self._position, count)
            self._position += count
            return data
        return self._read_text(count)

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        if self._decoder is None:
            self._position += count
            self._left -= count
            return
        while count:
            step = min(count, STEP_BYTES)
            self.read(step)
            count -= step

    def _read_text(self, count: int) -> bytearray:
        assert self._slice is not None  # noqa: S101 - text lies in a source
        gathered = bytearray(self._pending)
        while len(gathered) < count and self._position < self._slice.length:
            gathered += self._decode_step()
        if self._left == 0:
            while self._position < self._slice.length and len(gathered) <= count:
                gathered += self._decode_step()
        if len(gathered) < count or (self._left == 0 and len(gathered) > count):
            raise DataError(
                f"{self._slice.source.name}: the array at byte {self._slice.offset} does not have "
                f"the number of bytes that its shape {self._array.shape} asks for."
            )
        self._pending = bytes(gathered[count:])
        return gathered[:count]

    def _decode_step(self) -> bytes:
        """Some more text as bytes."""
        assert self._slice is not None  # noqa: S101 - text lies in a source
        assert self._decoder is not None  # noqa: S101 - only called for text
        step = min(STEP_BYTES, self._slice.length - self._position)
        raw = self._slice.source.read_at(self._slice.offset + self._position, step)
        self._position += step
        try:
            text = self._decoder.decode(raw, final=self._position == self._slice.length)
            return text.encode("latin-1")
        except UnicodeError:
            raise DataError(
                f"{self._slice.source.name}: the array at byte {self._slice.offset} is stored as "
                f"text that is no Latin-1. The file is damaged."
            ) from None


def _storage_slice(payload: StorageSlice, array: LazyArray) -> Slice:
    """Where the elements of a tensor lie, checked against the storage."""
    storage, size = payload.storage, array.item_size
    if storage.source is None:
        raise DataError(f"the tensor storage {storage.key!r} is missing. The file is damaged.")
    if payload.first * size + array.byte_count > storage.count * size:
        raise DataError(f"a tensor of shape {array.shape} exceeds its storage. It is damaged.")
    return Slice(storage.source, storage.offset + payload.first * size, array.byte_count)
