"""Entries that start while the run goes on: after a time, a topic, a service, a node, or another
entry's start or end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.adapters.rclpy.entry import Entry, StartRule
from rsltrace.adapters.rclpy.stacks.runtime import Runtime
from rsltrace.simulation.loop.loop import Release
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.events.event import Event, OutsideEvent
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.services import Service
from rsltrace.trace.model.event import NO_EVENT, OutputKind
from rsltrace.trace.model.finding import Policy

# Events in which the code of a job's entry runs: its constructor, its main, its threads.


class ConstructionEvent(OutsideEvent):
    """An event that is no entity's callback; ``entry`` is what is being constructed, or None."""

    def __init__(self, describe: Callable[[], str], entry: Entry | None) -> None:
        super().__init__(describe)
        self.entry = entry


def policy_of(event: Event) -> Policy | None:
    """Return the guard's policy for whoever runs, or None for the job's."""
    if event.node is not None:
        return getattr(event.node, "policy", None)
    entry = entry_of(event)
    return entry.policy if entry is not None else None


def entry_of(event: Event) -> Entry | None:
    """Return the entry of the job whose constructor runs, as long as it has made no node."""
    return getattr(event.handle, "entry", None)


STARTS = 4
"""The operation of a TASK output: what comes of it is that an entry starts."""

ConstructEntry = Callable[[Entry, tuple[int, int]], bool]
"""Constructs an entry, given the event and output that made it start; False: that ended the run."""


class EntryStarts:
    """The entries that wait for their start. ``failed`` is the one whose construction has ended
    the run."""

    def __init__(self, stacks: Runtime, construct: ConstructEntry) -> None:
        self.stacks = stacks
        self.construct = construct
        self.failed: Entry | None = None
        self.start_ns: int | None = None
        self._waiting: list[DelayedStart] = []

    def add(self, entry: Entry) -> None:
        """Let an entry wait for what its rule says. Before the first one is constructed."""
        rule = entry.start_after
        assert rule is not None
        later = DelayedStart(self, entry, rule)
        self._waiting.append(later)
        domain, programs = self.stacks.domain, self.stacks.programs
        programs.to_come.append(entry.key)
        if rule.topic is not None:
            domain.watch(rule.topic, lambda publisher, data: later.met("topic"))
        if rule.service is not None or rule.node is not None:
            domain.graph.joined.append(later.joined)
        programs.listeners.append(later.told)

    def add_at(self, entry: Entry, time_ns: int) -> None:
        """Let an entry start at a time, whatever its rule says."""
        later = DelayedStart(self, entry, StartRule())
        self._waiting.append(later)
        self.stacks.programs.to_come.append(entry.key)
        self.stacks.loop.schedule_release(time_ns, _release, later)

    def begin(self, start_ns: int) -> None:
        """Take note that the run begins: times count from here."""
        self.start_ns = start_ns
        for later in self._waiting:
            later.look()

    def gone(self, later: DelayedStart) -> None:
        """Take note that one has started."""
        self._waiting.remove(later)
        self.stacks.programs.to_come.remove(later.entry.key)

    def missed(self) -> Iterator[tuple[str, list[str]]]:
        """Yield the key of each entry that has not started, and what it still waits for."""
        for later in self._waiting:
            yield later.entry.key, list(later.unmet)


class DelayedStart:
    """One entry that waits for its start. The loop dispatches it once, to begin."""

    def __init__(self, starts: EntryStarts, entry: Entry, rule: StartRule) -> None:
        self.entry = entry
        self._starts = starts
        self._rule = rule
        conditions = ("topic", "service", "node", "started", "ended")
        self.unmet = [name for name in conditions if getattr(rule, name) is not None]
        self._cause = (NO_EVENT, 0)
        self._scheduled = False

    def joined(self, member: Any) -> None:
        """Look at what has joined the graph."""
        rule = self._rule
        if isinstance(member, Service) and member.service == rule.service:
            self.met("service")
        elif isinstance(member, Participant) and member.fully_qualified_name == rule.node:
            self.met("node")

    def told(self, condition: str, key: str) -> None:
        """Look at which entry has "started" or "ended"."""
        if key == getattr(self._rule, condition):
            self.met(condition)

    def met(self, condition: str) -> None:
        """Take note that a condition has come true, in the event under way."""
        if condition in self.unmet and self._starts.stacks.loop.stopped is None:
            self.unmet.remove(condition)
            if not self.unmet:
                dispatcher = self._starts.stacks.dispatcher
                position = dispatcher.note(OutputKind.TASK, 0, STARTS, self._rule.delay_ns)
                self._cause = (self._starts.stacks.loop.events, position)
                self.look()

    def look(self) -> None:
        """Let the entry start when its time has come, if nothing else keeps it waiting."""
        loop, start_ns = self._starts.stacks.loop, self._starts.start_ns
        if not self.unmet and not self._scheduled and start_ns is not None:
            self._scheduled = True
            time_ns = max(loop.now_ns, start_ns) + self._rule.delay_ns
            loop.schedule_release(time_ns, _release, self)

    def dispatch(self) -> None:
        self._starts.gone(self)
        if not self._starts.construct(self.entry, self._cause):
            self._starts.failed = self.entry

    def runnable(self) -> Runnable:
        return on_no_executor(None, self.describe())

    def describe(self) -> str:
        return f"the start of {self.entry.name}"


def _release(release: Release) -> DelayedStart:
    later: DelayedStart = release[4]
    return later
