"""The opcodes of a pickle that data files need, read one after the other without doing them.

``steps`` gives each opcode with its argument. Short text and bytes are given as such; long ones,
which can only be the bytes of an array, as the place where they lie. An opcode that is
not in the table ends the reading: what makes objects of classes, extension codes, objects by
text identity and the old text protocols have no entry.
"""

import struct
from collections.abc import Callable, Iterator
from typing import Any

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource, Cursor
from giorom.data.readers.lazy_array import Slice

__all__ = ["BINGET", "LONG_BINGET", "STOP", "steps"]

SHORT_TEXT = 256
"""Text up to this many bytes is decoded at once; longer text can only be array bytes."""

MOST_STEPS, FREE_STEPS, BYTES_PER_STEP = 20_000_000, 2_000_000, 16
"""Longest pickle: the largest published file needs half of it. A small file may take fewer steps: a
window of twenty particles has 24 bytes for each."""

STOP, BINGET, LONG_BINGET = 0x2E, 0x68, 0x6A


def steps(source: ByteSource, start: int) -> Iterator[tuple[int, int, Any, int]]:
    """Position, code, argument and end of each opcode up to STOP; payloads are passed over."""
    cursor = Cursor(source, start)
    most = min(MOST_STEPS, FREE_STEPS + source.size // BYTES_PER_STEP)
    for _ in range(most):
        position = cursor.position
        code = cursor.take(1)[0]
        reader = ARGUMENTS.get(code)
        if reader is None:
            raise DataError(
                f"{source.name}: the pickle uses {_opcode_name(code)} at byte {position}, which no "
                f"array needs; it is refused and nothing was run. Do not trust this file."
            )
        argument = reader(cursor)
        yield position, code, argument, cursor.position
        if code == STOP:
            return
    raise DataError(
        f"{source.name}: the pickle takes more than {most} steps. It is hostile, or too "
        f"large to be read in one piece; split it."
    )


def _opcode_name(code: int) -> str:
    """The name of an opcode for a message."""
    import pickletools

    known = pickletools.code2op.get(chr(code))  # type: ignore[attr-defined]
    return f"the opcode {known.name}" if known else f"no opcode but the byte 0x{code:02x}"


def _unsigned(count: int) -> Callable[[Cursor], int]:
    return lambda cursor: int.from_bytes(cursor.take(count), "little")


def _signed(cursor: Cursor) -> int:
    return int.from_bytes(cursor.take(4), "little", signed=True)


def _long(cursor: Cursor) -> int:
    count = cursor.take(1)[0]
    if count > 16:
        raise DataError(
            f"{cursor.source.name}: an integer of {count} bytes is no size of an array."
        )
    return int.from_bytes(cursor.take(count), "little", signed=True)


def _float(cursor: Cursor) -> float:
    return float(struct.unpack(">d", cursor.take(8))[0])


def _text(count: int) -> Callable[[Cursor], str | Slice]:
    return lambda cursor: _stretch(cursor, int.from_bytes(cursor.take(count), "little"), True)


def _bytes(count: int) -> Callable[[Cursor], bytes | Slice]:
    return lambda cursor: _stretch(cursor, int.from_bytes(cursor.take(count), "little"), False)


def _stretch(cursor: Cursor, length: int, is_text: bool) -> Any:
    """Short text or bytes themselves, long ones as the place where they lie."""
    if length > SHORT_TEXT:
        offset = cursor.position
        cursor.skip(length)
        return Slice(cursor.source, offset, length, is_text)
    raw = cursor.take(length)
    if not is_text:
        return raw
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise DataError(
            f"{cursor.source.name}: text at byte {cursor.position - length} is no UTF-8. "
            f"The file is damaged."
        ) from None


def _none(cursor: Cursor) -> None:
    """Opcodes without an argument."""


def _frame(cursor: Cursor) -> None:
    cursor.take(8)


def _protocol(cursor: Cursor) -> None:
    if cursor.take(1)[0] not in (2, 3, 4, 5):
        raise DataError(
            f"{cursor.source.name}: pickle protocols 2 to 5 are read, and this is another. "
            f"The file is damaged or very old."
        )


def _global_names(cursor: Cursor) -> tuple[str, str]:
    return _line(cursor), _line(cursor)


def _line(cursor: Cursor) -> str:
    """Text up to the end of the line."""
    raw = bytearray()
    while (byte := cursor.take(1)) != b"\n":
        raw += byte
        if len(raw) > SHORT_TEXT:
            raise DataError(f"{cursor.source.name}: the name of a global has no end.")
    return raw.decode("utf-8", errors="replace")


ARGUMENTS: dict[int, Callable[[Cursor], Any]] = {
    0x80: _protocol,
    0x95: _frame,
    STOP: _none,
    ord("("): _none,
    ord("0"): _none,
    ord("1"): _none,
    ord("N"): _none,
    0x88: _none,
    0x89: _none,
    ord("J"): _signed,
    ord("K"): _unsigned(1),
    ord("M"): _unsigned(2),
    0x8A: _long,
    ord("G"): _float,
    ord("X"): _text(4),
    0x8C: _text(1),
    0x8D: _text(8),
    ord("B"): _bytes(4),
    ord("C"): _bytes(1),
    0x8E: _bytes(8),
    0x96: _bytes(8),
    ord("]"): _none,
    ord("a"): _none,
    ord("e"): _none,
    ord("l"): _none,
    ord(")"): _none,
    ord("t"): _none,
    0x85: _none,
    0x86: _none,
    0x87: _none,
    ord("}"): _none,
    ord("d"): _none,
    ord("s"): _none,
    ord("u"): _none,
    BINGET: _unsigned(1),
    LONG_BINGET: _unsigned(4),
    ord("q"): _unsigned(1),
    ord("r"): _unsigned(4),
    0x94: _none,
    ord("c"): _global_names,
    0x93: _none,
    ord("R"): _none,
    ord("b"): _none,
    ord("Q"): _none,
}
"""How the argument of each opcode is read; opcodes without an entry are refused."""
