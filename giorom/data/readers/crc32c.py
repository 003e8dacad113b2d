r"""CRC-32C (Castagnoli), fast enough for gigabytes without compiled code.

The check sum is a linear function of the message over GF(2). A block is cut into lanes of equal
length that are processed side by side, four bytes at a time through two tables of 65536 entries,
and the sums of neighbouring lanes are joined pairwise:

.. math:: c(AB) = M^{|B|} c(A) + c(B),

where M is the effect of one zero byte. Zero bytes in front of a message do not change the sum of
a register that starts at zero, so any block can be padded there; the register of
what came before enters by adding it to the first four bytes.

Source: polynomial 0x1EDC6F41 of RFC 3720, appendix B.4 (reflected: 0x82F63B78). TFRecord stores
the sum "masked": rotated right by 15 bits, plus a constant.
"""

from collections.abc import Iterable
from functools import cache

import numpy as np

__all__ = ["crc32c", "masked"]

POLYNOMIAL = 0x82F63B78
MASK = 0xA282EAD8
LANE_BYTES = 256
"""Length of a lane."""


def crc32c(pieces: Iterable[bytes]) -> int:
    """Check sum of a message.

    Args:
        pieces: The message, in pieces of any length.

    Returns:
        The sum, 32 bits.
    """
    register = 0xFFFFFFFF
    for piece in pieces:
        if len(piece) < 2 * LANE_BYTES:
            register = _bytewise(register, piece)
        else:
            register = _lanes(register, piece)
    return register ^ 0xFFFFFFFF


def masked(check_sum: int) -> int:
    """The form in which TFRecord stores a sum.

    Args:
        check_sum: CRC-32C.

    Returns:
        The masked sum, 32 bits.
    """
    rotated = (check_sum >> 15) | (check_sum << 17)
    return (rotated + MASK) & 0xFFFFFFFF


def _bytewise(register: int, piece: bytes) -> int:
    table = _byte_table()
    for byte in piece:
        register = table[(register ^ byte) & 0xFF] ^ (register >> 8)
    return register


def _lanes(register: int, piece: bytes) -> int:
    """The register after a piece of some length."""
    lanes = 1 << (-(-len(piece) // LANE_BYTES) - 1).bit_length()
    padded = np.zeros(lanes * LANE_BYTES, np.uint8)
    start = len(padded) - len(piece)
    padded[start:] = np.frombuffer(piece, np.uint8)
    padded[start : start + 4] ^= np.array([register], "<u4").view(np.uint8)
    words = np.ascontiguousarray(padded.view("<u4").reshape(lanes, -1).T)
    low, high = _word_tables()
    sums = np.zeros(lanes, np.uint32)
    for word in words:
        mixed = sums ^ word
        sums = low[mixed & 0xFFFF] ^ high[mixed >> 16]
    level = 0
    while len(sums) > 1:
        sums = _apply(_shift_tables(level), sums[0::2]) ^ sums[1::2]
        level += 1
    return int(sums[0])


@cache
def _byte_table() -> tuple[int, ...]:
    """Effect of one byte on the register."""
    table = []
    for value in range(256):
        entry = value
        for _ in range(8):
            entry = (entry >> 1) ^ (POLYNOMIAL if entry & 1 else 0)
        table.append(entry)
    return tuple(table)


def _columns(zero_bytes: int) -> np.ndarray:
    """Where each of the 32 bits of the register goes when zero bytes follow."""
    return np.array([_bytewise(1 << bit, bytes(zero_bytes)) for bit in range(32)], np.uint32)


def _linear_table(columns: np.ndarray) -> np.ndarray:
    """Images of all numbers of ``len(columns)`` bits, by doubling."""
    table = np.zeros(1, np.uint32)
    for column in columns:
        table = np.concatenate([table, table ^ column])
    return table


@cache
def _word_tables() -> tuple[np.ndarray, np.ndarray]:
    """Effect of four zero bytes on the lower and the upper half of the register."""
    columns = _columns(4)
    return _linear_table(columns[:16]), _linear_table(columns[16:])


@cache
def _shift_tables(level: int) -> tuple[np.ndarray, ...]:
    """Effect of 2^level lanes of zero bytes on each byte of the register."""
    columns = _columns(LANE_BYTES)
    if level:
        smaller = _shift_tables(level - 1)
        columns = np.array([table[1 << bit] for table in smaller for bit in range(8)], np.uint32)
        columns = _apply(smaller, columns)
    return tuple(_linear_table(columns[8 * byte : 8 * byte + 8]) for byte in range(4))


def _apply(tables: tuple[np.ndarray, ...], values: np.ndarray) -> np.ndarray:
    """Images of many registers."""
    result = tables[0][values & 0xFF]
    for byte in range(1, 4):
        result = result ^ tables[byte][(values >> (8 * byte)) & 0xFF]
    return result
