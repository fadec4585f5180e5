"""The chains of a run, and how long data takes through each: for the overview, and for plots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rsltrace.errors import RsltraceError, TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace_viewer.model.run import Run

if TYPE_CHECKING:
    from rsltrace.checks.latency.instances import LatencyFigures
    from rsltrace.checks.latency.measure import Latencies
    from rsltrace.checks.latency.paths import Hop
    from rsltrace.job import Job

EVENTS_MAX = 500_000
"""Chains are looked for by themselves in runs of up to so many events: some microseconds each."""
ARROW, VIA = " → ", " via "


@dataclass(frozen=True, slots=True)
class Chain:
    """A chain of a run in a few numbers; ``slowest`` is the event of the output that took longest,
    ``via`` names nodes that sample (see ``rsltrace.checks.latency``)."""

    hops: tuple[Hop, ...]
    via: tuple[str, ...]
    outputs: int
    latency: LatencyFigures | None
    oldest_ns: int | None
    slowest: int | None

    @property
    def name(self) -> str:
        """Its topics, and the nodes that sample: ``/odom → /pose via /localizer``."""
        topics = ARROW.join(hop.topic for hop in self.hops)
        return topics + (VIA + ", ".join(self.via) if self.via else "")


def read_chains(run: Run) -> Iterator[tuple[Chain, ...]]:
    """Yield the chains of a run as they are found: those of causes, and those that the checks of
    its job are about. Nothing for a run that is not finished, or is very long."""
    if not run.trace.complete or run.trace.event_count > EVENTS_MAX:
        return
    from rsltrace.checks.latency.measure import measuring  # which the first screen can do without

    found: dict[tuple[tuple[Hop, ...], tuple[str, ...]], Chain] = {}
    for wanted in ({}, *_of_checks(run)):
        try:
            for latencies in measuring(run.trace, **wanted):
                for one in _summed_up(latencies, tuple(wanted.get("via", ()))):
                    found.setdefault((one.hops, one.via), one)
                yield tuple(found.values())
        except TraceError:  # damaged: the events say so themselves
            return


def _of_checks(run: Run) -> Iterator[dict[str, Any]]:
    if "latency" not in run.trace.job_text:
        return
    from rsltrace.checks.evaluate import job_of_checks

    try:
        job: Job = job_of_checks(run.trace)
    except RsltraceError:  # the overview says it, as of other checks
        return
    yield from (one.latency.wanted for one in job.checks if one.latency is not None)


def _summed_up(found: Latencies | None, via: tuple[str, ...]) -> Iterator[Chain]:
    for one in found.chains if found is not None else ():
        slowest = one.worst("latency")
        oldest = one.figures("last_age")
        yield Chain(
            one.hops,
            via,
            one.outputs,
            one.figures("latency"),
            None if oldest is None else oldest.max_ns,
            None if slowest is None else slowest.output_event,
        )
