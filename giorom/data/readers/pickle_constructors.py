"""What the known globals of a pickle mean: descriptions of arrays, never calls.

``restricted_pickle`` hands the arguments here that a pickle would pass to NumPy or PyTorch. Each
constructor checks their form and describes the array. Sizes are compared with the bytes that are
there when an array is described, so that a shape costs nothing before it is believed.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from giorom.data.readers.lazy_array import (
    BFLOAT16,
    LazyArray,
    Slice,
    StorageSlice,
    TensorStorage,
    c_order,
)

__all__ = ["CONSTRUCTORS", "Global", "Refused", "StoredArray", "build", "storage_of"]

MOST_AXES = 8
MOST_ELEMENTS = 1 << 48
"""Limits of a shape; more is damage."""

STORAGE_TYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "BFloat16Storage": BFLOAT16,
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "|b1",
}
"""PyTorch's storages and the type of their elements."""


class Refused(Exception):  # noqa: N818 - what happens to the file
    """The pickle asks for something that has no meaning here."""


@dataclass(frozen=True, slots=True)
class Global:
    """The name of a known global; nothing is imported."""

    name: str

    @staticmethod
    def known(module: str, name: str) -> "Global":
        """The token of a global.

        Args:
            module: Its module.
            name: Its name.

        Returns:
            The token, with ``numpy._core`` written as ``numpy.core``.

        Raises:
            Refused: If no array needs it.
        """
        full = f"{module}.{name}"
        canonical = re.sub(r"^numpy\._core\.", "numpy.core.", full)
        if canonical in CONSTRUCTORS or canonical in _NAMES:
            return Global(canonical)
        raise Refused(
            f"it asks for the global {full[:100]!r}, which no array needs. Do not trust this file"
        )


@dataclass(slots=True)
class ElementType:
    """A NumPy type under construction."""

    code: str
    byte_order: str = "<"

    @property
    def full(self) -> str:
        """The code with its byte order."""
        return ("|" if self.code in ("b1", "O8") else self.byte_order) + self.code


@dataclass(slots=True)
class StoredArray:
    """A NumPy array under construction; it holds objects or, once built, an array."""

    shape: tuple[int, ...] = ()
    values: list[Any] | None = None
    array: LazyArray | None = None


def build(target: Any, state: Any) -> None:
    """Give a constructed object its state.

    Args:
        target: An array or a type.
        state: What the pickle says about it.

    Raises:
        Refused: If the state has not the form that NumPy writes.
    """
    if type(target) is ElementType:
        _build_type(target, state)
    elif type(target) is StoredArray:
        _build_array(target, state)
    else:
        raise Refused(f"it sets the state of a {type(target).__name__}")


def storage_of(identity: Any) -> TensorStorage:
    """The tensor storage that a persistent id of ``torch.save`` names.

    Args:
        identity: The id.

    Returns:
        The storage; its place is filled in by who reads the file.

    Raises:
        Refused: If the id has not PyTorch's form.
    """
    form = (
        type(identity) is tuple
        and len(identity) in (5, 6)
        and identity[0] == "storage"
        and type(identity[1]) is Global
        and identity[1].name.startswith("torch.")
        and all(type(part) is str for part in identity[2:4])
        and (len(identity) == 5 or identity[5] is None)
    )
    if not form:
        raise Refused("it refers to something outside that is no tensor storage")
    dtype = STORAGE_TYPES.get(identity[1].name.removeprefix("torch."))
    if dtype is None:
        raise Refused(f"it uses {identity[1].name} as a tensor storage")
    return TensorStorage(key=identity[2], dtype=dtype, count=_size(identity[4]))


def _build_type(target: ElementType, state: Any) -> None:
    form = type(state) is tuple and len(state) in (8, 9) and state[2:5] == (None, None, None)
    if not form or type(state[1]) is not str or state[1] not in ("<", ">", "|", "="):
        raise Refused("it describes an element type that is no plain number")
    target.byte_order = ">" if state[1] == ">" else "<"


def _build_array(target: StoredArray, state: Any) -> None:
    if type(state) is not tuple or len(state) != 5 or target.array or target.values is not None:
        raise Refused("it describes an array in another way than NumPy")
    _, shape, dtype, is_fortran, content = state
    if type(dtype) is not ElementType or type(is_fortran) is not bool:
        raise Refused("it describes an array in another way than NumPy")
    target.shape = _shape(shape)
    if dtype.code == "O8":
        if type(content) is not list or len(content) != math.prod(target.shape) or is_fortran:
            raise Refused("an array of objects does not hold as many objects as its shape says")
        target.values = content
        return
    target.array = _array(dtype, target.shape, content, is_fortran=is_fortran)


