"""Latencies of chains as checks: what takes too long, and where."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rsltrace.checks.latency.instances import quantile
from rsltrace.checks.latency.measure import ChainLatency, Latencies, measuring
from rsltrace.checks.properties import KEPT_MAX, Violation
from rsltrace.job.parts.check import LatencySpec
from rsltrace.trace.model.texts import format_duration, format_seconds
from rsltrace.trace.reader import Trace

_WORDS = {
    "latency": "latency",
    "age": "data age",
    "last_age": "data age at most",
    "reaction": "reaction",
    "worst_reaction": "reaction at worst",
}


@dataclass(frozen=True, slots=True)
class LatencyResult:
    """What takes too long: how often, the first of it, and whether the run ended too early to
    say."""

    count: int = 0
    violations: tuple[Violation, ...] = ()
    undecided: bool = False
    note: str = ""


def latency_title(spec: LatencySpec) -> str:
    """Return what a check says."""
    topics = spec.chain or (spec.start or "", spec.end or "")
    most = f" ({spec.quantile:g} % of them)" if spec.quantile is not None else ""
    named = " → ".join(topics) + (f" via {', '.join(spec.via)}" if spec.via else "")
    return f"{_WORDS[spec.measure]} of {named} below {format_duration(spec.below_ns)}{most}"


MeasuredChains = dict[tuple[object, ...], Latencies]
"""Chains that are measured already, by what was asked for."""


def check_latency(
    trace: Trace, spec: LatencySpec, known: MeasuredChains | None = None
) -> Iterator[LatencyResult | None]:
    """Hold a check against a trace: yield None now and then, and in the end what came of it.

    ``known`` are the chains that checks before were about; these are added.

    :raises TraceError: the trace is damaged.
    """
    known = {} if known is None else known
    asked = tuple(spec.wanted.values())
    found = known.get(asked)
    if found is None:
        for found in measuring(trace, **spec.wanted):
            if found is None:
                yield None
        assert found is not None
        known[asked] = found
    missing = found.missing.replace("--via ", "via: ")
    if missing and not trace.complete:
        yield LatencyResult(undecided=True, note=missing)
    elif missing:
        yield LatencyResult(1, (Violation(None, trace.end_ns, missing),))
    else:
        yield _judged(trace, spec, found)


def _judged(trace: Trace, spec: LatencySpec, found: Latencies) -> LatencyResult:
    late: list[Violation] = []
    count = measured = 0
    for chain in found.chains:
        durations, late_of_chain = _late(trace, spec, chain)
        measured += len(durations)
        if not len(durations):
            continue
        of_all = ""
        if spec.quantile is not None:
            most_ns = quantile(np.sort(durations), spec.quantile)
            if most_ns < spec.below_ns:
                continue
            of_all = f"; p{spec.quantile:g} is {format_duration(most_ns)}"
        count += int((durations >= spec.below_ns).sum())
        late += [Violation(one.event, one.stamp_ns, one.text + of_all) for one in late_of_chain]
    late.sort(key=lambda one: one.event or 0)
    if not measured:
        return LatencyResult(undecided=True, note="there is nothing to measure")
    return LatencyResult(count, tuple(late[:KEPT_MAX]))


def _late(
    trace: Trace, spec: LatencySpec, chain: ChainLatency
) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], list[Violation]]:
    """Return all durations of a chain, with those of inputs that nothing has answered in time, and
    the first that are too long."""
    last = trace.ended_after
    moments = chain.moments(spec.measure)
    durations = moments["duration"]
    if last is not None:  # what nodes do when they are told to end
        moments = moments[moments["output_event"] < last]
        durations = moments["duration"]
    late = [
        Violation(
            int(one["output_event"]),
            int(one["output_ns"]),
            f"{format_duration(int(one['duration']))} since {chain.hops[0].topic} of event "
            f"{int(one['input_event'])} ({format_seconds(trace.stamp(int(one['input_ns'])))} s)",
        )
        for one in moments[durations >= spec.below_ns][:KEPT_MAX]
    ]
    if spec.measure not in ("reaction", "worst_reaction"):
        return durations, late
    waiting = chain.unanswered()
    if last is not None:
        waiting = waiting[waiting["input_event"] < last]
    waited = trace.end_ns - waiting["input_ns"]
    too_long = waiting[waited >= spec.below_ns]
    late += [
        Violation(
            int(one["input_event"]),
            int(one["input_ns"]),
            f"nothing on {chain.hops[-1].topic} came of it, or of a later one, up to the end",
        )
        for one in too_long[:KEPT_MAX]
    ]
    return np.concatenate([durations, waited[waited >= spec.below_ns]]), late
