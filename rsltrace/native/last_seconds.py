"""A native run of which only the last seconds are kept, until something says to write them down."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from typing import Protocol

from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class
from rsltrace.checks.conditions.names import topic_of, with_topic_prefix
from rsltrace.checks.conditions.view import SentOutput
from rsltrace.checks.evaluate import property_of, title
from rsltrace.errors import RsltraceError
from rsltrace.job import Job
from rsltrace.job.parts.check import CheckSpec
from rsltrace.job.parts.record import LastSpec
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    EmittedLog,
    SentMessage,
    now_ns,
)
from rsltrace.native.span_writer import SpanSource
from rsltrace.simulation.middleware.events.failure import as_printed
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.native import CUT_AFTER_NS

_SETTLED_NS = 200_000_000
"""How long after its reason a file is written: it has what came of it, and one message that several
processes see is one reason."""
_NOTED_NS = 10_000_000
"""A program has noted what it does after so long."""
_SPAN_SIZE, _OUTPUT_SIZE = 600, 400
"""About what they need in memory, in bytes."""


# Checks of the job while the run goes on.


def _read_by(spec: CheckSpec) -> tuple[set[str], str]:
    """Return the topics that a check is about, and why it cannot be judged before the end."""
    if spec.latency is not None or spec.function is not None:
        return set(), "it is about the whole run"
    if spec.eventually is not None and spec.within_ns is None:
        return set(), "it has no 'within'"
    topics = set() if spec.rate is None else {spec.rate}
    for text in filter(None, (spec.always, spec.never, spec.eventually, spec.after)):
        topic, kind = topic_of(with_topic_prefix(text)), text.split()[0]
        if topic is not None:
            topics.add(topic)
        elif kind not in ("log", "exception") or " if " in text:
            return set(), "it is not about messages of one topic, log records or exceptions"
        elif kind == "log":
            topics.add(TOPIC_ROSOUT)
    return topics, ""


def checked_topics(job: Job) -> set[str]:
    """Return the topics and services whose messages are needed while the run goes on."""
    return {topic for spec in job.checks for topic in _read_by(spec)[0]}


class _UnreadableError(RsltraceError):
    """There is a message, but not its content."""


class _SpanView:
    """A span as the conditions of checks see it (``EventView``)."""

    index = -1
    output_hash = entity = 0
    entity_name = node = ""

    def __init__(self, span: CallbackSpan, stamp_ns: int, start_ns: int) -> None:
        self.kind, self.stamp_ns, self.start_ns = span.kind, stamp_ns, start_ns
        self._outputs = [*_sent(span)]

    def nodes(self) -> Mapping[str, object]:
        return {}

    def received(self) -> tuple[str, object] | None:
        return None

    def sent(self) -> Sequence[SentOutput]:
        return self._outputs

    def findings(self) -> Sequence[str]:
        return ()


def _sent(span: CallbackSpan) -> Iterator[SentOutput]:
    for one in span.outputs:
        if isinstance(one, SentMessage):
            read = partial(_message, one, one.data)  # the data may be dropped later
            yield SentOutput(one.kind, one.entity.name, one.digest, message=read)
        elif isinstance(one, EmittedLog):
            yield SentOutput(int(OutputKind.LOG), TOPIC_ROSOUT, 0, one.text, one.severity)
        elif isinstance(one, CallbackError):
            yield SentOutput(int(OutputKind.EXCEPTION), "", 0, as_printed(one.kind, one.said))


def _message(sent: SentMessage, data: bytes) -> object:
    entity = sent.entity
    if not data or entity.sends is None:
        raise _UnreadableError(f"a message on {entity.name} is too large, or of an unknown type")
    try:
        return codec_for(get_message_class(entity.sends.name)).deserialize(data)
    except ValueError as error:
        raise _UnreadableError(f"a message on {entity.name} cannot be read: {error}") from error


class LiveChecks:
    """The checks of a job that can be held against what is observed while the run goes on.

    ``violated`` is told what is wrong, with the check that says so; ``lacks`` why one cannot be
    judged. ``later`` are those for the end of the run, and why.
    """

    def __init__(
        self,
        job: Job,
        stamp: Callable[[int], int],
        violated: Callable[[str, str], None],
        lacks: Callable[[str], None],
    ) -> None:
        self._stamp = stamp
        self._start_ns = stamp(now_ns())
        self._violated = violated
        self._lacks = lacks
        whys = [_read_by(spec)[1] for spec in job.checks]
        self.later = [
            f"{title(spec)}: {why}" for spec, why in zip(job.checks, whys, strict=True) if why
        ]
        self._properties = {
            title(spec): one
            for index, (spec, why) in enumerate(zip(job.checks, whys, strict=True))
            if not why and (one := property_of(job, index, self._start_ns)) is not None
        }
        self._waiting: list[tuple[int, _SpanView]] = []
        self.failed: Counter[str] = Counter()
        """How often which check has failed."""

    def add(self, spans: Iterable[CallbackSpan]) -> None:
        """Take spans, as long as they have the messages."""
        if self._properties:
            for span in spans:
                stamp_ns = self._stamp(span.start_ns)
                self._waiting.append((stamp_ns, _SpanView(span, stamp_ns, self._start_ns)))

    def look(self, until_ns: int) -> None:
        """Judge what happened up to a time, before which nothing more comes."""
        until_ns = self._stamp(until_ns)
        self._waiting.sort(key=lambda one: one[0])
        count = sum(stamp_ns < until_ns for stamp_ns, _ in self._waiting)
        due, self._waiting = self._waiting[:count], self._waiting[count:]
        for name, one in list(self._properties.items()):
            try:
                for _, view in due:
                    one.see(view)
                one.advance(until_ns - 1)
            except RsltraceError as error:
                del self._properties[name]
                self._lacks(f"check {name} is not judged any more: {error}")
            if one.found:
                self._violated(name, f"check {name}: {one.found[0].text}")
                self.failed[name] += one.count
                one.count = 0
                one.found.clear()


class Programs(Protocol):
    """What keeps its last seconds itself, in memory of its processes."""

    def look_at_programs(self, since_ns: int) -> Iterable[tuple[int, str]]:
        """Look what has happened; return times and reasons to write a file. What ended before
        ``since_ns`` is forgotten."""

    def checked(self) -> list[CallbackSpan]:
        """Return what is new of what checks are about."""

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
        self._lock = threading.RLock()  # a signal may come in the middle of one
        self._reasons: dict[str, str] = {}
        """Why to write a file: by kinds, the first of each."""
        self.checks: LiveChecks | None = None
        self._due_ns = 0
        self._written_ns = 0
        self.ended_ns = 0
        """When the run was told to end, 0 before that: the last seconds are those up to then."""
        self.span_ns = (0, 0)
        """From when to when the file that was written last has all."""
        self.missing: list[str] = []
        """What the file that was written last lacks."""

    @property
    def until_ns(self) -> int:
        """Up to when it has all (``SpanSource``)."""
        return self._source.until_ns

    @property
    def since_ns(self) -> int:
        """Since when all is kept."""
        return (self.ended_ns or now_ns()) - self._spec.duration_ns

    def trigger(
        self, reason: str, at_ns: int | None = None, *, at_once: bool = False, kind: str = ""
    ) -> None:
        """Have a file written, from any thread; it names the first reason of a ``kind``. Unless
        ``at_once``, it goes on where the last one ends, so that reasons that come again and again
        give no more than all of the run."""
        at_ns = now_ns() if at_ns is None else at_ns
        with self._lock:
            if at_ns <= self._written_ns:
                return
            due_ns = at_ns + _SETTLED_NS
            if self._written_ns and not at_once:
                due_ns = max(due_ns, self._written_ns + self._spec.duration_ns)
            self._due_ns = min(self._due_ns, due_ns) if self._reasons else due_ns
            self._reasons.setdefault(kind or reason, reason)

    def look(self) -> None:
        """Take what is new, drop what is old, and write a file if it is time."""
        until_ns = now_ns() - _NOTED_NS
        self._take(CUT_AFTER_NS)
        if self._programs is not None:
            for at_ns, reason in self._programs.look_at_programs(self.since_ns):
                self.trigger(reason, at_ns)
            if self.checks is not None:
                self.checks.add(self._programs.checked())
        if self.checks is not None:
            self.checks.look(min(until_ns, self.until_ns))
        with self._lock:
            if not self._reasons or now_ns() < self._due_ns:
                return
            reasons, self._reasons = self._reasons, {}
            self._written_ns = now_ns()
        self._keep(", ".join(reasons.values()))

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        """Return what is kept now, everything at the end of the run (None)."""
        self._take(patience_ns)
        since_ns = self.since_ns
        self.span_ns = since_ns, now_ns()
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
        spans = self._source.finished(patience_ns)
        if self.checks is not None:
            self.checks.add(spans)
        for span in spans:
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
