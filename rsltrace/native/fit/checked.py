"""Whether a simulation has the latencies of the robot: chain by chain, against a second run."""

from __future__ import annotations

from dataclasses import dataclass

from rsltrace.checks.latency.measure import ChainLatency, Latencies, measure_latencies
from rsltrace.checks.latency.paths import Hop
from rsltrace.errors import TraceError
from rsltrace.native.fit.comparison import Compared, compared
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace

Chains = dict[tuple[Hop, ...], ChainLatency]

NEAR = 0.1
"""Quantiles this near, as a share, are said to match."""


@dataclass(frozen=True, slots=True)
class CheckedChain:
    """A chain by its topics: the simulated run and the first native one against the second, and the
    simulated one against the first, to which it is fitted; None where one has no such chain."""

    name: str
    simulated: Compared | None
    native: Compared | None
    own: Compared | None


@dataclass(frozen=True, slots=True)
class Checked:
    """All chains of the second run, those with the most outputs first."""

    chains: tuple[CheckedChain, ...]


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


def check(first: Trace, second: Chains, simulated: Trace) -> Checked:
    """Compare the latencies of a simulated run with those of a second native one.

    :raises TraceError: a trace is damaged.
    :raises SetupError: if SciPy is missing.
    """
    of_first, of_simulated = (_by_hops(measure_latencies(one)) for one in (first, simulated))
    return Checked(
        tuple(
            CheckedChain(
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


def far(of: Compared) -> list[float]:
    """Return the quantiles, in percent, that do not match."""
    return [one.percent for one in of.quantiles if not abs(one.ratio - 1.0) <= NEAR]


def _against(chain: ChainLatency | None, other: ChainLatency | None) -> Compared | None:
    """Compare ``other`` with a chain: ratios are those of the other to the chain."""
    if chain is None or other is None:
        return None
    a, b = chain.durations("latency"), other.durations("latency")
    return compared(a, b) if len(a) and len(b) else None
