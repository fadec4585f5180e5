"""CRC-32: as fast as the processor allows, and of joined pieces with known checksums."""

from __future__ import annotations

from functools import cache

try:
    from zlib_ng.zlib_ng import crc32  # carry-less multiplication: ten times as fast as zlib's
except ImportError:  # a sourced ROS 2 with its own Python may not have it
    from zlib import crc32

_POLYNOMIAL = 0xEDB88320

_Matrix = tuple[int, ...]
"""The effect of appended zeros on a CRC: linear over GF(2), a column per bit."""


def joined_crc(first: int, second: int, length: int) -> int:
    """Return the CRC-32 of two pieces in sequence; the second has ``length`` bytes.

    Takes some 20 microseconds per set bit of the length.
    """
    power = 0
    while length:
        if length & 1:
            first = _times(_zeros(power), first)
        length >>= 1
        power += 1
    return first ^ second


def crc_of(parts: tuple[bytes, ...]) -> int:
    """Return the CRC-32 of all parts in sequence."""
    crc = 0
    for part in parts:
        crc = crc32(part, crc)
    return crc


@cache
def _zeros(power: int) -> _Matrix:
    """Return the effect of 2 ** power zero bytes."""
    if power == 0:
        bit = (_POLYNOMIAL, *(1 << n for n in range(31)))
        two = _squared(bit)
        return _squared(_squared(two))
    return _squared(_zeros(power - 1))


def _squared(matrix: _Matrix) -> _Matrix:
    return tuple(_times(matrix, column) for column in matrix)


def _times(matrix: _Matrix, vector: int) -> int:
    result = 0
    for column in matrix:
        if not vector:
            break
        if vector & 1:
            result ^= column
        vector >>= 1
    return result


__all__ = ["crc32", "crc_of", "joined_crc"]
