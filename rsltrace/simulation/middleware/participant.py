"""Participants: those who publish, subscribe, call and serve; in ROS, nodes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from rsltrace.simulation.middleware.entity import DomainEntity, callback_name
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import Door, State
from rsltrace.simulation.middleware.timer import Timer
from rsltrace.trace.model.entity import EntityKind


class ActionEnd(Protocol):
    """A client or a server of an action, which is made of other endpoints."""

    name: str
    is_client: bool

    @property
    def type_name(self) -> str:
        """The name of the action's type."""


_THINGS_PER_NODE = 1 << 20


class Participant(DomainEntity):
    """Somebody in the domain, with a name; in the trace, a node.

    ``door`` speaks for it. ``process`` is where it lives, if that may end before the run does.
    ``number`` tells those of one name apart, in the order of creation.
    """

    kind = EntityKind.NODE
    process: object = None
    held: list[Any] | None = None
    """What would run of it, besides its callbacks, if it did not hang."""
    number = 1

    def __init__(self, dispatcher: Dispatcher, name: str, namespace: str, door: Door) -> None:
        super().__init__(dispatcher, None)
        self.node = self
        self.name = name
        self.namespace = namespace
        self.fully_qualified_name = full_name(namespace, name)
        self.door = door
        self.state: State | None = None
        self.actions: list[ActionEnd] = []
        self.timers: list[Timer] = []

    @property
    def key(self) -> str:
        """The full name, with the number of a second one of that name: ``/n #2``."""
        name = self.fully_qualified_name
        return name if self.number == 1 else f"{name} #{self.number}"

    def ordinal(self, count: int) -> int:
        """Return a number for one of its things that no other node of its name gives."""
        return count + (self.number - 1) * _THINGS_PER_NODE

    def timer_periods(self) -> Iterable[tuple[str, int]]:
        """Yield (callback, period in ns) of its timers."""
        return ((callback_name(timer.callback), timer.state.period_ns) for timer in self.timers)

    def shortest_period_ns(self) -> int | None:
        """Return the period of its fastest timer, None if it has none."""
        return min((period_ns for _, period_ns in self.timer_periods()), default=None)

    def trace_name(self) -> str:
        return self.fully_qualified_name

    def describe(self) -> str:
        return self.fully_qualified_name


def full_name(namespace: str, name: str) -> str:
    """Return a node's fully qualified name."""
    return (namespace if namespace.endswith("/") else namespace + "/") + name
