"""Entries that start during the run: after a time, a message, a service, a node, or the start or
end of another entry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.entry import JobEntry, StartRule
from rsltrace.simulation.loop.loop import Release
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.events.event import CurrentEvent, OutsideEvent
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.services import Service
from rsltrace.trace.model.event import NO_EVENT, OutputKind
from rsltrace.trace.model.finding import GuardPolicy


class ConstructionEvent(OutsideEvent):
    """Runs an entry's constructor, main or thread."""

    def __init__(self, describe: Callable[[], str], entry: JobEntry | None) -> None:
        super().__init__(describe)
        self.entry = entry


def policy_of(event: CurrentEvent) -> GuardPolicy | None:
    """Return the guard's policy of the running node or entry; None for the job's policy."""
    if event.node is not None:
        return getattr(event.node, "policy", None)
    entry = entry_of(event)
    return entry.policy if entry is not None else None


def entry_of(event: CurrentEvent) -> JobEntry | None:
    """Return the entry whose constructor runs and has made no node yet."""
    return getattr(event.handle, "entry", None)


STARTS = 4
"""The operation of a TASK output that starts an entry."""

ConstructEntry = Callable[[JobEntry, tuple[int, int]], bool]
"""Constructs an entry, given its causing event and output; returns False if that ended the run."""


class EntryStarts:
    """The entries that wait for their start; ``failed`` is one whose construction ended the run."""

    def __init__(self, runtime: Runtime, construct: ConstructEntry) -> None:
        self.runtime = runtime
        self.construct = construct
        self.failed: JobEntry | None = None
        self.start_ns: int | None = None
        self._waiting: list[DelayedStart] = []

    def add(self, entry: JobEntry) -> None:
        """Register an entry with a start rule. Call it before the first construction."""
        rule = entry.start_after
        assert rule is not None
        later = DelayedStart(self, entry, rule)
        self._waiting.append(later)
        domain, programs = self.runtime.domain, self.runtime.programs
        programs.to_come.append(entry.key)
        if rule.topic is not None:
            domain.watch(rule.topic, lambda publisher, data: later.met("topic"))
        if rule.service is not None or rule.node is not None:
            domain.graph.joined.append(later.joined)
        programs.listeners.append(later.entry_changed)

    def add_at(self, entry: JobEntry, time_ns: int) -> None:
        """Start an entry at a time, whatever its rule says."""
        later = DelayedStart(self, entry, StartRule(), is_scheduled=True)
        self._waiting.append(later)
        self.runtime.programs.to_come.append(entry.key)
        self.runtime.loop.schedule_release(time_ns, _release, later)

    def begin(self, start_ns: int) -> None:
        """Begin the run: delays count from here."""
        self.start_ns = start_ns
        for later in self._waiting:
            later.schedule_if_met()

    def remove_started(self, later: DelayedStart) -> None:
        self._waiting.remove(later)
        self.runtime.programs.to_come.remove(later.entry.key)

    def missed(self) -> Iterator[tuple[str, list[str]]]:
        """Yield the key of each entry that has not started, and its unmet conditions."""
        for later in self._waiting:
            yield later.entry.key, list(later.unmet)


class DelayedStart:
    """An entry that waits for its start; the loop dispatches it once."""

    def __init__(
        self, starts: EntryStarts, entry: JobEntry, rule: StartRule, *, is_scheduled: bool = False
    ) -> None:
        self.entry = entry
        self._starts = starts
        self._rule = rule
        conditions = ("topic", "service", "node", "started", "ended")
        self.unmet = [name for name in conditions if getattr(rule, name) is not None]
        self._cause = (NO_EVENT, 0)
        self._scheduled = is_scheduled

    def joined(self, member: Any) -> None:
        """Check a service or node that joined the graph."""
        rule = self._rule
        if isinstance(member, Service) and member.service == rule.service:
            self.met("service")
        elif isinstance(member, Participant) and member.fully_qualified_name == rule.node:
            self.met("node")

    def entry_changed(self, condition: str, key: str) -> None:
        """Check the start or end of another entry."""
        if key == getattr(self._rule, condition):
            self.met(condition)

    def met(self, condition: str) -> None:
        """Note that a condition was met in the current event."""
        if condition in self.unmet and self._starts.runtime.loop.stopped is None:
            self.unmet.remove(condition)
            if not self.unmet:
                dispatcher = self._starts.runtime.dispatcher
                position = dispatcher.note(OutputKind.TASK, 0, STARTS, self._rule.delay_ns)
                self._cause = (self._starts.runtime.loop.events, position)
                self.schedule_if_met()

    def schedule_if_met(self) -> None:
        loop, start_ns = self._starts.runtime.loop, self._starts.start_ns
        if not self.unmet and not self._scheduled and start_ns is not None:
            self._scheduled = True
            time_ns = max(loop.now_ns, start_ns) + self._rule.delay_ns
            loop.schedule_release(time_ns, _release, self)

    def dispatch(self) -> None:
        self._starts.remove_started(self)
        if not self._starts.construct(self.entry, self._cause):
            self._starts.failed = self.entry

    def runnable(self) -> Runnable:
        return on_no_executor(None, self.describe())

    def describe(self) -> str:
        return f"the start of {self.entry.name}"


def _release(release: Release) -> DelayedStart:
    later: DelayedStart = release[4]
    return later
