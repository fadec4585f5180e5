"""What is held against one event after the other: always, never, eventually, and rates."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from rsltrace.checks.conditions.condition import ActiveCondition, error_text, shown
from rsltrace.checks.conditions.expressions import Expression
from rsltrace.checks.conditions.view import EventView
from rsltrace.errors import RsltraceError
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import NS_PER_S, format_duration, format_seconds

_SHOWN_MAX = 3
KEPT_MAX = 1000
"""So many violations of one check are kept; of the rest only the number."""


@dataclass(frozen=True, slots=True)
class Violation:
    """Where a check fails: an event (None: at a time, as that of the end), its time in ns, and what
    is wrong there."""

    event: int | None
    stamp_ns: int
    text: str


@dataclass
class RunProperty(ABC):
    """A property of a run; it gets the events in order. ``count`` is how often it is violated,
    ``undecided`` how often the run ended before that could be said."""

    found: list[Violation] = field(default_factory=list, init=False)
    count: int = field(default=0, init=False)
    undecided: int = field(default=0, init=False)
    note: str = field(default="", init=False)

    @abstractmethod
    def see(self, event: EventView) -> None:
        """Take note of an event that has ended."""

    @abstractmethod
    def advance(self, now_ns: int) -> None:
        """Judge what can be judged at a time, up to which all events have come."""

    @abstractmethod
    def end(self, stamp_ns: int, *, complete: bool) -> None:
        """Take note of the end of the run; not ``complete``: of what there is of it."""

    def _violated(self, event: int | None, stamp_ns: int, text: str) -> None:
        self.count += 1
        if len(self.found) < KEPT_MAX:
            self.found.append(Violation(event, stamp_ns, text))


@dataclass
class NeverProperty(RunProperty):
    """Something that must not happen; with ``after``, not from then on (for ``within_ns``)."""

    what: ActiveCondition
    after: ActiveCondition | None = None
    within_ns: int | None = None
    start_ns: int = 0
    says: str = ""
    """What is wrong, where the condition's own words do not say it."""
    topic: str | None = None
    value: Expression | None = None
    """What is compared, of messages on ``topic``: its value is shown."""

    def __post_init__(self) -> None:
        self._since: tuple[int, int] | None = None
        if self.after is None:
            self._since = (-1, self.start_ns)

    def see(self, event: EventView) -> None:
        """See whether it happens, while it counts."""
        if self._counts(event) and (why := self.what.after(event)):
            since = ""
            if self._since is not None and self._since[0] >= 0:
                since = f", after event {self._since[0]}"
            said = f"{self.says or why}{self._values(event)}{since}"
            self._violated(event.index, event.stamp_ns, said)
        self.note = self.what.note or self.note
        if self.after is not None and self.after.after(event):
            self._since = (event.index, event.stamp_ns)

    def advance(self, now_ns: int) -> None:
        """Nothing: an event is judged at once."""

    def end(self, stamp_ns: int, *, complete: bool) -> None:
        """Nothing: what has not happened by then has not happened."""

    def _values(self, event: EventView) -> str:
        """Return what was compared, of the messages that the event has sent: `` (x = 0.31)``."""
        if self.value is None or self.count >= KEPT_MAX:
            return ""
        values = []
        for sent in event.sent():
            if sent.name == self.topic and sent.message is not None:
                try:
                    values.append(shown(self.value.value(event, message=sent.message())))
                except RsltraceError:
                    raise
                except Exception as error:  # of this message; another one may be what is wrong
                    values.append(error_text(error))
        named = self.value.text.removeprefix("msg.")
        return f" ({named} = {', '.join(values[:_SHOWN_MAX])})" if values else ""

    def _counts(self, event: EventView) -> bool:
        if self._since is None:
            return False
        return self.within_ns is None or event.stamp_ns <= self._since[1] + self.within_ns