def _array(dtype: ElementType, shape: tuple[int, ...], content: Any, *, is_fortran: bool) -> Any:
    """An array of numbers, its size compared with its bytes."""
    if dtype.code == "O8" or type(content) not in (bytes, Slice):
        raise Refused("an array of numbers has no bytes")
    order = c_order(len(shape))
    array = LazyArray(dtype.full, shape, order[::-1] if is_fortran else order, content)
    length = len(content) if isinstance(content, bytes) else content.length
    is_text = isinstance(content, Slice) and content.is_text
    if not array.byte_count <= length <= array.byte_count * (2 if is_text else 1):
        raise Refused(
            f"an array of shape {shape} and type {dtype.full} needs {array.byte_count} bytes, but "
            f"{length} are there"
        )
    return array


def _reconstruct(arguments: tuple[Any, ...]) -> StoredArray:
    form = len(arguments) == 3 and arguments[0] == Global("numpy.ndarray")
    if not form or arguments[1] != (0,):
        raise Refused("it makes an array in another way than NumPy")
    return StoredArray()


def _dtype(arguments: tuple[Any, ...]) -> ElementType:
    code = arguments[0] if arguments else None
    if type(code) is not str or not re.fullmatch(r"f[248]|[iu][1248]|b1|O8", code):
        raise Refused(
            f"it holds elements of the type {str(code)[:20]!r}; plain numbers are read here"
        )
    return ElementType(code)


def _encode(arguments: tuple[Any, ...]) -> Any:
    if len(arguments) != 2 or arguments[1] not in ("latin1", "latin-1"):
        raise Refused("it encodes text in another way than pickle does")
    text = arguments[0]
    if type(text) is Slice and text.is_text:
        return text
    if type(text) is not str:
        raise Refused("it encodes something that is no text")
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError:
        raise Refused("its array bytes are text that is no Latin-1") from None


def _empty_bytes(arguments: tuple[Any, ...]) -> bytes:
    if arguments:
        raise Refused("it makes bytes in another way than pickle does")
    return b""


def _ordered_dict(arguments: tuple[Any, ...]) -> dict[str, Any]:
    if arguments:
        raise Refused("it fills an OrderedDict in an unusual way")
    return {}


def _scalar(arguments: tuple[Any, ...]) -> StoredArray:
    if len(arguments) != 2 or type(arguments[0]) is not ElementType:
        raise Refused("it makes a number in another way than NumPy")
    return StoredArray(array=_array(arguments[0], (), arguments[1], is_fortran=False))


def _from_buffer(arguments: tuple[Any, ...]) -> StoredArray:
    if len(arguments) != 4 or type(arguments[1]) is not ElementType:
        raise Refused("it makes an array in another way than NumPy")
    content, dtype, shape, order = arguments
    if order not in ("C", "F"):
        raise Refused("it orders an array in an unknown way")
    shape = _shape(shape)
    return StoredArray(shape, None, _array(dtype, shape, content, is_fortran=order == "F"))


def _tensor(arguments: tuple[Any, ...]) -> StoredArray:
    """A dense tensor: any order of the axes, but no gaps and no repetition."""
    if len(arguments) not in (6, 7) or type(arguments[0]) is not TensorStorage:
        raise Refused("it makes a tensor in another way than PyTorch")
    storage, first, shape, stride = arguments[0], _size(arguments[1]), *map(_shape, arguments[2:4])
    if len(shape) != len(stride):
        raise Refused("a tensor has more strides than axes, or fewer")
    order = tuple(sorted(range(len(shape)), key=lambda axis: (-stride[axis], -shape[axis])))
    step = 1
    for axis in reversed(order):
        if shape[axis] > 1 and stride[axis] != step:
            raise Refused(
                f"a tensor of shape {shape} has strides {stride}, which leave gaps or repeat; "
                f"store it with .contiguous()"
            )
        step *= max(shape[axis], 1)
    if first + math.prod(shape) > storage.count:
        raise Refused(f"a tensor of shape {shape} exceeds its storage of {storage.count} elements")
    array = LazyArray(storage.dtype, shape, order, StorageSlice(storage, first))
    return StoredArray(shape, None, array)


def _shape(value: Any) -> tuple[int, ...]:
    """A checked shape."""
    if type(value) is not tuple or len(value) > MOST_AXES:
        raise Refused("a shape is no short tuple")
    shape = tuple(_size(length) for length in value)
    if math.prod(shape) > MOST_ELEMENTS:
        raise Refused(f"a shape of {shape} is absurd")
    return shape


def _size(value: Any) -> int:
    """A checked number of elements."""
    if type(value) is not int or not 0 <= value <= MOST_ELEMENTS:
        raise Refused("a size is negative, absurd or no integer")
    return value


CONSTRUCTORS: dict[str, Callable[[tuple[Any, ...]], Any]] = {
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "numpy.dtype": _dtype,
    "_codecs.encode": _encode,
    "__builtin__.bytes": _empty_bytes,
    "collections.OrderedDict": _ordered_dict,
    "torch._utils._rebuild_tensor_v2": _tensor,
}
"""The globals that may be called."""

_NAMES = {"numpy.ndarray", *(f"torch.{name}" for name in STORAGE_TYPES)}
"""The globals that may only be named."""
