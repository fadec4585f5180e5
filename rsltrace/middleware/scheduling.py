"""What an ordered loop has to know of what may run: names, periods, groups, simulated executors;
and execution times, which keep workers busy and hold back what a callback sends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from rsltrace.chance.distribution import Distribution, Sampler
from rsltrace.chance.stream import Stream
from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
from rsltrace.doors.rclpy.stacks.blocking_calls import Wait
from rsltrace.doors.rclpy.stacks.tasks import TaskRun
from rsltrace.loop.ordered import OrderedLoop, Place, Workers
from rsltrace.loop.policy import Candidate, Policy
from rsltrace.middleware.links import note
from rsltrace.model.draw import Draw, encode_draw
from rsltrace.model.event import EventKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core

_LISTS = ("subscriptions", "timers", "clients", "services", "guards", "waitables")
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
    """What a job says of order, executors and execution times. The first rule that fits counts.

    Nodes without an executor have one of their own with one worker; ``occupies`` says whether
    callbacks occupy workers at all.
    """

    policy: Policy
    executors: tuple[ExecutorRule, ...] = ()
    execution: tuple[ExecutionRule, ...] = ()
    occupies: bool = False
    seed: int = 0
    start_ns: int = 0


class Scheduling:
    """Describes to the loop what may run, and gives callbacks their durations."""

    def __init__(self, core: Core, loop: OrderedLoop, plan: SchedulingPlan) -> None:
        self._core = core
        self._loop = loop
        self._plan = plan
        self._workers: dict[object, Workers] = {}
        self._durations: dict[int, Sampler | None] = {}
        self._counts: dict[tuple[str, str, str], int] = {}
        loop.policy = plan.policy
        loop.place = self.place
        if plan.execution:
            self._execute = core.execute
            core.execute = self._timed  # type: ignore[method-assign]

    # -- what may run --------------------------------------------------------------------------

    def place(self, item: Any) -> Place:
        """Describe something that may run."""
        if isinstance(item, Wait):  # a callback under way goes on: it has its worker
            return Place(_candidate(item, None, item.entity_id, "resume", "", ()), None, None)
        node: NodeHandle | None = getattr(item, "node", None)
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        exclusive = group if hasattr(group, "_active_entity") else None
        names: tuple[str, ...] = ()
        if node is not None and group is not None:
            names = _names_in_group(node, group)
        if isinstance(item, TaskRun):
            candidate = _candidate(item, node, item.entity, "task", item.label(), ())
            exclusive = None
        elif isinstance(item, EntityHandle):
            kind = item.kind.label.replace(" ", "_")
            candidate = _candidate(item, node, item.entity_id, kind, item.trace_name(), names)
        else:
            # A thread that user code has started is on no executor.
            candidate = _candidate(item, node, 0, "thread", item.describe(), ())
            return Place(candidate, None, None)
        return Place(candidate, self._workers_of(node), exclusive)

    def _workers_of(self, node: NodeHandle | None) -> Workers | None:
        """Return the executor of a node; none for nodes that an executor of the user's own runs."""
        if not self._plan.occupies or node is None or node.mailbox is not None:
            return None
        name = node.fully_qualified_name
        key: object = name
        count = 1
        for index, rule in enumerate(self._plan.executors):
            if any(fnmatchcase(name, glob) for glob in rule.nodes):
                key, count = index, rule.workers
                break
        workers = self._workers.get(key)
        if workers is None:
            workers = self._workers[key] = Workers(str(key), count)
        return workers

    # -- how long it takes ---------------------------------------------------------------------

    def _timed(
        self,
        handle: Any,
        entity: int,
        node: NodeHandle | None,
        kind: int,
        callback: Callable[..., object],
        args: tuple[Any, ...],
        cause_event: int,
        cause_output: int,
        input_hash: int,
    ) -> None:
        """Stand in for ``Core.execute``: draw how long the callback takes, then run it."""
        core, charge = self._core, self._loop.charge
        duration = None
        if kind in _TAKES_TIME and isinstance(handle, (EntityHandle, TaskRun)):
            duration = self._duration_of(handle, entity, node)
        duration_ns = 0 if duration is None else duration(core.loop.now_ns)
        if duration is not None:
            note(core, entity, encode_draw(Draw.EXECUTION, duration_ns))
        before, core.busy_ns = core.busy_ns, duration_ns
        self._execute(
            handle, entity, node, kind, callback, args, cause_event, cause_output, input_hash
        )
        core.busy_ns = before
        core.took_ns = duration_ns
        charge.duration_ns += duration_ns

    def _duration_of(self, handle: Any, entity: int, node: NodeHandle | None) -> Sampler | None:
        if entity in self._durations:
            return self._durations[entity]
        sampler = None
        if node is not None:
            owner = node.fully_qualified_name
            kind = handle.kind.label if isinstance(handle, EntityHandle) else "task"
            name = handle.trace_name() if isinstance(handle, EntityHandle) else ""
            key = (owner, kind, name)
            ordinal = self._counts[key] = self._counts.get(key, -1) + 1
            for rule in self._plan.execution:
                if fnmatchcase(owner, rule.node) and (
                    rule.entity is None or fnmatchcase(name, rule.entity)
                ):
                    stream = Stream(
                        self._plan.seed, f"execution\0{owner}\0{kind}\0{name}\0{ordinal}"
                    )
                    sampler = rule.duration.sampler(stream, self._plan.start_ns)
                    break
        self._durations[entity] = sampler
        return sampler


def _candidate(
    item: Any,
    node: NodeHandle | None,
    entity_id: int,
    kind: str,
    name: str,
    group: tuple[str, ...],
) -> Candidate:
    owner = node.fully_qualified_name if node is not None else ""
    return Candidate(owner, name, kind, entity_id, _period_ns(item, node), group, item)


def _period_ns(item: Any, node: NodeHandle | None) -> int | None:
    """Return a timer's period, or that of the fastest timer of a node that runs."""
    state = getattr(item, "state", None)
    if state is not None and hasattr(state, "period_ns"):
        return int(state.period_ns)
    timers = getattr(getattr(node, "wrapper", None), "timers", ())
    return min((timer.handle.state.period_ns for timer in timers), default=None)


def _names_in_group(node: NodeHandle, group: Any) -> tuple[str, ...]:
    names = []
    for attribute in _LISTS:
        for wrapper in getattr(node.wrapper, attribute, ()):
            handle = getattr(wrapper, "handle", None)
            if getattr(wrapper, "callback_group", None) is group and handle is not None:
                names.append(handle.trace_name())
    return tuple(names)
