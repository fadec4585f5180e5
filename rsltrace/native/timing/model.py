"""From a job, and the graph that a run of it has shown, to a system that can be analyzed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import SimpleNamespace
from typing import Any

from rsltrace.errors import JobError
from rsltrace.job import Job, locate
from rsltrace.native.timing.chains import ChainPath, ObservedChains
from rsltrace.native.timing.system import (
    ONCE_NS,
    PROCESSOR,
    Arrivals,
    CallbackKey,
    ChainTask,
    ExecutorModel,
    ExecutorOrder,
    Supply,
    TaskSystem,
)
from rsltrace.run.plans.network import network_plan
from rsltrace.run.plans.scheduling import policy_of_job, scheduling_plan, switches_at_lines
from rsltrace.simulation.chance.channel import NetworkPlan
from rsltrace.simulation.chance.distribution import (
    Constant,
    Distribution,
    Empirical,
    MeasuredSamples,
    TimeSeries,
    Uniform,
)
from rsltrace.simulation.loop.policy import Candidate, ExecutionPolicy, Priority, RateMonotonic
from rsltrace.simulation.loop.wait_set import RclcppWaitSetPolicy, RclpyWaitSetPolicy


@dataclass(frozen=True, slots=True)
class ProcessorModel:
    """How executors share processors: each has ``supply``, or all have one processor, and real-time
    priorities by rate (``one_processor``)."""

    supply: Supply = PROCESSOR
    one_processor: bool = False


def check_job(job: Job) -> None:
    """Raise ``JobError`` at the first part of a job for which there is no analysis."""
    for index, spec in enumerate(job.nodes):
        if spec.node is None or spec.isolated:
            raise JobError(
                f"{spec.target} spins by itself, and how is not known: only nodes (node:) can be "
                "analyzed",
                where=spec.origin or locate(job, ("nodes", index, spec.kind)),
            )
    if job.min_time_step_ns:
        raise JobError(
            "there is no analysis of runs whose time moves on in steps",
            where=locate(job, ("min_time_step",)),
        )
    if switches_at_lines(job):
        raise JobError(
            "there is no analysis of threads that take turns at lines",
            where=locate(job, ("threads", "switch")),
        )


def longest_times(job: Job, observed: ObservedChains) -> tuple[dict[CallbackKey, int], list[str]]:
    """Return the longest that the job lets each callback take (ns), and what to know of that.

    Of distributions without an end it is the longest that the run has drawn.
    """
    plan = scheduling_plan(job, 0, None)
    found: dict[CallbackKey, int] = {}
    open_ended: list[str] = []
    for callback in observed.callbacks.values():
        rule = next(
            (
                one
                for one in plan.execution
                if fnmatchcase(callback.node, one.node)
                and (one.entity is None or fnmatchcase(callback.name, one.entity))
            ),
            None,
        )
        longest_ns = 0 if rule is None else longest(rule.duration)
        if longest_ns is None:
            drawn = observed.durations.get(callback)
            longest_ns = 0 if drawn is None else int(drawn.max())
            if drawn is not None:
                open_ended.append(str(callback))
        found[callback] = longest_ns
    notes = []
    if open_ended:
        notes.append(
            "no bound for execution times without an end, the longest of the run are taken: "
            + ", ".join(dict.fromkeys(open_ended))
        )
    return found, notes


def longest(distribution: Distribution) -> int | None:
    """Return the longest that something may take (ns), None if there is no end."""
    match distribution:
        case Constant(value_ns):
            return value_ns
        case Uniform(_, max_ns):
            return max_ns
        case MeasuredSamples(values_ns):
            return max(values_ns)
        case Empirical(_, values_ns):
            return max(values_ns)
        case TimeSeries(points):
            return max(value_ns for _, value_ns in points)
    return None


def system_of(
    job: Job, observed: ObservedChains, times: Mapping[CallbackKey, int], wanted: ProcessorModel
) -> tuple[TaskSystem, list[str]]:
    """Return the system of a job whose tasks are the paths of ``observed``, in their order, and
    what to know of it."""
    return _SystemBuilder(job, observed, times, wanted).system()


class _SystemBuilder:
    def __init__(
        self,
        job: Job,
        observed: ObservedChains,
        times: Mapping[CallbackKey, int],
        wanted: ProcessorModel,
    ) -> None:
        self.job = job
        self.observed = observed
        self.times = times
        self.wanted = wanted
        self.notes: list[str] = []
        self.policy: ExecutionPolicy = policy_of_job(job, 0)
        self.plan = scheduling_plan(job, 0, self.policy)
        self.network: NetworkPlan | None = network_plan(job, 0)
        self.rates = self._rates()

    def system(self) -> tuple[TaskSystem, list[str]]:
        tasks = tuple(self._task(path) for path in self.observed.paths)
        used = {task.executor for task in tasks if task.executor is not None}
        order = self._order()
        rates = {
            name: min(self._period(i) for i, task in enumerate(tasks) if task.executor == name)
            for name in used
        }
        executors = {}
        for name in used:
            above: frozenset[str] = frozenset()
            if self.wanted.one_processor:
                above = frozenset(
                    other for other in used if other != name and rates[other] <= rates[name]
                )
            executors[name] = ExecutorModel(order, self.wanted.supply, above)
        varying = frozenset(one for one, found in self.rates.items() if len(found) > 1)
        if not isinstance(self.policy, RateMonotonic):
            varying = frozenset()
        return TaskSystem(tasks, executors, varying), list(dict.fromkeys(self.notes))

    def _order(self) -> ExecutorOrder:
        if isinstance(self.policy, RclpyWaitSetPolicy):
            return ExecutorOrder.POLLED
        if isinstance(self.policy, RclcppWaitSetPolicy):
            return ExecutorOrder.WAIT_SET
        if isinstance(self.policy, Priority) and self.job.policy is not None:
            if any(rule.group_of is not None for rule in self.job.policy.priority or ()):
                self.notes.append("priorities of callback groups (group_of) are not analyzed")
                return ExecutorOrder.ANY
            return ExecutorOrder.PRIORITY
        return (
            ExecutorOrder.PRIORITY if isinstance(self.policy, RateMonotonic) else ExecutorOrder.ANY
        )

    def _task(self, path: ChainPath) -> ChainTask:
        callback = path.key[-1]
        parent = None if path.parent is None else self.observed.paths[path.parent]
        arrivals = self._arrivals(path) if parent is None else None
        link_ns = 0 if parent is None else self._link_ns(parent.key[-1], callback)
        candidate = self._candidate(path.entity, callback)
        place: tuple[int, ...] = ()
        urgency = 0.0
        if isinstance(self.policy, RclcppWaitSetPolicy):
            place = self.policy.place(candidate)
        elif isinstance(self.policy, Priority):
            urgency = -self.policy.priority(candidate)
        elif isinstance(self.policy, RateMonotonic):
            urgency = min(self.rates[callback])
        return ChainTask(
            callback,
            None if path.waits else self._executor(callback),
            self.times.get(callback, 0),
            arrivals,
            path.parent,
            link_ns,
            path.count,
            urgency,
            place,
        )

    def _arrivals(self, path: ChainPath) -> Arrivals:
        callback = path.key[0]
        period_ns = self.observed.period_ns(callback)
        if period_ns and callback not in self.observed.reset:
            return Arrivals(period_ns)
        gap_ns = path.gap_ns if path.runs > 1 else ONCE_NS
        shown = "came once" if path.runs == 1 else "are taken to come as closely as in the run"
        what = "calls" if callback.kind == "timer" else "messages from outside"
        self.notes.append(f"{what} of {callback} {shown}")
        return Arrivals(max(gap_ns or 1, 1))

    def _candidate(self, entity: int, callback: CallbackKey) -> Candidate:
        owner = self.observed.trace.entity(entity).node
        item: Any = SimpleNamespace(node=SimpleNamespace(entity_id=owner))
        return Candidate(callback.node, callback.name, callback.kind, entity, None, (), item)

    def _executor(self, callback: CallbackKey) -> str | None:
        for index, rule in enumerate(self.plan.executors):
            if any(fnmatchcase(callback.node, glob) for glob in rule.nodes):
                if rule.workers > 1:
                    where = locate(self.job, ("executors", index, "workers"))
                    self.notes.append(
                        f"{where}: there is no analysis of executors with several workers"
                    )
                    return None
                return f"executors[{index}]"
        return callback.node

    def _link_ns(self, sender: CallbackKey, receiver: CallbackKey) -> int | None:
        """Return how long messages take at most, None if there is no bound."""
        if self.network is None:
            return 0
        if receiver.kind == "subscription":
            model = self.network.topic_model(receiver.name, sender.node, receiver.node)
        else:
            model = self.network.service_model(receiver.name)
        longest_ns: int | None = 0
        if model is not None:
            lossy = model.drop > 0 or model.burst is not None or model.duplicate > 0
            longest_ns = 0 if model.delay is None else longest(model.delay)
            longest_ns = None if lossy else longest_ns
        if self.network.outages:
            longest_ns = None
        if longest_ns is None:
            self.notes.append(
                f"there is no bound for how long {receiver.name} takes from {sender.node} to "
                f"{receiver.node} (losses, outages, a distribution without an end)"
            )
        return longest_ns

    # -- rates -----------------------------------------------------------------------------------

    def _rates(self) -> dict[CallbackKey, set[float]]:
        """Return the periods (ns) of the chains that callbacks are in."""
        found: dict[CallbackKey, set[float]] = {}
        for index, path in enumerate(self.observed.paths):
            found.setdefault(path.key[-1], set()).add(self._period(index))
        return found

    def _period(self, index: int) -> float:
        """Return the period that a path goes back to: that of its timer, or else of the fastest of
        its last node."""
        path = self.observed.paths[index]
        period_ns = self.observed.period_ns(path.key[0])
        if period_ns is not None:
            return period_ns
        node = path.key[-1].node
        periods = (self.observed.period_ns(one) for one in self.observed.of if one.node == node)
        return min((one for one in periods if one), default=float("inf"))
