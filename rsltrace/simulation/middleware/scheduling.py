"""What an ordered loop needs to know of callbacks: names, periods, groups, simulated executors; and
execution times, which keep workers busy and delay what a callback sends."""

from __future__ import annotations

from array import array
from fnmatch import fnmatchcase
from typing import Any

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.distribution import Distribution, Sampler
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.ordered import OrderedLoop, ReadyItem, SimulatedExecutor
from rsltrace.simulation.loop.policy import Candidate, ExecutionPolicy
from rsltrace.simulation.middleware.entity import Receiver, Runnable
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import EventOwner, OutsideEvent
from rsltrace.simulation.middleware.events.observer import EventCall, EventObserver, ObserverOrder
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.trace.model.event import EventKind, RandomDecision, encode_decision

# The period of a subscription (service, client) is that of the fastest chain that has reached it;
# without a timer as cause (bags, drivers), that of its node's fastest timer.

_UNKNOWN = -1


def follows_chains(policy: object) -> bool:
    return bool(getattr(policy, "follows_chains", False))


class ChainPeriods(EventObserver):
    """Tracks the timer period that each event goes back to."""

    order = ObserverOrder.RATES

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._loop = dispatcher.loop
        self._of_events = array("q")
        self._of_entities: dict[int, int] = {}
        dispatcher.add_observer(self)

    def period(self, item: Any, what: Runnable) -> int | None:
        """Return the period (ns) of an item, including its latest arrival."""
        if what.kind == "timer" and what.period_ns is not None:
            self._of_entities[what.entity] = what.period_ns
        elif isinstance(item, Receiver) and item.queue:
            period_ns = self._of_event(item.queue[-1][item.origin][0])
            known = self._of_entities.get(what.entity, period_ns)
            if period_ns is not None and known is not None:
                self._of_entities[what.entity] = min(known, period_ns)
        return self._of_entities.get(what.entity, what.period_ns)

    def _of_event(self, event: int) -> int | None:
        known = event < len(self._of_events) and self._of_events[event] != _UNKNOWN
        return self._of_events[event] if known else None

    def before_event(self, call: EventCall) -> bool:
        period_ns = self._of_entities.get(call.entity)
        if period_ns is None:
            period_ns = self._of_event(call.cause_event)
        missing = self._loop.events - len(self._of_events)
        self._of_events.extend((_UNKNOWN,) * missing)
        self._of_events.append(_UNKNOWN if period_ns is None else period_ns)
        return True


_TAKES_TIME = frozenset(
    map(
        int,
        (
            EventKind.TIMER,
            EventKind.SUBSCRIPTION,
            EventKind.SERVICE,
            EventKind.CLIENT,
            EventKind.GUARD_CONDITION,
            EventKind.TASK,
            EventKind.QOS_EVENT,
            EventKind.ACTION,
        ),
    )
)


@dataclass(frozen=True, slots=True)
class ExecutorRule:
    """An executor with ``workers`` for the nodes that one of the globs matches."""

    nodes: tuple[str, ...]
    workers: int


@dataclass(frozen=True, slots=True)
class ExecutionRule:
    """How long callbacks take, for what the globs describe; ``entity`` None: the whole node."""

    node: str
    entity: str | None
    duration: Distribution


@dataclass(frozen=True, slots=True)
class SchedulingPlan:
    """What a job says of order, executors and execution times. The first matching rule counts.

    Nodes without an executor have one of their own with one worker; ``occupies``: callbacks occupy
    workers at all.
    """

    policy: ExecutionPolicy
    executors: tuple[ExecutorRule, ...] = ()
    execution: tuple[ExecutionRule, ...] = ()
    occupies: bool = False
    seed: int = 0
    start_ns: int = 0


class Scheduling:
    """Describes to the loop what may run."""

    def __init__(self, dispatcher: Dispatcher, loop: OrderedLoop, plan: SchedulingPlan) -> None:
        self._plan = plan
        self._workers: dict[object, SimulatedExecutor] = {}
        loop.policy = plan.policy
        loop.place = self.place
        self._rates: ChainPeriods | None = None
        if follows_chains(plan.policy):
            self._rates = ChainPeriods(dispatcher)
        if plan.execution:
            dispatcher.add_observer(ExecutionTimes(dispatcher, loop, plan))

    def place(self, item: Any) -> ReadyItem:
        what: Runnable = item.runnable()
        owner = what.node.fully_qualified_name if what.node is not None else ""
        workers = self._workers_of(what)
        candidate = Candidate(
            owner,
            what.name,
            what.kind,
            what.entity,
            what.period_ns if self._rates is None else self._rates.period(item, what),
            what.group_names,
            item,
            what.thread,
            "" if workers is None else workers.name,
        )
        return ReadyItem(candidate, workers, what.group, what.handed_over)

    def _workers_of(self, what: Runnable) -> SimulatedExecutor | None:
        """Return the simulated executor of an item, or None."""
        if not self._plan.occupies or what.node is None or not what.executor:
            return None
        name = what.node.fully_qualified_name
        key: object = name
        count = 1
        for index, rule in enumerate(self._plan.executors):
            if any(fnmatchcase(name, glob) for glob in rule.nodes):
                key, count = index, rule.workers
                break
        workers = self._workers.get(key)
        if workers is None:
            workers = self._workers[key] = SimulatedExecutor(str(key), count)
        return workers


class ExecutionTimes(EventObserver):
    order = ObserverOrder.EXECUTION_TIMES

    def __init__(self, dispatcher: Dispatcher, loop: OrderedLoop, plan: SchedulingPlan) -> None:
        self._dispatcher = dispatcher
        self._loop = loop
        self._plan = plan
        self._durations: dict[int, Sampler | None] = {}
        self._counts: dict[tuple[str, str, str], int] = {}

    def before_event(self, call: EventCall) -> bool:
        """Draw the execution time, and charge it when the callback is over."""
        event, charge = self._dispatcher.event, self._loop.charge
        duration = None
        if call.kind in _TAKES_TIME and not isinstance(call.handle, OutsideEvent):
            duration = self._duration_of(call.handle, call.entity, call.node)
        duration_ns = 0 if duration is None else duration(self._loop.now_ns)
        if duration is not None:
            self._dispatcher.draw(
                call.entity, encode_decision(RandomDecision.EXECUTION, duration_ns)
            )
        before, event.busy_ns = event.busy_ns, duration_ns

        def ended() -> None:
            event.busy_ns = before
            event.took_ns = duration_ns
            charge.duration_ns += duration_ns

        call.on_end.append(ended)
        return True

    def _duration_of(self, handle: Any, entity: int, node: EventOwner | None) -> Sampler | None:
        if entity in self._durations:
            return self._durations[entity]
        sampler = None
        if node is not None:
            owner = node.fully_qualified_name
            kind, name = handle.execution_name()
            assert isinstance(node, Participant), "nobody else's callbacks take time"
            key = (node.key, kind, name)
            self._counts[key] = self._counts.get(key, -1) + 1
            ordinal = node.ordinal(self._counts[key])
            for rule in self._plan.execution:
                if fnmatchcase(owner, rule.node) and (
                    rule.entity is None or fnmatchcase(name, rule.entity)
                ):
                    stream = RandomStream(
                        self._plan.seed, f"execution\0{owner}\0{kind}\0{name}\0{ordinal}"
                    )
                    sampler = rule.duration.sampler(stream, self._plan.start_ns)
                    break
        self._durations[entity] = sampler
        return sampler
