"""What lets a process go on besides messages and timers: the end of a wait, and the graph."""

from __future__ import annotations

from typing import Any, Protocol

from rsltrace.simulation.loop.timer import TimerState
from rsltrace.simulation.middleware.entity import Runnable
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.trace.model.event import NO_EVENT, EventKind

_RESUME = int(EventKind.RESUME)


class Waiting(Protocol):
    """A process, as what wakes it sees it."""

    name: str
    entity_id: int
    dispatcher: Dispatcher

    @property
    def waits_for_graph(self) -> bool:
        """Whether one of its threads waits for a change of the graph now."""

    def wake(self, thread: int) -> None:
        """Let a thread go on whose time has come."""

    def see_graph(self) -> None:
        """Let those threads go on that wait for a change of the graph."""


class WakingTimer:
    """Wakes a thread of a process when the time is over for which it sleeps or waits."""

    def __init__(self, process: Waiting, thread: int) -> None:
        self._process = process
        self._thread = thread
        dispatcher = process.dispatcher
        self._state = TimerState(
            0, dispatcher.loop.now_ns, order=dispatcher.entities.new_id(), owner=self
        )
        self._asleep: tuple[int, Any, int] | None = None
        self._at_ns: int | None = None

    def at(self, deadline_ns: int, *, asleep: bool) -> None:
        """Wake it at a time; ``asleep`` says that the event under way goes on then."""
        if deadline_ns == self._at_ns:  # it sleeps on, whoever ran in between
            return
        self._at_ns = deadline_ns
        dispatcher = self._process.dispatcher
        event = dispatcher.event
        self._asleep = (event.entity, event.node, dispatcher.loop.events) if asleep else None
        self._state.deadline_ns = deadline_ns
        dispatcher.loop.timers.add(self._state)

    def off(self) -> None:
        """Forget it: the thread goes on."""
        self._at_ns = None
        self._process.dispatcher.loop.timers.remove(self._state)

    def dispatch(self) -> None:
        """Let the thread go on, as an event."""
        self.off()
        entity, node, cause = self._asleep or (self._process.entity_id, None, NO_EVENT)
        self._process.dispatcher.execute(
            self, entity, node, _RESUME, self._process.wake, (self._thread,), cause, 0, 0
        )

    def runnable(self) -> Runnable:
        """Describe it to a policy: a callback under way goes on, and has its worker."""
        entity = self._process.entity_id if self._asleep is None else self._asleep[0]
        return Runnable("resume", "", entity)

    def describe(self) -> str:
        """Name it for people."""
        return f"{self._process.name}: the end of a wait"


class GraphChange:
    """Wakes a process that waits for the graph to change; what changes before it waits, counts."""

    def __init__(self, process: Waiting) -> None:
        self._process = process
        self._is_due = False
        self._is_queued = False

    def note(self) -> None:
        """The graph has changed."""
        self._is_due = True
        self.look()

    def look(self) -> None:
        """Wake the process if it waits for a change that there was."""
        if self._is_due and not self._is_queued and self._process.waits_for_graph:
            self._is_queued = True
            self._process.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Let the process go on, as an event, if it still waits."""
        self._is_queued = False
        process = self._process
        if not process.waits_for_graph:
            return
        self._is_due = False
        process.dispatcher.execute(
            self, process.entity_id, None, _RESUME, process.see_graph, (), NO_EVENT, 0, 0
        )

    def runnable(self) -> Runnable:
        """Describe it to a policy."""
        return Runnable("resume", "", self._process.entity_id)

    def describe(self) -> str:
        """Name it for people."""
        return f"{self._process.name}: a change of the graph"
