"""The base classes of participants and their endpoints (DDS: domain entities)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rsltrace.compiled import EntityFields
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import callback_source
from rsltrace.trace.model.entity import Entity, EntityKind


@dataclass(frozen=True, slots=True)
class Runnable:
    """Something that may run, as policies, simulated executors and execution times see it.

    ``kind`` and ``name`` are for policies. ``group`` is its mutually exclusive callback group,
    ``group_names`` the names of the group's members. ``executor``: it runs on a simulated executor.
    ``thread`` distinguishes concurrent callbacks of one entity, and numbers tasks. ``handed_over``:
    one of the user's own executors runs it.
    """

    kind: str
    name: str
    entity: int
    node: Any = None
    group: object | None = None
    group_names: tuple[str, ...] = ()
    period_ns: int | None = None
    executor: bool = True
    thread: int = 0
    handed_over: bool = False


def on_no_executor(
    node: Any, name: str, kind: str = "thread", *, handed_over: bool = False
) -> Runnable:
    """Describe an item that runs on none of the simulated executors, such as a thread."""
    period_ns = None if node is None else node.shortest_period_ns()
    return Runnable(
        kind, name, 0, node, period_ns=period_ns, executor=False, handed_over=handed_over
    )


class GraphMembership(Protocol):
    """The graph, as a member sees it."""

    def remove(self, member: Any) -> None:
        """Forget a member."""

    def services(self, service: str) -> list[Any]:
        """Return the servers of a service in creation order."""


class DomainEntity(EntityFields):
    """Something with an id in the trace: a participant, an endpoint, a timer.

    It is ``active`` while its participant is run; only then does the loop learn of its arrivals.
    ``node`` is its participant, None until it is known.
    """

    kind: EntityKind
    announced = True
    """Whether the entity is recorded when it is created."""
    begins_active = True
    graph: GraphMembership | None = None
    """The graph it has joined."""

    def __init__(self, dispatcher: Dispatcher, node: Any) -> None:
        self.destroyed = False
        self.dispatcher = dispatcher
        self.node = node
        self.active = self.begins_active
        self.entity_id = dispatcher.entities.new_id()
        self.created_ns = dispatcher.loop.now_ns
        dispatcher.entities.pending.append(self)

    def destroy(self) -> None:
        if not self.destroyed:
            self.destroyed = True
            self._destroy()

    def _destroy(self) -> None:
        """Release what the entity holds; called once."""
        if self.graph is not None:
            self.graph.remove(self)

    def settle(self) -> bool:
        return self.node is not None

    def __reduce_ex__(self, protocol: object) -> Any:
        raise TypeError(f"cannot pickle '{type(self).__name__}' object")  # compiled or not

    def entity(self) -> Entity:
        detail = self.trace_detail()
        if source := callback_source(self.user_callback()):
            detail["source"] = source
        if group := self.trace_group():
            detail["group"] = group
        return Entity(
            id=self.entity_id,
            node=self.node.entity_id if self.node is not None else 0,
            kind=self.kind,
            name=self.trace_name(),
            type=self.trace_type(),
            created_ns=self.created_ns,
            detail=detail,
        )

    def trace_name(self) -> str:
        """Return the topic, service or callback name."""
        return ""

    def trace_type(self) -> str:
        return ""

    def trace_detail(self) -> dict[str, object]:
        """Return the details of this kind of entity."""
        return {}

    def trace_group(self) -> str:
        """Return the callback group: ``mutually exclusive 1``; "" for the default one, or none."""
        return ""

    def user_callback(self) -> object:
        """Return the user's callable, or None."""
        return getattr(self, "callback", None)

    def describe(self) -> str:
        """Name the entity for people: ``/listener: subscription /chatter``."""
        node = self.node.fully_qualified_name if self.node is not None else "(no node)"
        return f"{node}: {self.kind.label} {self.trace_name()}"

    def runnable(self) -> Runnable:
        kind = self.kind.label.replace(" ", "_")
        return Runnable(kind, self.trace_name(), self.entity_id, self.node, period_ns=self.period())

    def period(self) -> int | None:
        """Return its period in ns, or that of its participant's fastest timer."""
        return None if self.node is None else self.node.shortest_period_ns()

    def execution_name(self) -> tuple[str, str]:
        """Return (kind, name) to which execution times refer."""
        return self.kind.label, self.trace_name()


def callback_name(callback: Callable[..., Any] | Any) -> str:
    """Name a callback as in ``Talker.on_timer``; never with an address."""
    if callback is None:
        return ""
    if isinstance(callback, partial):
        return f"partial({callback_name(callback.func)})"
    try:  # a callable object may answer anything: a mock does
        name = callback.__qualname__
        if isinstance(name, str):
            return name
    except Exception:
        pass
    return type(callback).__qualname__


class Receiver(DomainEntity):
    """An entity with a queue of arrivals for its callback.

    Each entry in the loop's ready queue stands for one arrival, so arrivals of all entities run in
    order. The entry of a dropped arrival finds nothing to do.
    """

    queue: deque[Any]
    keep: int | None
    """How many arrivals the queue holds; a full one drops its oldest. None: all."""
    origin = slice(1, 4)
    """Where an arrival says what it is: publishing event, which of its outputs, content hash."""

    def __init__(self, dispatcher: Dispatcher, node: Any) -> None:
        super().__init__(dispatcher, node)
        self.keep = None

    def deliver(self, arrival: Any) -> None:
        """Queue an arrival; it is dispatched once its participant runs."""
        if self.arrived(arrival) is not None:
            self.dispatcher.loop.ready.append(self)

    def arrived(self, arrival: Any) -> Receiver | None:
        """Queue an arrival; return this receiver if it is ready for it now."""
        if len(self.queue) == self.keep:
            self.drop()
        self.queue.append(arrival)
        if self.active:
            return self
        self.awaken()
        return None

    def drop(self, held: int = 0) -> None:
        """Count a dropped arrival; ``held`` is the queue size of a publisher in an outage."""
        drops = self.dispatcher.outcome.drops
        drops[self, held] = drops.get((self, held), 0) + 1

    def awaken(self) -> None:
        """Become active if possible: something has arrived."""

    def activate(self) -> None:
        """Announce all arrivals so far to the loop."""
        self.dispatcher.loop.ready.extend([self] * len(self.queue))

    def may_run(self) -> bool:
        return bool(self.queue) and self.active and not self.destroyed

    def settle(self) -> bool:
        return True

    def dispatch(self) -> None:
        """Take the oldest arrival and run the callback with it."""
        raise AssertionError("every receiver says how")
