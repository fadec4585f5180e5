"""How far two samples of durations are from each other, and how sure that is."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.instances import Durations
from rsltrace.checks.latency.measure import ChainLatency, Latencies, measure_latencies
from rsltrace.checks.latency.paths import Hop
from rsltrace.errors import SetupError, TraceError
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace

PERCENT = (50.0, 95.0, 99.0)
_RESAMPLED = 1_000
_INTERVAL = (2.5, 97.5)
_AT_A_TIME = 2_000_000


@dataclass(frozen=True, slots=True)
class Quantile:
    """A quantile of two samples, in ns, their ratio b / a, and the interval in which that ratio is
    with 95 % (block bootstrap). Ratios are NaN where a's quantile is 0."""

    percent: float
    a_ns: float
    b_ns: float
    ratio: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class SampleComparison:
    """Two samples, neither of them empty.

    ``distance`` is Kolmogorov and Smirnov's D, the largest difference between the shares of both
    below any time, and ``p_value`` that of the test on it, which takes durations for independent.
    ``moved_ns`` is how far durations would have to move on average to make one sample the other
    (Wasserstein's distance).
    """

    count_a: int
    count_b: int
    quantiles: tuple[Quantile, ...]
    distance: float
    p_value: float
    moved_ns: float


def need_scipy() -> None:
    """Raise ``SetupError`` if SciPy is missing."""
    if importlib.util.find_spec("scipy") is None:
        raise SetupError("the two-sample test needs SciPy: pip install 'rsltrace[fit]'")


def compare_samples(a: Durations, b: Durations) -> SampleComparison:
    """Compare two samples, each in order of time.

    :raises SetupError: if SciPy is missing.
    """
    need_scipy()
    from scipy import stats

    chance = np.random.default_rng(0)
    resampled_a, resampled_b = (_resampled(one, chance) for one in (a, b))
    quantiles = []
    for place, percent in enumerate(PERCENT):
        of_a, of_b = (float(np.quantile(one, percent / 100)) for one in (a, b))
        below, above = resampled_a[:, place], resampled_b[:, place]
        ratios = above[below > 0] / below[below > 0]
        low, high = np.percentile(ratios, _INTERVAL).tolist() if len(ratios) else (np.nan, np.nan)
        ratio = of_b / of_a if of_a else float("nan")
        quantiles.append(Quantile(percent, of_a, of_b, ratio, low, high))
    test = stats.ks_2samp(a, b)
    return SampleComparison(
        len(a),
        len(b),
        tuple(quantiles),
        float(test.statistic),
        float(test.pvalue),
        float(stats.wasserstein_distance(a, b)),
    )


def _resampled(sample: Durations, chance: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return quantiles of samples that might have been: shape (resampled, quantiles).

    They are put together of stretches of the sample, since durations that follow each other are
    not independent (the queue of the one before, the load of the machine).
    """
    count = len(sample)
    length = max(round(count ** (1 / 3)), 1)
    blocks = -(-count // length)
    starts = chance.integers(0, count - length + 1, size=(_RESAMPLED, blocks))
    found = []
    for own in np.array_split(starts, -(-starts.shape[0] * count // _AT_A_TIME)):
        places = (own[:, :, None] + np.arange(length)).reshape(len(own), -1)[:, :count]
        found.append(np.percentile(sample[places], PERCENT, axis=1).T)
    return np.concatenate(found)


# Whether a simulation has the latencies of the robot: chain by chain, against a second run.

Chains = dict[tuple[Hop, ...], ChainLatency]

NEAR = 0.1
"""Quantiles this near, as a share, are said to match."""


@dataclass(frozen=True, slots=True)
class ChainCheck:
    """A chain by its topics: the simulated run and the first native one against the second, and the
    simulated one against the first, to which it is fitted; None where one has no such chain."""

    name: str
    simulated: SampleComparison | None
    native: SampleComparison | None
    own: SampleComparison | None


@dataclass(frozen=True, slots=True)
class LatencyCheck:
    """All chains of the second run, those with the most outputs first."""

    chains: tuple[ChainCheck, ...]


def chains_of(second: Trace) -> Chains:
    """Return the chains of the native run that a simulation is to be checked against.

    :raises TraceError: it is not native, or has no chain.
    """
    if not is_native(second):
        raise TraceError(f"{second.name} is not of a native run: there is nothing to check against")
    found = _by_hops(measure_latencies(second))
    if not found:
        raise TraceError(f"{second.name}: no message was caused by another one; there is no chain")
    return found


def check_latencies(first: Trace, second: Chains, simulated: Trace) -> LatencyCheck:
    """Compare the latencies of a simulated run with those of a second native one.

    :raises TraceError: a trace is damaged.
    :raises SetupError: if SciPy is missing.
    """
    of_first, of_simulated = (_by_hops(measure_latencies(one)) for one in (first, simulated))
    return LatencyCheck(
        tuple(
            ChainCheck(
                chain.name,
                _against(chain, of_simulated.get(hops)),
                _against(chain, of_first.get(hops)),
                _against(of_first.get(hops), of_simulated.get(hops)),
            )
            for hops, chain in second.items()
        )
    )


def _by_hops(found: Latencies) -> Chains:
    return {one.hops: one for one in found.chains if len(one.hops) > 1}


def mismatched_percentiles(of: SampleComparison) -> list[float]:
    """Return the quantiles, in percent, that do not match."""
    return [one.percent for one in of.quantiles if not abs(one.ratio - 1.0) <= NEAR]


def _against(chain: ChainLatency | None, other: ChainLatency | None) -> SampleComparison | None:
    """Compare ``other`` with a chain: ratios are those of the other to the chain."""
    if chain is None or other is None:
        return None
    a, b = chain.durations("latency"), other.durations("latency")
    return compare_samples(a, b) if len(a) and len(b) else None
