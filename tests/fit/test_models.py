"""Distributions made of durations: near what was measured, whatever that was."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rsltrace.native.fit.comparison import compare_samples
from rsltrace.native.fit.measurement import clock_steps
from rsltrace.native.fit.models import ks_distance, model_of, table_of
from rsltrace.simulation.chance.distribution import Empirical, Gamma, Lognormal, Normal, Uniform
from rsltrace.simulation.chance.stream import RandomStream
from tests.tiers import cases

MS = 1_000_000


@settings(max_examples=cases(10, 40), deadline=None)
@given(st.lists(st.integers(0, 10**10), min_size=2, max_size=300))
@example([0, 0, 10**10, 10**10])  # 33.3333 % is not quite a third
def test_a_table_is_near_every_value_that_was_measured(durations: list[int]) -> None:
    ordered = np.sort(np.array(durations, dtype=np.int64))
    percent, values = table_of(ordered)
    assert (percent[0], percent[-1]) == (0, 100)
    assert list(percent) == sorted(set(percent))
    assert list(values) == sorted(values)
    assert len(percent) <= 64
    if len(percent) < 64:
        at = np.linspace(0, 100, len(ordered)).round(4)  # as a table says it
        off = np.abs(np.interp(at, percent, values) - ordered)
        assert (off <= np.maximum(ordered * 0.02, 400) + 1).all()
    draw = Empirical(percent, values).sampler(RandomStream(0, "any"), 0)
    drawn = [draw(0) for _ in range(50)]
    assert values[0] <= min(drawn)
    assert max(drawn) <= values[-1]


@pytest.mark.parametrize(
    "known",
    [Uniform(MS, 9 * MS), Normal(9 * MS, MS), Lognormal(2 * MS, 0.7), Gamma(0.8, 3 * MS)],
    ids=lambda known: type(known).__name__,
)
def test_a_family_is_found_again(known: Uniform | Normal | Lognormal | Gamma) -> None:
    pytest.importorskip("scipy")
    draw = known.sampler(RandomStream(4, "any"), 0)
    durations = np.array([draw(0) for _ in range(3000)])
    found = model_of(durations, family=True)
    assert isinstance(found.distribution, type(known))
    for name in known.__slots__:
        assert getattr(found.distribution, name) == pytest.approx(getattr(known, name), rel=0.1)


def test_what_is_of_no_family_becomes_a_table_that_says_so() -> None:
    pytest.importorskip("scipy")
    two_heaps = np.concatenate((np.full(500, MS) + np.arange(500), np.full(500, 9 * MS)))
    found = model_of(two_heaps, family=True)
    assert found.kind == "empirical"
    assert found.passed_over
    assert found.distance < 0.05


def test_all_the_same_is_a_constant() -> None:
    assert (model_of(np.array([7, 7, 7])).kind, model_of(np.array([7])).values) == ("constant", 7)
    assert model_of(np.array([0, 0]), family=True).kind == "constant"


def test_two_samples_of_one_distribution_and_of_two() -> None:
    pytest.importorskip("scipy")
    chance = np.random.default_rng(1)
    a, b = chance.gamma(4, MS, 2000).astype(int), chance.gamma(4, MS, 2000).astype(int)
    same, scaled = compare_samples(a, b), compare_samples(a, b * 3 // 2)
    assert same.p_value > 0.001
    assert same.distance < 1.95 * np.sqrt(2 / 2000)
    for one in same.quantiles:
        assert one.low < 1 < one.high
    for one in scaled.quantiles:
        assert one.low < 1.5 < one.high
        assert one.low > 1.1
    assert scaled.p_value < 1e-6
    assert scaled.moved_ns == pytest.approx(b.mean() / 2, rel=0.1)
    assert ks_distance(a, b) == pytest.approx(same.distance)


@pytest.mark.long
def test_the_interval_of_a_quantile_holds_what_it_says() -> None:
    """Of 60 pairs of samples that hang together (each is near the one before), about 95 % of the
    intervals of the median's ratio hold 1; independent resampling would make it two thirds."""
    pytest.importorskip("scipy")
    chance = np.random.default_rng(3)
    held = 0
    for _ in range(60):
        samples = []
        for _ in range(2):
            noise, walk = chance.normal(0, 1, 600), np.zeros(600)
            for place in range(1, 600):
                walk[place] = 0.6 * walk[place - 1] + noise[place]
            samples.append((10 + walk) * MS)
        median = compare_samples(*(one.astype(int) for one in samples)).quantiles[0]
        held += median.low <= 1 <= median.high
    assert held >= 50


def test_a_clock_that_was_set_is_found_and_a_late_reading_is_not() -> None:
    offsets = np.full(200, 5)
    offsets[50] += 10**9  # something came in between the two readings
    assert clock_steps(offsets) == []
    offsets[120:] -= 10**9
    ((before, after),) = clock_steps(offsets)
    assert before < 120 <= after
    assert clock_steps(offsets[:3]) == []
