"""A distribution for measured durations: a table of quantiles, or one of a few known families."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.instances import Durations
from rsltrace.errors import SetupError
from rsltrace.simulation.chance.distribution import (
    LONGEST_NS,
    Constant,
    Distribution,
    Empirical,
    Gamma,
    Lognormal,
    Normal,
    TimeSeries,
    Uniform,
)
from rsltrace.simulation.chance.stream import RandomStream

FEW = 30
"""Fewer durations than this say little of the tail."""
_DIGITS = 4
"""Significant digits of what is written."""
_LINES_MAX = 64
_NEAR = 0.01
_NEAR_NS = 200
"""A table of quantiles is fine enough when no measured value is further from it than this share of
itself, or this time."""
_DRAWS = 10_000
_DISTANCE_MAX = 0.05
_DISTANCE_95 = 1.358
"""A family is taken if its distance is below the first, or below what chance makes of the distance
in 95 % of all samples: the second by the root of their size (Kolmogorov)."""


@dataclass(frozen=True, slots=True)
class DurationModel:
    """A distribution, and how a job says it.

    ``values`` is the value of ``kind`` in a job, times in ns. ``distance`` is the largest
    difference between the shares of measured and of drawn values up to any time (Kolmogorov and
    Smirnov's D), times within 1 % of each other being the same. ``passed_over`` says which family
    was nearest where none was near enough. ``points`` are those of a series: when, and how long.
    """

    kind: str
    values: Any
    distribution: Distribution
    distance: float = 0.0
    passed_over: str = ""
    points: tuple[tuple[int, int], ...] = ()

    def draws(self, count: int = _DRAWS) -> Durations:
        """Return what a simulation would draw, in ns, shape (count,); of a series what is in it."""
        if self.points:
            return np.array([value for _, value in self.points], dtype=np.int64)
        draw = self.distribution.sampler(RandomStream(0, "fit"), 0)
        return np.array([draw(0) for _ in range(count)], dtype=np.int64)


def model_of(durations: Durations, *, family: bool = False) -> DurationModel:
    """Return a distribution for measured durations, of which there is at least one.

    It is a constant where they are all the same, else a table of quantiles, or with ``family`` the
    uniform, normal, lognormal or gamma distribution of the least BIC if that is near enough.

    :raises SetupError: with ``family``, if SciPy is missing.
    """
    ordered = np.minimum(np.sort(durations), LONGEST_NS)
    if ordered[0] == ordered[-1]:
        value_ns = int(ordered[0])
        return DurationModel("constant", value_ns, Constant(value_ns))
    passed_over = ""
    if family:
        found = _nearest_family(ordered)
        distance = ks_distance(ordered, found.draws(), same=_NEAR)
        if distance <= max(_DISTANCE_MAX, _DISTANCE_95 / math.sqrt(len(ordered))):
            return DurationModel(found.kind, found.values, found.distribution, distance)
        passed_over = f"{found.kind}, D {distance:.2f}"
    percent, values_ns = table_of(ordered)
    table = Empirical(percent, values_ns)
    values = {"values": values_ns, "percent": percent}
    made = DurationModel("empirical", values, table)
    distance = ks_distance(ordered, made.draws(), same=_NEAR)
    return DurationModel("empirical", values, table, distance, passed_over)


def series_of(since: Durations, durations: Durations) -> DurationModel:
    """Return durations as they were in the course of the run; ``since`` says when each began.

    A constant where they are all the same, or where there is only one.
    """
    if durations.min() == durations.max():
        return model_of(durations)
    times, places = np.unique(np.maximum(since, 0), return_index=True)
    values = np.minimum(durations[places], LONGEST_NS)
    points = tuple(zip(times.tolist(), values.tolist(), strict=True))
    return DurationModel(
        "series", {"file": "", "steps": True}, TimeSeries(points, steps=True), points=points
    )


def table_of(ordered: Durations) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Return percentages and quantiles of sorted durations, as few as say it.

    Lines are added where the table is furthest from what was measured until it is near everywhere.
    """
    at = np.linspace(0.0, 100.0, len(ordered))
    chosen = [0, len(ordered) - 1]
    allowed = np.maximum(ordered * _NEAR, _NEAR_NS)
    while len(chosen) < min(_LINES_MAX, len(ordered)):
        off = np.abs(np.interp(at, at[chosen], ordered[chosen]) - ordered) / allowed
        worst = int(np.argmax(off))
        if off[worst] <= 1.0:
            break
        chosen = sorted({*chosen, worst})
    lines: dict[float, int] = {}
    for place in chosen:
        lines.setdefault(round(float(at[place]), 4), shortened(int(ordered[place])))
    return tuple(lines), tuple(lines.values())


def shortened(duration_ns: float) -> int:
    """Return a duration to a few significant digits."""
    return int(float(f"{duration_ns:.{_DIGITS}g}"))


def ks_distance(a: Durations, b: Durations, *, same: float = 0.0) -> float:
    """Return Kolmogorov and Smirnov's D of two samples, neither empty: the largest difference
    between their shares of values up to any time. Times are taken for equal that differ by no more
    than this share of them."""
    both, (a, b) = np.concatenate((a, b)), (np.sort(a), np.sort(b))
    away = 0.0
    for one, other in ((a, b), (b, a)):
        least = np.searchsorted(one, both * (1 - same), side="right") / len(one)
        away = max(
            away, float((least - np.searchsorted(other, both, side="right") / len(other)).max())
        )
    return away


def _nearest_family(ordered: Durations) -> DurationModel:
    """Return the family of the least BIC, fitted by maximum likelihood."""
    if importlib.util.find_spec("scipy") is None:
        raise SetupError("--as distributions needs SciPy: pip install 'rsltrace[fit]'")
    from scipy import stats

    values = np.maximum(ordered.astype(np.float64), 1.0)  # a logarithm of each
    mean, sd, logs = values.mean(), values.std(), np.log(values)
    shape, _, scale = stats.gamma.fit(values, floc=0)
    candidates = (
        (_uniform(values), stats.uniform(values[0], values[-1] - values[0])),
        (_normal(mean, sd), stats.norm(mean, sd)),
        (_lognormal(logs), stats.lognorm(logs.std(), scale=math.exp(logs.mean()))),
        (_gamma(shape, scale), stats.gamma(shape, scale=scale)),
    )
    # Each has two parameters: the least BIC is the greatest likelihood.
    scores = [float(known.logpdf(values).sum()) for _, known in candidates]
    return candidates[int(np.argmax(scores))][0]


def _uniform(values: npt.NDArray[np.float64]) -> DurationModel:
    low, high = int(values[0]), int(values[-1])
    return DurationModel("uniform", {"min": low, "max": high}, Uniform(low, high))


def _normal(mean: float, sd: float) -> DurationModel:
    at, by = shortened(mean), max(shortened(sd), 1)
    return DurationModel("normal", {"mean": at, "sd": by}, Normal(at, by))


def _lognormal(logs: npt.NDArray[np.float64]) -> DurationModel:
    median = max(shortened(math.exp(logs.mean())), 1)
    sigma = min(float(f"{logs.std():.{_DIGITS}g}"), 10.0)
    return DurationModel("lognormal", {"median": median, "sigma": sigma}, Lognormal(median, sigma))


def _gamma(shape: float, scale: float) -> DurationModel:
    of, by = float(f"{min(shape, 1e9):.{_DIGITS}g}"), max(shortened(scale), 1)
    return DurationModel("gamma", {"shape": of, "scale": by}, Gamma(of, by))


NOT_TIMES = frozenset(("percent", "sigma", "shape", "file", "steps"))


def as_job_has_it(model: DurationModel, time: Any) -> dict[str, Any]:
    """Return ``{kind: …}`` as a job file says it; ``time`` makes text of ns."""
    if not isinstance(model.values, Mapping):
        return {model.kind: time(model.values)}
    values: dict[str, Any] = {}
    for key, value in model.values.items():
        if key in NOT_TIMES:
            values[key] = [*map(_plain, value)] if isinstance(value, tuple) else _plain(value)
        else:
            values[key] = [*map(time, value)] if isinstance(value, tuple) else time(value)
    return {model.kind: values}


def _plain(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value == int(value) else value
