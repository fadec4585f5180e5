"""What is known of each chain of a job: its bound, and the worst that was seen of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rsltrace.errors import JobError
from rsltrace.job import Job
from rsltrace.job.parts.scheduling import EntityExecutionSpec, ExecutionSpec
from rsltrace.native.timing.bounds import bounds, utilization
from rsltrace.native.timing.chains import ChainKey, ObservedChains
from rsltrace.native.timing.model import ProcessorModel, longest_times, system_of
from rsltrace.native.timing.system import ONCE_NS, CallbackKey


@dataclass(frozen=True, slots=True)
class WorstResponse:
    """The worst response time of a chain in a trace, and the event that it ended with."""

    worst_ns: int
    event: int
    runs: int


@dataclass(frozen=True, slots=True)
class ChainResult:
    """What is known of a chain. Times in ns; ``bound_ns`` None: there is none; ``period_ns``
    None: it came once. ``native`` has one for each native trace, None where it is not in it."""

    chain: ChainKey
    period_ns: int | None
    deadline_ns: int | None
    bound_ns: int | None
    method: str
    simulated: WorstResponse | None
    native: tuple[WorstResponse | None, ...] = ()

    @property
    def name(self) -> str:
        """Its callbacks: ``/lidar Lidar.scan → /scan → /objects (/planner)``."""
        first, *rest = self.chain
        words = [f"{first.node} {first.name}", *(one.name for one in rest)]
        return " → ".join(words) + (f" ({rest[-1].node})" if rest else "")

    @property
    def seen_ns(self) -> int | None:
        """The worst that was seen of it."""
        worst = (one.worst_ns for one in (self.simulated, *self.native) if one is not None)
        return max(worst, default=None)

    @property
    def verdict(self) -> str:
        """``meets`` its deadline in every run, ``may miss`` it, or ``misses`` it in one."""
        if self.deadline_ns is None:
            return "no deadline"
        if self.seen_ns is not None and self.seen_ns > self.deadline_ns:
            return "misses"
        if self.bound_ns is None or self.bound_ns > self.deadline_ns:
            return "may miss"
        return "meets"


@dataclass(frozen=True, slots=True)
class TimingAnalysis:
    """The chains of a job, the fastest first; ``load`` is which part of its time each executor is
    busy at most."""

    chains: tuple[ChainResult, ...]
    load: Mapping[str, float]
    times: Mapping[CallbackKey, int]
    notes: tuple[str, ...]

    @property
    def all_meet(self) -> bool:
        """Whether every chain meets its deadline."""
        return all(one.verdict in ("meets", "no deadline") for one in self.chains)


def measured_times(observed: Sequence[ObservedChains], times: str) -> dict[CallbackKey, int]:
    """Return how long callbacks took in runs: the longest, or the 99 % quantile (ns)."""
    found: dict[CallbackKey, list[int]] = {}
    for one in observed:
        for callback, took in one.durations.items():
            quantile = int(np.quantile(took, 0.99, method="inverted_cdf"))
            found.setdefault(callback, []).append(int(took.max()) if times == "max" else quantile)
    return {callback: max(values) for callback, values in found.items()}


def with_times(job: Job, times: Mapping[CallbackKey, int]) -> Job:
    """Return a job whose callbacks take as long as ``times`` says."""
    longest: dict[tuple[str, str], int] = {}
    for callback, time_ns in times.items():
        name = (callback.node, callback.name)
        longest[name] = max(longest.get(name, 0), time_ns)
    entities = tuple(
        EntityExecutionSpec(node=node, entity=entity, constant=f"{time_ns}ns")
        for (node, entity), time_ns in longest.items()
    )
    return job.with_values(execution=ExecutionSpec(entities=entities))


def analyze(
    job: Job,
    simulated: ObservedChains,
    native: Sequence[ObservedChains],
    *,
    times: Mapping[CallbackKey, int] | None,
    deadlines: Mapping[str, int],
    wanted: ProcessorModel,
) -> TimingAnalysis:
    """Return what is known of the chains of a job, as the simulated run has shown them.

    ``times`` are how long callbacks take at most, None: as the job says. ``deadlines`` are by the
    topics, services or nodes that chains end in, "" for all others, which have their period as
    deadline without it.

    :raises JobError: a deadline is of a chain that there is not.
    """
    notes: list[str] = []
    if times is None:
        times, notes = longest_times(job, simulated)
    system, more = system_of(job, simulated, times, wanted)
    found = bounds(system)
    results = []
    for index, path in enumerate(simulated.paths):
        if path.children:
            continue
        arrivals = system.arrivals(system.tasks[index])
        period_ns = None if arrivals.period_ns == ONCE_NS else arrivals.period_ns
        results.append(
            ChainResult(
                path.key,
                period_ns,
                _deadline(path.key, deadlines, period_ns),
                found[index].ns,
                found[index].method,
                WorstResponse(path.worst_ns, path.worst_event, path.runs),
                tuple(_seen(one, path.key) for one in native),
            )
        )
    known = {path.key for path in simulated.paths}
    for one in native:
        for path in one.paths:
            if path.children or path.key in known:
                continue
            known.add(path.key)
            period_ns = one.period_ns(path.key[0])
            seen = tuple(_seen(other, path.key) for other in native)
            deadline_ns = _deadline(path.key, deadlines, period_ns)
            results.append(ChainResult(path.key, period_ns, deadline_ns, None, "", None, seen))
            more.append(
                f"there is no bound for {results[-1].name}: the simulated run has not shown it"
            )
    ends = {end for one in results for end in (one.chain[-1].name, one.chain[-1].node)}
    for name in deadlines:
        if name and name not in ends:
            raise JobError(f"no chain ends in {name}; they end in {', '.join(sorted(ends))}")
    results.sort(key=lambda one: (one.period_ns or ONCE_NS, one.name))
    used = sorted({task.executor for task in system.tasks if task.executor is not None})
    load = {name: utilization(system, name) for name in used}
    return TimingAnalysis(tuple(results), load, times, (*notes, *more))


def _seen(observed: ObservedChains, key: ChainKey) -> WorstResponse | None:
    path = observed.path(key)
    return None if path is None else WorstResponse(path.worst_ns, path.worst_event, path.runs)


def _deadline(chain: ChainKey, deadlines: Mapping[str, int], period_ns: int | None) -> int | None:
    last = chain[-1]
    given_ns = deadlines.get(last.name, deadlines.get(last.node, deadlines.get("")))
    return period_ns if given_ns is None else given_ns
