"""Distributions of delays and execution times: frozen descriptions, and samplers that draw.

Parameters are nanoseconds unless stated. ``sampler`` binds a description to a random stream and the
start of the run; it is called with the current time and returns nanoseconds, never negative.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from itertools import chain
from math import sqrt
from typing import TYPE_CHECKING, Protocol, cast

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.stream import exp, log

if TYPE_CHECKING:
    from rsltrace.simulation.chance.stream import RandomStream

# The quantile function of the normal distribution: algorithm AS 241 (PPND16) of M. J. Wichura,
# Applied Statistics 37 (1988) 477-484, to about 16 digits. One uniform number gives one normal
# one.

_CENTRE = (
    (
        2509.0809287301226727,
        33430.575583588128105,
        67265.770927008700853,
        45921.953931549871457,
        13731.693765509461125,
        1971.5909503065514427,
        133.14166789178437745,
        3.387132872796366608,
    ),
    (
        5226.495278852545925,
        28729.085735721942674,
        39307.89580009271061,
        21213.794301586595867,
        5394.1960214247511077,
        687.1870074920579083,
        42.313330701600911252,
        1.0,
    ),
)
_MIDDLE = (
    (
        7.7454501427834140764e-4,
        0.0227238449892691845833,
        0.24178072517745061177,
        1.27045825245236838258,
        3.64784832476320460504,
        5.7694972214606914055,
        4.6303378461565452959,
        1.42343711074968357734,
    ),
    (
        1.05075007164441684324e-9,
        5.475938084995344946e-4,
        0.0151986665636164571966,
        0.14810397642748007459,
        0.68976733498510000455,
        1.6763848301838038494,
        2.05319162663775882187,
        1.0,
    ),
)
_TAIL = (
    (
        2.01033439929228813265e-7,
        2.71155556874348757815e-5,
        0.0012426609473880784386,
        0.026532189526576123093,
        0.29656057182850489123,
        1.7848265399172913358,
        5.4637849111641143699,
        6.6579046435011037772,
    ),
    (
        2.04426310338993978564e-15,
        1.4215117583164458887e-7,
        1.8463183175100546818e-5,
        7.868691311456132591e-4,
        0.0148753612908506148525,
        0.13692988092273580531,
        0.59983220655588793769,
        1.0,
    ),
)


def _ratio(pair: tuple[tuple[float, ...], tuple[float, ...]], r: float) -> float:
    above, below = 0.0, 0.0
    for numerator, denominator in zip(pair[0], pair[1], strict=True):
        above = above * r + numerator
        below = below * r + denominator
    return above / below


def normal_quantile(p: float) -> float:
    """Return x with P(X <= x) = p for a standard normal X; 0 < p < 1."""
    q = p - 0.5
    if -0.425 <= q <= 0.425:
        return q * _ratio(_CENTRE, 0.180625 - q * q)
    r = sqrt(-log(p if q < 0.0 else 1.0 - p))
    x = _ratio(_MIDDLE, r - 1.6) if r <= 5.0 else _ratio(_TAIL, r - 5.0)
    return -x if q < 0.0 else x


Sampler = Callable[[int], int]

LONGEST_NS = 1 << 55
"""More than 400 days. What is drawn from a long tail ends here: it is as good as never, and
simulated time, like ROS's own, ends at 2**63 ns."""


class Distribution(Protocol):
    """How long something takes."""

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        """Return a function of the present time (ns) that draws the next value (ns)."""


@dataclass(frozen=True, slots=True)
class Constant:
    """Always the same."""

    value_ns: int

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        value_ns = self.value_ns
        return lambda now_ns: value_ns


class Draws(chain[int]):
    """Draws from an iterator, whatever the time. Compiled code takes what comes next itself, since
    this is the usual jitter."""

    def __call__(self, now_ns: int) -> int:
        return next(self)