@dataclass
class EventuallyProperty(RunProperty):
    """Something that has to happen: once, or each time that ``after`` has."""

    what: ActiveCondition
    after: ActiveCondition | None = None
    within_ns: int | None = None
    start_ns: int = 0

    def __post_init__(self) -> None:
        self._waiting: deque[tuple[int | None, int]] = deque()
        if self.after is None:
            self._waiting.append((None, self.start_ns))

    def see(self, event: EventView) -> None:
        """See what is too late, what happens, and what has to happen from now on."""
        self.advance(event.stamp_ns - 1)
        if self.after is not None and self.after.after(event):
            self._waiting.append((event.index, event.stamp_ns))
        if self._waiting and self.what.after(event):
            self._waiting.clear()
        self.note = self.what.note or self.note

    def end(self, stamp_ns: int, *, complete: bool) -> None:
        """See what is too late, and what had no time left."""
        self.advance(stamp_ns if complete else stamp_ns - 1)
        for index, begin_ns in self._waiting:
            if complete and self.within_ns is None:
                self._missed(index, begin_ns, stamp_ns, "before the end of the run")
            else:
                self.undecided += 1

    def advance(self, now_ns: int) -> None:
        """Give up what should have happened by ``now_ns``."""
        if self.within_ns is None:
            return
        while self._waiting and self._waiting[0][1] + self.within_ns <= now_ns:
            index, begin_ns = self._waiting.popleft()
            end_ns = begin_ns + self.within_ns
            self._missed(index, begin_ns, end_ns, f"within {format_duration(self.within_ns)}")

    def _missed(self, index: int | None, begin_ns: int, end_ns: int, when: str) -> None:
        since = "" if index is None or index < 0 else f" of event {index}"
        at_ns = end_ns if index is None else begin_ns
        self._violated(index, at_ns, f"it does not happen {when}{since}")


@dataclass
class RateProperty(RunProperty):
    """A topic whose messages come at least, or at most, so often in every stretch of time."""

    topic: str
    at_least: float | None
    at_most: float | None
    over_ns: int = NS_PER_S
    start_ns: int = 0

    def __post_init__(self) -> None:
        self._sent: list[tuple[int, int]] = []
        self._has_judged = False

    def see(self, event: EventView) -> None:
        for sent in event.sent():
            if sent.kind == OutputKind.MESSAGE and sent.name == self.topic:
                self._sent.append((event.stamp_ns, event.index))

    def end(self, stamp_ns: int, *, complete: bool) -> None:
        """Count, in the stretches that begin right after each message."""
        if not (self._sent or self._has_judged):
            self._silent(stamp_ns, complete=complete)
            return
        self.advance(stamp_ns)
        if not self._has_judged:
            self.undecided += 1
            self.note = f"less than {format_duration(self.over_ns)} is left after its first message"

    def advance(self, now_ns: int) -> None:
        """Judge the stretches that have ended, and forget them."""
        stretches = 0
        for begin_ns, index, count in self._stretches(now_ns):
            stretches += 1
            hz = count * NS_PER_S / self.over_ns
            until = format_seconds(begin_ns + self.over_ns - self.start_ns)
            said = f"{count} messages from here to {until} s: {hz:g} Hz"
            if self.at_least is not None and count < self._least:
                self._violated(index, begin_ns, f"{said}, at least {self.at_least:g} Hz")
            elif self.at_most is not None and count > self._most:
                self._violated(index, begin_ns, f"{said}, at most {self.at_most:g} Hz")
        self._has_judged |= stretches > 0
        del self._sent[:stretches]

    def _silent(self, stamp_ns: int, *, complete: bool) -> None:
        """A topic without a message is too slow, once there was time for one."""
        if complete and self.at_least is not None and stamp_ns - self.start_ns >= self.over_ns:
            said = f"there is no message: 0 Hz, at least {self.at_least:g} Hz"
            self._violated(None, stamp_ns, said)
        elif self.at_least is not None:
            self.undecided += 1
            self.note = "there is no message"

    @property
    def _least(self) -> float:
        return math.ceil((self.at_least or 0) * self.over_ns / NS_PER_S - 1e-9)

    @property
    def _most(self) -> float:
        return math.floor((self.at_most or 0) * self.over_ns / NS_PER_S + 1e-9)

    def _stretches(self, end_ns: int) -> Iterator[tuple[int, int, int]]:
        """Yield begin, first event and number of messages of each whole stretch: those after its
        begin, up to and with its end."""
        last = 0
        for at, (begin_ns, index) in enumerate(self._sent):
            if begin_ns + self.over_ns > end_ns:
                return
            last = max(last, at)
            while last + 1 < len(self._sent) and self._sent[last + 1][0] <= begin_ns + self.over_ns:
                last += 1
            yield begin_ns, index, last - at
