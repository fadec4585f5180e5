"""Bounds of response times: from the release of a chain to the end of each of its callbacks.

What callbacks of one executor pass on at once is analyzed as a whole, from its arrival at the
executor (its *head*) on; where a chain leaves an executor, what arrives at the next one is late by
up to the bound so far, as jitter (holistic analysis: Tindell, Clark 1994). All that is a fixed
point, found from below. Of the bounds that hold for an executor the least counts; docs/real-time.md
has each with its source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rsltrace.errors import JobError
from rsltrace.job import Job
from rsltrace.job.parts.scheduling import EntityExecutionSpec, ExecutionSpec
from rsltrace.native.timing.chains import ChainKey, ObservedChains
from rsltrace.native.timing.model import ProcessorModel, longest_times, system_of
from rsltrace.native.timing.system import (
    ONCE_NS,
    Arrivals,
    CallbackKey,
    ChainTask,
    ExecutorModel,
    ExecutorOrder,
    TaskSystem,
)

# What is known of each chain of a job: its bound, and the worst that was seen of it.


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


_ROUNDS_MAX = 1000
_PERIODS_MAX = 100
"""What takes longer than so many of the longest period is taken to have no bound."""


class _Unbounded(Exception):
    """No bound was found."""


@dataclass(frozen=True, slots=True)
class ResponseBound:
    """No run takes longer from the release of the chain to the end of the task; ``method`` says by
    which analysis of its last executor. ``ns`` is None if there is no bound."""

    ns: int | None
    method: str = ""


def bounds(system: TaskSystem) -> list[ResponseBound]:
    return _BoundSolver(system).solve()


@dataclass
class _BoundSolver:
    system: TaskSystem
    ends: list[int | None] = field(default_factory=list)
    methods: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        tasks = self.system.tasks
        periods = [one.arrivals.period_ns for one in tasks if one.arrivals is not None]
        periods = [one for one in periods if one < ONCE_NS]
        self._limit_ns = _PERIODS_MAX * max(periods, default=1)
        self._released = [self.system.arrivals(task) for task in tasks]
        self._counts = [self.system.count(task) for task in tasks]
        self._of: dict[str, list[int]] = {}
        for index, task in enumerate(tasks):
            if task.executor is not None:
                self._of.setdefault(task.executor, []).append(index)
        overloaded = {name for name in self._of if _is_overloaded(self.system, name)}
        for task in tasks:
            before = 0 if task.parent is None else self.ends[task.parent]
            unknown = before is None or task.link_ns is None or task.executor is None
            unknown = unknown or task.executor in overloaded
            self.ends.append(None if unknown else before + task.link_ns + task.wcet_ns)  # type: ignore[operator]
        self.methods = [""] * len(tasks)

    def solve(self) -> list[ResponseBound]:
        for _ in range(_ROUNDS_MAX):
            before = list(self.ends)
            for index in range(len(self.ends)):
                if self.ends[index] is not None:
                    self._bound(index)
            if self.ends == before:
                break
        else:
            self.ends = [None] * len(self.ends)
        return [
            ResponseBound(end, method if end is not None else "")
            for end, method in zip(self.ends, self.methods, strict=True)
        ]

    def _bound(self, index: int) -> None:
        """Find the least bound of a task that holds as long as the others' do."""
        task = self.system.tasks[index]
        executor = self.system.executor_of(task)
        assert executor is not None
        found: list[tuple[int, str]] = []
        for method, analysis in self._analyses(executor, task):
            try:
                found.append((analysis(index), method))
            except _Unbounded:
                continue
        best = min(found, default=None)
        if best is None or best[0] > self._limit_ns:
            self.ends[index] = None
            return
        known = self.ends[index]
        assert known is not None
        self.ends[index] = max(known, best[0])
        self.methods[index] = best[1]

    def _analyses(
        self, executor: ExecutorModel, task: ChainTask
    ) -> Iterable[tuple[str, Callable[[int], int]]]:
        yield "any order", self._in_any_order
        if executor.order is ExecutorOrder.PRIORITY and task.callback not in self.system.varying:
            yield "priorities", self._by_priority
        if executor.order is ExecutorOrder.WAIT_SET and task.is_timer:
            yield "timers first", self._as_timer
        elif (
            executor.order in (ExecutorOrder.WAIT_SET, ExecutorOrder.POLLED) and not executor.above
        ):
            yield "polling points", self._by_polling_points

    # -- what arrives, and when ------------------------------------------------------------------

    def _head(self, index: int, goes_on: Callable[[ChainTask], bool] = lambda task: True) -> int:
        """Return the first of the tasks up to this one that follow each other at once on one
        executor, as long as they are such that the analysis ``goes_on``."""
        tasks = self.system.tasks
        while True:
            task = tasks[index]
            if task.parent is None or task.link_ns != 0:
                return index
            parent = tasks[task.parent]
            if parent.executor != task.executor or not goes_on(parent):
                return index
            index = task.parent

    def _late(self, head: int) -> int:
        """Return how long after the release of its chain something arrives, at most."""
        task = self.system.tasks[head]
        if task.parent is None:
            return 0
        end = self.ends[task.parent]
        if end is None or task.link_ns is None:
            raise _Unbounded
        return end + task.link_ns

    def _arrivals(self, head: int) -> Arrivals:
        released = self._released[head]
        is_root = self.system.tasks[head].parent is None
        return released if is_root else released.delayed(self._late(head))

    def _work(self, indexes: Iterable[int], head_of: Callable[[int], int]) -> _Work:
        tasks = self.system.tasks
        return [
            (self._arrivals(head_of(one)), self._counts[one] * tasks[one].wcet_ns)
            for one in indexes
        ]

    # -- busy windows ----------------------------------------------------------------------------

    def _in_any_order(self, index: int) -> int:
        """Casini et al. 2019, lemma 8 (as revised): all else may go first."""
        others = [one for one in self._same(index) if one != index]
        return self._busy_window(index, self._head(index), self._work(others, self._head), 0)

    def _as_timer(self, index: int) -> int:
        """Casini et al. 2019, lemma 3: other timers that were created before go first, and one of
        all the others may have begun."""
        tasks = self.system.tasks
        others = [one for one in self._same(index) if one != index]
        first = [
            one for one in others if tasks[one].is_timer and tasks[one].place <= tasks[index].place
        ]
        blocking = max((tasks[one].wcet_ns for one in others if one not in first), default=0)
        return self._busy_window(index, index, self._work(first, lambda one: one), blocking)

    def _by_priority(self, index: int) -> int:
        """Non-preemptive fixed priorities: what is not less urgent goes first, and one that is less
        urgent may have begun."""
        tasks, varying = self.system.tasks, self.system.varying
        urgency = tasks[index].urgency

        def goes_first(task: ChainTask) -> bool:
            return task.urgency <= urgency and task.callback not in varying

        def head_of(one: int) -> int:
            return self._head(one, goes_first)

        others = [one for one in self._same(index) if one != index]
        first = [one for one in others if tasks[one].urgency <= urgency]
        rest = [
            tasks[one].wcet_ns
            for one in others
            if tasks[one].urgency > urgency or tasks[one].callback in varying
        ]
        work = self._work(first, head_of)
        return self._busy_window(index, head_of(index), work, max(rest, default=0))

    def _same(self, index: int) -> list[int]:
        executor = self.system.tasks[index].executor
        assert executor is not None
        return self._of[executor]

    def _busy_window(self, index: int, head: int, work: _Work, blocking_ns: int) -> int:
        """Return the latest end of a task whose window begins with its head's arrival at the
        earliest: the last callback starts when all ``work`` that came before is done, earlier ones
        of its own, and one other of ``blocking_ns``."""
        task = self.system.tasks[index]
        executor = self.system.executor_of(task)
        assert executor is not None
        own, cost_ns = self._arrivals(head), task.wcet_ns
        each_ns = self._counts[index] * cost_ns
        interrupting = [one for name in executor.above for one in self._of.get(name, ())]
        above = self._work(interrupting, self._head)
        supply = executor.supply

        def all_work(length_ns: int) -> int:
            return supply.time_for(
                blocking_ns
                + own.within(length_ns) * each_ns
                + _demand(work, length_ns)
                + _demand(above, length_ns)
            )

        window_ns = self._fixed_point(all_work, 1)
        worst_ns = 0
        for offset_ns, number in own.earliest(window_ns):
            fixed_ns = blocking_ns + number * each_ns

            def end(end_ns: int, fixed_ns: int = fixed_ns) -> int:
                start_ns = end_ns - cost_ns + 1
                demand_ns = _demand(work, start_ns) + _demand(above, end_ns)
                return supply.time_for(fixed_ns + demand_ns)

            # What ends at all ends after its own arrival.
            end_ns = self._fixed_point(end, max(offset_ns + cost_ns, 1))
            worst_ns = max(worst_ns, end_ns - offset_ns)
        return self._late(head) + worst_ns

    # -- polling points --------------------------------------------------------------------------

    def _by_polling_points(self, index: int) -> int:
        """A chain of n polled callbacks ends n polling points after its arrival, and between two of
        them every callback runs once (after Tang et al. 2020 and Blaß et al. 2021)."""
        tasks = self.system.tasks
        task = tasks[index]
        executor = self.system.executor_of(task)
        assert executor is not None
        timers_polled = executor.order is ExecutorOrder.POLLED
        head = self._head(index, lambda one: timers_polled or not one.is_timer)
        chain = self._chain(head, index)
        same = self._same(index)
        together: dict[object, list[int]] = {}
        for one in same:
            together.setdefault(tasks[one].callback, []).append(one)
        if any(len(together[tasks[one].callback]) > 1 for one in chain):
            raise _Unbounded  # others are in their queues
        if self._counts[index] > 1:
            raise _Unbounded
        polled, free = [], []
        for callback, members in together.items():
            if callback == task.callback:
                continue
            work = [self._executed(one) for one in members]
            if tasks[members[0]].is_timer and not timers_polled:
                free += work
                continue
            times = len(chain) + (tasks[members[0]].place < task.place)
            times = 1 if members[0] in chain else times
            polled.append((times, tasks[members[0]].wcet_ns, work))

        def start(length_ns: int) -> int:
            total = _demand(free, length_ns + 1)
            for times, cost_ns, work in polled:
                total += min(times * cost_ns, _demand(work, length_ns + 1))
            return total

        supply = executor.supply
        start_ns = self._fixed_point(lambda length_ns: supply.time_for(start(length_ns)), 0)
        response_ns = supply.time_for(start(start_ns) + task.wcet_ns)
        arrivals = self._arrivals(head)
        if arrivals.within(response_ns) > 1:
            raise _Unbounded  # the one before may be under way: more polling points
        return self._late(head) + response_ns

    def _chain(self, head: int, index: int) -> list[int]:
        chain = [index]
        while chain[-1] != head:
            parent = self.system.tasks[chain[-1]].parent
            assert parent is not None
            chain.append(parent)
        return chain

    def _executed(self, index: int) -> tuple[Arrivals, int]:
        """Return how often a task is executed in a time, wherever that begins: what arrived before
        may still be to do."""
        head = self._head(index)
        end = self.ends[index]
        if end is None:
            raise _Unbounded
        arrivals = self._arrivals(head)
        late = Arrivals(arrivals.period_ns, arrivals.jitter_ns + end - self._late(head))
        return late, self._counts[index] * self.system.tasks[index].wcet_ns

    def _fixed_point(self, function: Callable[[int], int], start_ns: int) -> int:
        value = start_ns
        while True:
            after = max(function(value), start_ns)
            if after <= value:
                return value
            if after > self._limit_ns:
                raise _Unbounded
            value = after


_Work = list[tuple[Arrivals, int]]
"""Arrivals, and how much work (ns) comes with each."""


def _demand(work: _Work, length_ns: int) -> int:
    return sum(arrivals.within(length_ns) * cost_ns for arrivals, cost_ns in work)


def _is_overloaded(system: TaskSystem, executor: str) -> bool:
    supply = system.executors.get(executor, ExecutorModel()).supply
    return utilization(system, executor) > supply.budget_ns / supply.period_ns + 1e-9


def utilization(system: TaskSystem, executor: str) -> float:
    """Return which part of its time an executor is busy, if all callbacks take their longest."""
    return sum(
        system.count(task) * task.wcet_ns / system.arrivals(task).period_ns
        for task in system.tasks
        if task.executor == executor
    )
