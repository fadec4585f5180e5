"""Named streams of random numbers: one per link, so that no link disturbs another.

A stream is a function of (seed, name, counter) and of nothing else. Adding, removing or renaming
one leaves all others as they were, which a generator shared by all cannot promise.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from hashlib import blake2b, shake_128
from itertools import chain
from math import floor

_BLOCK = 64
_BYTES = 8 * _BLOCK
_unpack = struct.Struct(f"<{_BLOCK}d").unpack
_LOW_52_BITS = int.from_bytes(((1 << 52) - 1).to_bytes(8, "little") * _BLOCK, "little")
_ONES = int.from_bytes(struct.pack("<d", 1.0) * _BLOCK, "little")
_HALF_BELOW_ONE = 1.0 - 2.0**-53


class Stream:
    """Random numbers of one purpose. ``uniform()`` is in (0, 1), both ends excluded.

    Counter mode: block *n* is SHAKE-128 of a 32-byte key and *n*; the key is BLAKE2b of seed and
    name. Each number is the upper 52 bits of 8 bytes, plus a half, times 2**-52.
    """

    __slots__ = ("_key", "name", "uniform")

    def __init__(self, seed: int, name: str) -> None:
        self.name = name
        self._key = blake2b(f"{seed}\0{name}".encode(), digest_size=32, person=b"rsltrace").digest()
        self.uniform = chain.from_iterable(self._uniforms()).__next__

    def below(self, count: int) -> int:
        """Return an integer from 0 to ``count`` - 1."""
        return int(self.uniform() * count)

    def whole_numbers(self, low: int, count: int) -> Iterator[int]:
        """Return ``low + below(count)`` for ever, from the stream's beginning, in half the time."""
        return chain.from_iterable(self._whole_numbers(low, float(count)))

    def _uniforms(self) -> Iterator[list[float]]:
        for block in self._blocks():
            yield [number - _HALF_BELOW_ONE for number in block]

    def _whole_numbers(self, low: int, count: float) -> Iterator[list[int]]:
        less = _HALF_BELOW_ONE
        for block in self._blocks():
            yield [low + floor((number - less) * count) for number in block]

    def _blocks(self) -> Iterator[tuple[float, ...]]:
        """Yield many numbers at a time, each too large by ``_HALF_BELOW_ONE``.

        A whole block is made by a few operations on one large integer: 52 random bits below the
        exponent of 1.0 are a double in [1, 2). Making it one in (0, 1) by subtraction is exact.
        """
        number = 0
        while True:
            digest = shake_128(self._key + number.to_bytes(8, "little")).digest(_BYTES)
            lanes = int.from_bytes(digest, "little") >> 12 & _LOW_52_BITS | _ONES
            yield _unpack(lanes.to_bytes(_BYTES, "little"))
            number += 1
