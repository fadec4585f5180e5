"""Executing the selected event again, in a debugging session; no screen is needed for that.

A session stands between events. The selected event is the one that has ended last: to see what it
changed, the session goes before it, looks at its node, lets it run, and looks once more.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from rsltrace.debug.checkpoints import Breakpoint, StopReport
from rsltrace.debug.client import DebugSession
from rsltrace.errors import DebugError, RsltraceError
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace_viewer.model.inspector.message_tree import Line, Role
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.source import CallbackCode
from rsltrace_viewer.model.timeline.events import node_of
from rsltrace_viewer.session import Session

WATCHES_MAX = 8
_ADDRESS = re.compile(r" at 0x[0-9a-f]+(?=>)")
"""Of an object without a text of its own: another one each time that it is made again."""


@dataclass(frozen=True, slots=True)
class Executed:
    """An event that was executed again: the attributes of its node, as Python shows them.

    ``source`` is None for what is no function in Python. ``watched`` are expressions with their
    values, or why they have none. ``wrong`` says in what the run is not the recorded one; then
    there is nothing else.
    """

    index: int
    node: str
    before: dict[str, str]
    after: dict[str, str]
    source: CallbackCode | None
    watched: tuple[tuple[str, str], ...] = ()
    wrong: str = ""

    @property
    def changed(self) -> tuple[str, ...]:
        """The attributes that the event set, changed or removed; none where it ended the node."""
        if not self.after:
            return ()
        names = dict.fromkeys((*self.before, *self.after))
        return tuple(name for name in names if self.before.get(name) != self.after.get(name))


@dataclass(frozen=True, slots=True)
class LiveStop:
    """Where a run has stopped: at ``event``. ``why`` is for people."""

    event: int
    why: str
    breakpoint: Breakpoint | None = None


class Superseded(Exception):
    """Something else was asked for in the meantime."""


class Execution:
    """Drives a debugging session of ``run``'s trace, for one thread at a time."""

    def __init__(self, session: DebugSession, run: Run) -> None:
        self.session = session
        self.watches: list[str] = []
        self._run = run

    def at(self, index: int, wanted: Callable[[], bool]) -> Executed:
        """Execute an event, and stand behind it. ``wanted`` is asked now and then.

        :raises Superseded: it is not wanted any more.
        :raises DebugError, ReplayError: the session is over, or cannot go there.
        """
        name = node_of(self._run, self._run.event(index))
        stopped = self._reach(index, wanted)
        before = self._attributes(name)
        if stopped.reason != "diverged":
            stopped = self._reach(index + 1, wanted)
        if stopped.reason == "diverged":
            return Executed(index, name, {}, {}, None, wrong=stopped.text or "the run diverged")
        return Executed(
            index,
            name,
            before,
            self._attributes(name),
            self._source(),
            tuple((text, self._value(text, name)) for text in self.watches),
        )

    def run_on(self, index: int, wanted: Callable[[], bool]) -> LiveStop:
        """Run on behind an event, to the next at which a breakpoint stops, or to the end.

        :raises Superseded: it is not wanted any more.
        """
        self._reach(index + 1, wanted)
        return self._stop(self.session.go_on())

    def run_back(self, index: int, wanted: Callable[[], bool]) -> LiveStop:
        """Run back to the last event before this one at which a breakpoint stops, or to the first.

        :raises Superseded: it is not wanted any more.
        """
        self._reach(index + 1, wanted)
        while True:
            stop = self._stop(self.session.reverse_go_on())
            if stop.event != index or stop.breakpoint is None:
                return stop
            if not wanted():
                raise Superseded

    def changed_last(self, node: str, attribute: str) -> int:
        """Return the event that changed an attribute last, up to where the session stands."""
        return max(self.session.last_changed(node, attribute).index - 1, 0)

    def true_first(self, condition: str) -> int:
        """Return the event with which a condition became true first."""
        found = self.session.first_true(condition)
        return found.index if found.is_next else max(found.index - 1, 0)

    def _reach(self, index: int, wanted: Callable[[], bool]) -> StopReport:
        while True:
            if not wanted():
                raise Superseded
            stopped = self.session.go_to(index)
            if stopped.reason != "paused":
                return stopped

    def _stop(self, stopped: StopReport) -> LiveStop:
        place = stopped.position
        event = place.index if place.is_next else place.index - 1
        why = {
            "end": "the end of the run",
            "begin": "the start of the run",
            "paused": "stopped",
            "diverged": stopped.text or "the run diverged",
        }.get(stopped.reason, stopped.reason)
        if stopped.breakpoint is not None:
            why = f"breakpoint {stopped.breakpoint.number}: {stopped.breakpoint.text}"
        return LiveStop(min(max(event, 0), max(self._run.count - 1, 0)), why, stopped.breakpoint)

    def _attributes(self, node: str) -> dict[str, str]:
        with suppress(DebugError):  # not constructed yet, or destroyed
            found = self.session.node(node)
            return {name: _ADDRESS.sub("", value) for name, value in found.items()}
        return {}

    def _source(self) -> CallbackCode | None:
        found: dict[str, Any] | None = self.session.inspect("source")
        if not found:
            return None
        lines = tuple(str(line) for line in found["lines"])
        return CallbackCode(found["file"], int(found["line"]), found["name"], lines, at=found["at"])

    def _value(self, expression: str, node: str) -> str:
        for owner in (node, None):
            try:
                return str(self.session.evaluate(expression, owner))
            except RsltraceError as error:
                why = (str(error).splitlines() or [""])[0]
        return why


class LiveSession(Session):
    """A run whose selected event was executed again, or is about to be."""

    executed: Executed | None = None

    @property
    def here(self) -> Executed | None:
        """The selected event, if it has been executed."""
        selected = self.current()
        if self.executed is None or selected is None or self.executed.index != selected[1]:
            return None
        return self.executed

    def lines(self) -> list[Line]:
        """Return the lines of the inspector: what the event did to its node comes first."""
        return [*self._state_lines(), *super().lines()]

    def _state_lines(self) -> Iterator[Line]:
        here = self.here
        if here is None:
            if not self.empty:
                yield Line(0, "", "executing …", Role.NOTE, "live.waits")
            return
        if here.wrong:
            yield Line(0, "", here.wrong, Role.ERROR, "live.wrong")
            return
        for text, value in here.watched:
            yield Line(0, text, f"= {value}", Role.FIELD, f"live.watch.{text}")
        if here.node == RUN_NAME:
            return  # a main has no attributes
        changed = here.changed
        count = len(changed)
        said = f"{count} changed" if count else "unchanged"
        if not here.after:
            said = "destroyed" if here.before else "not there"
        is_open = self.openness.is_open("live", True)
        yield Line(0, f"state of {here.node}", said, Role.SECTION, "live", is_open)
        if not is_open:
            return
        for name in changed:
            yield Line(1, name, _change(here, name), Role.DIFFERENCE, f"live.{name}")
        for name, value in here.after.items():
            if name not in changed:
                yield Line(1, name, value, Role.FIELD, f"live.{name}")


def _change(here: Executed, name: str) -> str:
    if name not in here.before:
        return here.after[name] if not here.before else f"new: {here.after[name]}"
    if name not in here.after:
        return f"{here.before[name]} → gone"
    return f"{here.before[name]} → {here.after[name]}"