@dataclass(frozen=True, slots=True)
class Uniform:
    """Evenly between two bounds, both included."""

    min_ns: int
    max_ns: int

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        numbers = stream.whole_numbers(self.min_ns, self.max_ns - self.min_ns + 1)
        return cast("Draws", Draws.from_iterable(numbers))


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal with mean and standard deviation before truncation; negative draws are drawn again."""

    mean_ns: int
    sd_ns: int

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        uniform, mean, sd = stream.uniform, float(self.mean_ns), float(self.sd_ns)

        def draw(now_ns: int) -> int:
            while True:
                value = mean + sd * normal_quantile(uniform())
                if value >= 0.0:
                    return int(min(value, LONGEST_NS) + 0.5)

        return draw


@dataclass(frozen=True, slots=True)
class Lognormal:
    """The logarithm of value / ``median_ns`` is normal with standard deviation ``sigma``."""

    median_ns: float
    sigma: float

    @classmethod
    def of_moments(cls, mean_ns: float, sd_ns: float) -> Lognormal:
        square = (sd_ns / mean_ns) * (sd_ns / mean_ns)
        spread = 1.0 + square
        if square < 1e-12:  # of which the sum keeps too little: log(1 + x) is x there
            return cls(mean_ns, sqrt(square))
        return cls(mean_ns / sqrt(spread), sqrt(log(spread)))

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        uniform, median, sigma = stream.uniform, self.median_ns, self.sigma
        return lambda now_ns: int(
            min(median * exp(sigma * normal_quantile(uniform())), LONGEST_NS) + 0.5
        )


@dataclass(frozen=True, slots=True)
class Gamma:
    """Gamma with ``shape`` and ``scale_ns``: mean shape * scale, variance shape * scale**2.

    Drawn by the method of Marsaglia and Tsang (ACM TOMS 26, 2000), which takes about one normal
    and one uniform number.
    """

    shape: float
    scale_ns: float

    @classmethod
    def of_moments(cls, mean_ns: float, sd_ns: float) -> Gamma:
        ratio = mean_ns / sd_ns
        return cls(ratio * ratio, sd_ns / ratio)

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        uniform, scale, small = stream.uniform, self.scale_ns, self.shape < 1.0
        power = 1.0 / self.shape
        d = (self.shape + 1.0 if small else self.shape) - 1.0 / 3.0
        c = 1.0 / sqrt(9.0 * d)

        def draw(now_ns: int) -> int:
            while True:
                x = normal_quantile(uniform())
                v = 1.0 + c * x
                if v <= 0.0:
                    continue
                v = v * v * v
                if log(uniform()) < 0.5 * x * x + d - d * v + d * log(v):
                    break
            value = d * v * scale
            if small:  # a gamma of shape + 1, times a uniform to the power of 1 / shape
                value *= exp(max(log(uniform()) * power, -700.0))
            return int(min(value, LONGEST_NS) + 0.5)

        return draw


@dataclass(frozen=True, slots=True)
class MeasuredSamples:
    """One of some measured values, each as likely as the others."""

    values_ns: tuple[int, ...]

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        below, values, count = stream.below, self.values_ns, len(self.values_ns)
        return lambda now_ns: values[below(count)]


@dataclass(frozen=True, slots=True)
class Empirical:
    """A table of quantiles: ``percent`` of all values, from 0 to 100, are at most ``values_ns``.

    Between two lines of the table values are as likely as each other.
    """

    percent: tuple[float, ...]
    values_ns: tuple[int, ...]

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        uniform, percent, values = stream.uniform, self.percent, self.values_ns

        def draw(now_ns: int) -> int:
            at = uniform() * 100.0
            place = bisect_right(percent, at, 1, len(percent) - 1)
            low, low_ns = percent[place - 1], values[place - 1]
            part = (at - low) / (percent[place] - low)
            return low_ns + int(part * (values[place] - low_ns) + 0.5)

        return draw


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """A value that changes over time: points (ns since the start of the run, value in ns).

    Before the first point and after the last one, theirs holds. Between points the value is
    interpolated, or with ``steps`` that of the point before.
    """

    points: tuple[tuple[int, int], ...]
    steps: bool = False

    def sampler(self, stream: RandomStream, start_ns: int) -> Sampler:
        times = [time_ns for time_ns, _ in self.points]
        points, steps, last = self.points, self.steps, len(self.points) - 1

        def value(now_ns: int) -> int:
            since_ns = now_ns - start_ns
            place = bisect_right(times, since_ns) - 1
            if place < 0:
                return points[0][1]
            time_ns, value_ns = points[place]
            if place == last or steps:
                return value_ns
            next_ns, next_value_ns = points[place + 1]
            run_ns = next_ns - time_ns
            return value_ns + (next_value_ns - value_ns) * (since_ns - time_ns) // run_ns

        return value
