"""Named streams of random numbers: one per link, so that links do not disturb each other.

A stream is a function of (seed, name, counter) only. Adding, removing or renaming one leaves all
others unchanged, which a shared generator cannot promise.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Iterator
from fractions import Fraction
from hashlib import blake2b, shake_128
from itertools import accumulate, chain
from math import frexp, ldexp

import numpy as np
import numpy.typing as npt

from rsltrace.fast_dataclass import dataclass

# Logarithm and exponential with the same bits on every machine.

# C libraries differ in the last bit of ``log`` and ``exp``. These use only operations that IEEE 754
# rounds correctly, in a fixed order, and are good to about 1e-15.

_SQRT_HALF = 0.7071067811865476
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10
_LOG2_E = 1.4426950408889634
_LOG_TERMS = tuple(1.0 / k for k in range(25, 0, -2))
_EXP_TERMS = tuple(1.0 / k for k in range(16, 0, -1))


def log(x: float) -> float:
    """Return the natural logarithm of ``x > 0``, by the series of atanh."""
    fraction, exponent = frexp(x)
    if fraction < _SQRT_HALF:
        fraction *= 2.0
        exponent -= 1
    s = (fraction - 1.0) / (fraction + 1.0)
    square = s * s
    total = 0.0
    for coefficient in _LOG_TERMS:
        total = total * square + coefficient
    return exponent * _LN2_HIGH + (2.0 * s * total + exponent * _LN2_LOW)


def exp(x: float) -> float:
    """Return e to the power of ``x`` (|x| up to 700), by range reduction and Taylor's series."""
    exponent = int(x * _LOG2_E + (0.5 if x >= 0.0 else -0.5))
    rest = (x - exponent * _LN2_HIGH) - exponent * _LN2_LOW
    total = 1.0
    for reciprocal in _EXP_TERMS:
        total = 1.0 + rest * reciprocal * total
    return ldexp(total, exponent)


_BLOCK_BYTES = 8 * 64
_BLOCKS_MAX = 8
"""How many blocks are made at a time, at most: a link that is hardly used has only its first."""

_ONE = np.float64(1.0).view(np.uint64)
_LESS = np.float64(1.0 - 2.0**-53)


class RandomStream:
    """Random numbers of one purpose. ``uniform()`` is in (0, 1), both ends excluded.

    Counter mode: block *n* is SHAKE-128 of a 32-byte key and *n*; the key is BLAKE2b of seed and
    name. Each number is the upper 52 bits of 8 bytes, plus a half, times 2**-52.
    """

    __slots__ = ("_key", "name", "uniform")

    def __init__(self, seed: int, name: str) -> None:
        self.name = name
        self._key = blake2b(f"{seed}\0{name}".encode(), digest_size=32, person=b"rsltrace").digest()
        blocks = (numbers.tolist() for numbers in self._numbers())
        self.uniform = chain.from_iterable(blocks).__next__

    def below(self, count: int) -> int:
        """Return an integer from 0 to ``count`` - 1."""
        return int(self.uniform() * count)

    def whole_numbers(self, low: int, count: int) -> Iterator[array[int]]:
        """Yield ``low + below(count)`` forever, from the stream's beginning, many at a time: twice
        as fast, and a number takes 8 bytes until it is drawn."""
        for numbers in self._numbers():
            yield array("q", (np.floor(numbers * float(count)).astype(np.int64) + low).tobytes())

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


@dataclass(frozen=True, slots=True)
class ClockModel:
    """What is wrong with a clock. Times are nanoseconds; those of jumps count from the start.

    ``random_every_ns`` is the mean time between random jumps (0: none), uniform up to
    ``random_most_ns`` in both directions.
    """

    offset_ns: int = 0
    drift: Fraction = Fraction(0)
    jumps: tuple[tuple[int, int], ...] = ()
    random_every_ns: int = 0
    random_most_ns: int = 0


class SkewedClock:
    """The time that one node's clock shows. Exact: no floats after the draws."""

    def __init__(self, model: ClockModel, stream: RandomStream, start_ns: int) -> None:
        self._model = model
        self._start_ns = start_ns
        self._given_at = [at_ns for at_ns, _ in model.jumps]
        self._given_sum = list(accumulate((by_ns for _, by_ns in model.jumps), initial=0))
        self._uniform = stream.uniform
        self._drawn_at: list[int] = []
        self._drawn_sum = [0]
        self._drawn_until_ns = 0
        self._reported = 0

    def shows(self, now_ns: int) -> int:
        model = self._model
        since_ns = now_ns - self._start_ns
        drift_ns = since_ns * model.drift.numerator // model.drift.denominator
        wrong_ns = model.offset_ns + drift_ns
        wrong_ns += self._given_sum[bisect_right(self._given_at, since_ns)]
        if model.random_every_ns:
            self._draw_until(since_ns)
            wrong_ns += self._drawn_sum[bisect_right(self._drawn_at, since_ns)]
        return max(now_ns + wrong_ns, 0)

    def set_since(self, now_ns: int) -> int:
        """Return the sum of random jumps since the last call."""
        if not self._model.random_every_ns:
            return 0
        since_ns = now_ns - self._start_ns
        self._draw_until(since_ns)
        count = max(bisect_right(self._drawn_at, since_ns), self._reported)
        before, self._reported = self._reported, count
        return self._drawn_sum[count] - self._drawn_sum[before]

    def _draw_until(self, since_ns: int) -> None:
        """Draw the jumps up to a time: gaps are exponential."""
        model = self._model
        while self._drawn_until_ns <= since_ns:
            gap_ns = int(-log(self._uniform()) * model.random_every_ns) + 1
            size_ns = int((2.0 * self._uniform() - 1.0) * model.random_most_ns)
            self._drawn_until_ns += gap_ns
            self._drawn_at.append(self._drawn_until_ns)
            self._drawn_sum.append(self._drawn_sum[-1] + size_ns)
