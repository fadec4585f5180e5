"""Named streams of random numbers: one per link, so that no link disturbs another.

A stream is a function of (seed, name, counter) and of nothing else. Adding, removing or renaming
one leaves all others as they were, which a generator shared by all cannot promise.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from hashlib import blake2b, shake_128

_BLOCK = 64
_unpack = struct.Struct(f"<{_BLOCK}Q").unpack


class Stream:
    """Random numbers of one purpose. ``uniform()`` is in (0, 1), both ends excluded.

    Counter mode: block *n* is SHAKE-128 of a 32-byte key and *n*; the key is BLAKE2b of seed and
    name. Each number is the upper 52 bits of 8 bytes, plus a half.
    """

    __slots__ = ("name", "uniform")

    def __init__(self, seed: int, name: str) -> None:
        self.name = name
        key = blake2b(f"{seed}\0{name}".encode(), digest_size=32, person=b"rsltrace").digest()
        self.uniform = _uniforms(key).__next__

    def below(self, count: int) -> int:
        """Return an integer from 0 to ``count`` - 1."""
        return int(self.uniform() * count)


def _uniforms(key: bytes) -> Iterator[float]:
    block = 0
    while True:
        digest = shake_128(key + block.to_bytes(8, "little")).digest(8 * _BLOCK)
        for bits in _unpack(digest):
            yield ((bits >> 12) + 0.5) * 2.220446049250313e-16  # 2**-52: exact
        block += 1
