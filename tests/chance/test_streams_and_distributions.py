"""Random numbers: the same bits everywhere, and what theory says of their distributions.

Seeds are fixed, so a test either always passes or always fails. Bounds are four standard errors of
the statistic in question over 1e5 draws (a chance of 6e-5 each, had the seeds not been fixed).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from statistics import NormalDist, fmean, pvariance

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.simulation.chance.distribution import (
    Constant,
    Distribution,
    Empirical,
    Gamma,
    Lognormal,
    MeasuredSamples,
    Normal,
    TimeSeries,
    Uniform,
    normal_quantile,
)
from rsltrace.simulation.chance.stream import RandomStream, exp, log

N = 100_000
MS = 1_000_000
NORMAL = NormalDist()

GOLDEN_UNIFORM = ["0x1.2e42ff8743b92p-2", "0x1.a20f6ec94b913p-1", "0x1.6f59dac4fb6cdp-1"]
GOLDEN_NORMAL = [4355096, 6223707, 3486915, 4343104]
GOLDEN_LOGNORMAL = [3621095, 7438468, 2591682, 3604405]
GOLDEN_GAMMA = [3586031, 2357284, 4369610, 5367362]
GOLDEN_SMALL_GAMMA = [2543, 450352, 1442693, 463350]


def draws(distribution: Distribution, name: str = "test", count: int = N) -> list[int]:
    draw = distribution.sampler(RandomStream(7, name), 0)
    return [draw(0) for _ in range(count)]


def check_moments(values: list[int], mean: float, variance: float, kurtosis: float) -> None:
    """Compare mean and variance with theory; ``kurtosis`` is the fourth standardized moment."""
    assert abs(fmean(values) - mean) < 4 * math.sqrt(variance / N)
    assert abs(pvariance(values) / variance - 1) < 4 * math.sqrt((kurtosis - 1) / N)


def check_quantiles(values: list[int], cdf: object) -> None:
    """Compare the share of draws below some values with the distribution function."""
    ordered = sorted(values)
    for p in (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99):
        x = ordered[int(p * N)]
        expected = cdf(x)  # type: ignore[operator]
        assert abs(bisect_right(ordered, x) / N - expected) < 4 * math.sqrt(p * (1 - p) / N) + 2 / N


def test_a_stream_is_the_same_everywhere() -> None:
    """Written down once; another number here means that every trace with delays changes."""
    stream = RandomStream(0, "topic\0/scan")
    assert [stream.uniform().hex() for _ in range(3)] == GOLDEN_UNIFORM
    assert draws(Normal(5 * MS, MS), count=4) == GOLDEN_NORMAL
    assert draws(Lognormal.of_moments(5 * MS, 2 * MS), count=4) == GOLDEN_LOGNORMAL
    assert draws(Gamma.of_moments(5 * MS, 2 * MS), count=4) == GOLDEN_GAMMA
    assert draws(Gamma(0.5, MS), count=4) == GOLDEN_SMALL_GAMMA


def test_uniform_numbers_are_uniform_and_independent() -> None:
    stream = RandomStream(3, "u")
    values = [stream.uniform() for _ in range(N)]
    assert 0 < min(values) < max(values) < 1
    assert abs(fmean(values) - 0.5) < 4 * math.sqrt(1 / 12 / N)
    for bins in (10, 97):
        counts = [0] * bins
        for value in values:
            counts[int(value * bins)] += 1
        chi_square = sum((count - N / bins) ** 2 / (N / bins) for count in counts)
        assert abs(chi_square - (bins - 1)) < 4 * math.sqrt(2 * (bins - 1))
    for lag in (1, 2, 64):  # a block is 64 numbers
        pairs = zip(values, values[lag:], strict=False)
        correlation = fmean((x - 0.5) * (y - 0.5) for x, y in pairs) * 12
        assert abs(correlation) < 4 / math.sqrt(N)


def test_streams_of_other_names_or_seeds_have_nothing_in_common() -> None:
    first = [RandomStream(1, "a").uniform() for _ in range(5)]
    for other in (
        RandomStream(1, "b"),
        RandomStream(2, "a"),
        RandomStream(1, "a\0"),
        RandomStream(11, "a"),
    ):
        assert other.uniform() not in first


@given(st.floats(1e-300, 1e300))
def test_log_is_the_logarithm(x: float) -> None:
    assert log(x) == pytest.approx(math.log(x), rel=4e-16, abs=4e-16)


@given(st.floats(-600, 600))
def test_exp_is_the_exponential(x: float) -> None:
    assert exp(x) == pytest.approx(math.exp(x), rel=5e-16)


@given(st.floats(1e-300, 1, exclude_max=True))
def test_quantile_is_that_of_the_normal_distribution(p: float) -> None:
    assert normal_quantile(p) == pytest.approx(NORMAL.inv_cdf(p), rel=2e-15, abs=2e-16)


def test_uniform() -> None:
    low, high = MS, 9 * MS
    values = draws(Uniform(low, high))
    assert low <= min(values)
    assert max(values) <= high
    check_moments(values, (low + high) / 2, (high - low) ** 2 / 12, 1.8)
    check_quantiles(values, lambda x: (x - low) / (high - low))
    assert set(draws(Uniform(3, 4), count=100)) == {3, 4}


def test_normal() -> None:
    values = draws(Normal(50 * MS, 5 * MS))  # ten standard deviations from the truncation
    check_moments(values, 50 * MS, (5 * MS) ** 2, 3)
    check_quantiles(values, lambda x: NORMAL.cdf((x - 50 * MS) / (5 * MS)))


def test_normal_truncated_at_zero() -> None:
    mean, sd = 1 * MS, 2 * MS
    values = draws(Normal(mean, sd))
    assert min(values) >= 0
    below = NORMAL.cdf(-mean / sd)
    alpha = -mean / sd
    hazard = NORMAL.pdf(alpha) / (1 - below)
    expected = mean + sd * hazard
    variance = sd**2 * (1 + alpha * hazard - hazard**2)
    check_moments(values, expected, variance, 4)
    check_quantiles(values, lambda x: (NORMAL.cdf((x - mean) / sd) - below) / (1 - below))


def test_lognormal() -> None:
    mean, sd = 5 * MS, 2 * MS
    values = draws(Lognormal.of_moments(mean, sd))
    sigma2 = math.log(1 + (sd / mean) ** 2)
    kurtosis = (
        sum(k * math.exp(n * sigma2) for n, k in ((4, 1), (3, 2), (2, 3))) - 3
    )  # of the lognormal distribution
    check_moments(values, mean, sd**2, kurtosis)
    mu = math.log(mean) - sigma2 / 2
    check_quantiles(values, lambda x: NORMAL.cdf((math.log(x) - mu) / math.sqrt(sigma2)))
    by_median = draws(Lognormal(5 * MS, 0.5), count=N)
    assert abs(sorted(by_median)[N // 2] / (5 * MS) - 1) < 4 * 0.5 * math.sqrt(math.pi / 2 / N)


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", [0.5, 1.0, 2.0, 6.25])
def test_gamma(shape: float) -> None:
    values = draws(Gamma(shape, MS), f"gamma {shape}")
    check_moments(values, shape * MS, shape * MS**2, 3 + 6 / shape)
    if shape == 1.0:  # the exponential distribution
        check_quantiles(values, lambda x: 1 - math.exp(-x / MS))
    if shape == 0.5:  # half a chi-squared one with one degree of freedom
        check_quantiles(values, lambda x: math.erf(math.sqrt(x / MS)))
    if shape == 2.0:  # Erlang
        check_quantiles(values, lambda x: 1 - math.exp(-x / MS) * (1 + x / MS))


def test_gamma_of_moments() -> None:
    values = draws(Gamma.of_moments(5 * MS, 2 * MS))
    check_moments(values, 5 * MS, (2 * MS) ** 2, 3 + 6 / 6.25)


def test_samples_are_drawn_evenly() -> None:
    values = draws(MeasuredSamples((1, 1, 5, 9)))
    for value, share in ((1, 0.5), (5, 0.25), (9, 0.25)):
        assert abs(values.count(value) / N - share) < 4 * math.sqrt(share * (1 - share) / N)


def test_a_table_of_quantiles() -> None:
    values = draws(Empirical((0, 20, 90, 100), (MS, 2 * MS, 2 * MS, 9 * MS)))
    share = values.count(2 * MS) / N
    assert abs(share - 0.7) < 4 * math.sqrt(0.21 / N)
    below = [value for value in values if value < 2 * MS]
    above = [value for value in values if value > 2 * MS]
    assert abs(len(above) / N - 0.1) < 4 * math.sqrt(0.09 / N)
    for part, low, high in ((below, MS, 2 * MS), (above, 2 * MS, 9 * MS)):
        assert low <= min(part)
        assert max(part) <= high
        mean, sd = (low + high) / 2, (high - low) / math.sqrt(12)
        assert abs(fmean(part) - mean) < 4 * sd / math.sqrt(len(part))
    assert set(draws(Empirical((0, 100), (5, 5)), count=10)) == {5}


def test_constant() -> None:
    assert set(draws(Constant(5), count=10)) == {5}


def test_series_follow_the_time_since_the_start() -> None:
    points = ((1000, 10), (2000, 30), (4000, 0))
    value = TimeSeries(points).sampler(RandomStream(0, ""), 100_000)
    at = [100_000, 101_000, 101_500, 102_000, 103_000, 103_999, 104_000, 999_999]
    assert [value(t) for t in at] == [10, 10, 20, 30, 15, 0, 0, 0]
    steps = TimeSeries(points, steps=True).sampler(RandomStream(0, ""), 100_000)
    assert [steps(t) for t in at] == [10, 10, 10, 30, 30, 30, 0, 0]


def test_a_lognormal_may_be_as_narrow_as_a_nanosecond_of_an_hour() -> None:
    mean, sd = 3.6e12, 1000.0
    narrow = draws(Lognormal.of_moments(mean, sd), count=10_000)
    assert abs(fmean(narrow) - mean) < 4 * sd / 100
    assert abs(math.sqrt(pvariance(narrow)) / sd - 1) < 0.03
    wide, wider = Lognormal.of_moments(1e9, 1e3 * 0.999), Lognormal.of_moments(1e9, 1e3 * 1.001)
    assert wide.sigma < 1e-6 < wider.sigma  # both ways of computing it meet
