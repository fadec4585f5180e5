"""Named streams of random numbers: one per link, so that no link disturbs another.

A stream is a function of (seed, name, counter) and of nothing else. Adding, removing or renaming
one leaves all others as they were, which a generator shared by all cannot promise.
"""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import blake2b, shake_128
from itertools import chain

import numpy as np
import numpy.typing as npt

_BLOCK_BYTES = 8 * 64
_BLOCKS_MAX = 8
"""How many blocks are made at a time, at most: a link that is hardly used has only its first."""

_ONE = np.float64(1.0).view(np.uint64)
_LESS = np.float64(1.0 - 2.0**-53)


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
        """Return ``low + below(count)`` forever, from the stream's beginning, in half the time."""
        return chain.from_iterable(self._whole_numbers(low, float(count)))

    def _uniforms(self) -> Iterator[list[float]]:
        for numbers in self._numbers():
            yield numbers.tolist()

    def _whole_numbers(self, low: int, count: float) -> Iterator[list[int]]:
        for numbers in self._numbers():
            yield (np.floor(numbers * count).astype(np.int64) + low).tolist()

    def _numbers(self) -> Iterator[npt.NDArray[np.float64]]:
        """Yield many numbers at a time, and more the more are asked for.

        52 random bits below the exponent of 1.0 are a double in [1, 2). Making it one in (0, 1) by
        subtraction is exact, so this is the same everywhere.
        """
        first, blocks = 0, 1
        while True:
            digests = [
                shake_128(self._key + number.to_bytes(8, "little")).digest(_BLOCK_BYTES)
                for number in range(first, first + blocks)
            ]
            first += blocks
            blocks = min(2 * blocks, _BLOCKS_MAX)
            bits = np.frombuffer(b"".join(digests), dtype="<u8").astype(np.uint64)
            yield (bits >> np.uint64(12) | _ONE).view(np.float64) - _LESS
