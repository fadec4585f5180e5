"""A native run of which only the last seconds are kept, until something says to write them down."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from typing import Protocol

from rsltrace.job.parts.record import LastSpec
from rsltrace.native.span_recorder import CallbackError, CallbackSpan, SentMessage, now_ns
from rsltrace.native.span_writer import SpanSource
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.native import CUT_AFTER_NS

_SETTLED_NS = 200_000_000
"""How long after its reason a file is written: it has what came of it, and one message that several
processes see is one reason."""
_SPAN_SIZE, _OUTPUT_SIZE = 600, 400
"""About what they need in memory, in bytes."""


class Programs(Protocol):
    """What keeps its last seconds itself, in memory of its processes."""

    def look_at_programs(self, since_ns: int) -> Iterable[tuple[int, str]]:
        """Look what has happened; return times and reasons to write a file. What ended before
        ``since_ns`` is forgotten."""

    def last_of_programs(self, since_ns: int) -> tuple[list[CallbackSpan], list[str]]:
        """Return the spans that are kept, and in words what is missing from then on."""


class LastSeconds:
    """The last spans of a source and of programs.

    ``keep`` writes a file: it is given why, and asks ``finished`` for the spans.
    """

    def __init__(
        self,
        spec: LastSpec,
        source: SpanSource,
        programs: Programs | None,
        keeps_payload: Callable[[str], bool],
        keep: Callable[[str], None],
    ) -> None:
        self._spec = spec
        self._source = source
        self._programs = programs
        self._keeps_payload = keeps_payload
        self._keep = keep
        self._spans: deque[tuple[CallbackSpan, int]] = deque()
        self._size = 0
        self._dropped_ns = 0
        self._made: list[Entity] = []
        """The entities of spans that are kept no more."""
        self._lock = threading.Lock()
        self._reasons: list[str] = []
        self._due_ns = 0
        self._written_ns = 0
        self.ended_ns = 0
        """When the run was told to end, 0 before that: the last seconds are those up to then."""
        self.missing: list[str] = []
        """What the file that was written last lacks."""

    @property
    def since_ns(self) -> int:
        """Since when all is kept."""
        return (self.ended_ns or now_ns()) - self._spec.duration_ns

    def trigger(self, reason: str, at_ns: int | None = None, *, at_once: bool = False) -> None:
        """Have a file written, from any thread. Unless ``at_once``, it goes on where the last one
        ends, so that reasons that come again and again give no more than all of the run."""
        at_ns = now_ns() if at_ns is None else at_ns
        with self._lock:
            if at_ns <= self._written_ns:
                return
            due_ns = at_ns + _SETTLED_NS
            if self._written_ns and not at_once:
                due_ns = max(due_ns, self._written_ns + self._spec.duration_ns)
            self._due_ns = min(self._due_ns, due_ns) if self._reasons else due_ns
            self._reasons.append(reason)

    def look(self) -> None:
        """Take what is new, drop what is old, and write a file if it is time."""
        self._take(CUT_AFTER_NS)
        if self._programs is not None:
            for at_ns, reason in self._programs.look_at_programs(self.since_ns):
                self.trigger(reason, at_ns)
        with self._lock:
            if not self._reasons or now_ns() < self._due_ns:
                return
            reasons, self._reasons = self._reasons, []
            self._written_ns = now_ns()
        self._keep(", ".join(dict.fromkeys(reasons)))

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        """Return what is kept now, everything at the end of the run (None)."""
        self._take(patience_ns)
        since_ns = self.since_ns
        spans = [span for span, _ in self._spans]
        self.missing = []
        if self._dropped_ns > since_ns:
            self.missing.append("of Python nodes, what was before: the memory was full")
        if self._programs is not None:
            found, missing = self._programs.last_of_programs(since_ns)
            spans = sorted([*spans, *found], key=lambda span: span.start_ns)
            self.missing += missing
        at = sum(span.start_ns < since_ns for span in spans)
        made = [*self._made, *_entities(spans[:at])]
        kept = spans[at:]
        for span in spans:
            span.index = -1
        if not made:
            return kept
        first = kept[0] if kept else None
        start_ns, wall_ns = (now_ns(), 0) if first is None else (first.start_ns, first.wall_ns)
        before = CallbackSpan(int(EventKind.OUTSIDE), None, start_ns, wall_ns, 0, None)
        before.end_ns, before.outputs = start_ns, list(made)
        return [before, *kept]

    def _take(self, patience_ns: int | None) -> None:
        for span in self._source.finished(patience_ns):
            size = _SPAN_SIZE
            for output in span.outputs:
                size += _OUTPUT_SIZE
                if isinstance(output, SentMessage):
                    self._look_at(output)
                    size += len(output.data)
                elif isinstance(output, CallbackError):
                    self.trigger(f"{output.kind} in a callback", span.end_ns)
            if span.taken is not None and self._is_reason(span.taken.entity.name):
                self.trigger(f"a message on {span.taken.entity.name}", span.start_ns)
            self._spans.append((span, size))
            self._size += size
        since_ns = self.since_ns
        while self._spans:
            span, size = self._spans[0]
            if span.start_ns >= since_ns and self._size <= self._spec.memory:
                break
            self._spans.popleft()
            self._size -= size
            self._dropped_ns = span.start_ns
            self._made += _entities([span])
            span.index = -1

    def _look_at(self, sent: SentMessage) -> None:
        name = sent.entity.name
        if sent.kind != OutputKind.RESPONSE and self._is_reason(name):
            self.trigger(f"a message on {name}")
        if len(sent.data) > self._spec.largest or not self._keeps_payload(name):
            sent.data = b""

    def _is_reason(self, name: str) -> bool:
        return any(fnmatchcase(name, glob) for glob in self._spec.keep_on)


def _entities(spans: Iterable[CallbackSpan]) -> list[Entity]:
    return [one for span in spans for one in span.outputs if isinstance(one, Entity)]
