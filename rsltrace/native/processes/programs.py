"""Programs in C and C++ under observation: what their library has noted becomes spans.

The library (``adapters/processes/observer``) writes the records that ``record_file`` reads.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, count
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rsltrace.adapters.processes.wire import RecordReader
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class, message_type
from rsltrace.errors import SetupError
from rsltrace.job import Job
from rsltrace.native.last_seconds import checked_topics
from rsltrace.native.message_observer import channel_of
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.processes.record_file import ENDPOINTS, Record, RecordFile, RecordKind
from rsltrace.native.span_recorder import (
    CallbackSpan,
    EmittedLog,
    ReceivedInput,
    SentMessage,
    SpanRecorder,
    now_ns,
)
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.simulation.middleware.participant import full_name
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.native import CUT_AFTER_NS

FOLDER = "RSLTRACE_OBSERVER"
"""The variable that tells the library where its file goes."""
_SETTINGS = "RSLTRACE_OBSERVER_SETTINGS"
_MEMORY = 32 << 20
"""How much room a process has for what is read all the time."""


def variables_of(job: Job, folder: Path) -> dict[str, str]:
    """Return what a program's library has to know (``Settings`` in observer.cpp)."""
    record, last = job.record, job.record.last
    sizes = (_MEMORY, 0, _MEMORY) if last is None else (last.memory, 1, last.largest)
    kept = record.topics if record.payloads else ()
    lists = [("+", kept), ("-", record.exclude)]
    if last is not None:
        lists += [("!", last.keep_on), ("?", tuple(checked_topics(job)))]
    names = (f"{mark}{name}" for mark, globs in lists for name in globs)
    return {FOLDER: str(folder), _SETTINGS: "\n".join((" ".join(map(str, sizes)), *names))}


_EVENTS = {
    EntityKind.SUBSCRIPTION: EventKind.SUBSCRIPTION,
    EntityKind.SERVICE: EventKind.SERVICE,
    EntityKind.CLIENT: EventKind.CLIENT,
    EntityKind.TIMER: EventKind.TIMER,
}
_TAKES = {
    EntityKind.SUBSCRIPTION: OutputKind.MESSAGE,
    EntityKind.SERVICE: OutputKind.REQUEST,
    EntityKind.CLIENT: OutputKind.RESPONSE,
}
_SENDS = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_ACTION = "/_action/"
_GID_SIZE = 16
_TIMER = struct.Struct("<Iq")
_POINTER = struct.Struct("<Q")
_TAKEN = struct.Struct(f"<IQqq{_GID_SIZE}sIQ")
_CALLED = struct.Struct("<Iq")
_SENDING = struct.Struct("<IIqIQ")
_SENT = struct.Struct("<Iq")
_GID = struct.Struct(f"{_GID_SIZE}s")
_NO_NUMBER = 2**64 - 1


@dataclass(slots=True)
class _Frame:
    """A callback that is known by what it took. It ends where its thread takes the next one or
    waits, unless tracetools say where it began (``callback``) and ended: a service responds after
    that."""

    entity: ObservedEntity
    callback: int | None = None
    ended_ns: int = 0


@dataclass(slots=True)
class _Thread:
    """What runs in a thread, and what it is sending."""

    local: SimpleNamespace
    frames: list[_Frame] = field(default_factory=list)
    sending: tuple[CallbackSpan, SentMessage, int] | None = None


class _RecordedSpans(SpanRecorder):
    """A span recorder that lives in the time of records, and in their threads."""

    def __init__(self) -> None:
        super().__init__()
        self.steady_ns = self.wall_ns = 0

    def now_ns(self) -> int:
        return self.steady_ns

    def time_ns(self) -> int:
        return self.wall_ns

    def enter(self, local: SimpleNamespace) -> None:
        """Let what follows be of a thread."""
        self._local = local  # type: ignore[assignment]


class ProgramSpans:
    """Makes spans of the records of one process."""

    def __init__(self, name: str, process: int, ids: count[int], threads: count[int]) -> None:
        """``process`` is its number, which its main thread has, too; ``ids`` and ``threads`` give
        the next numbers of the run."""
        self._name = name
        self._process = process
        self._thread_numbers = threads
        self.recorder = _RecordedSpans()
        self._made = ObservedEntities(self._tell, ids)
        self._places: dict[int, tuple[CallbackSpan, int]] = {}
        self._entities: dict[int, ObservedEntity] = {}
        self._threads: dict[int, _Thread] = {}
        self._callbacks: dict[int, ObservedEntity] = {}
        self._called: dict[int, ReceivedInput | None] = {}
        """The calls of timers whose callbacks say themselves when they begin."""
        self._last_node: ObservedEntity | None = None
        self._timers = 0
        self.unreadable = 0
        self._log_type = get_message_class("rcl_interfaces/msg/Log")

    def add(self, record: Record) -> None:
        """Take note of a record."""
        thread = self._enter(record)
        fields = record.fields
        if record.kind == RecordKind.NODE:
            self._node(fields)
        elif record.kind in ENDPOINTS:
            self._end_of(ENDPOINTS[RecordKind(record.kind)], fields)
        elif record.kind == RecordKind.TIMER:
            self._timer(fields)
        elif record.kind == RecordKind.TIMER_OF:
            self._timer_of(fields.number(), fields.number())
        elif record.kind == RecordKind.CALLBACK:
            (callback,) = fields.unpack(_POINTER)
            if (entity := self._entities.get(fields.number())) is not None:
                self._callbacks[callback] = entity
                self._called[entity.id] = None
        elif record.kind == RecordKind.NAME:
            (callback,) = fields.unpack(_POINTER)
            self._named(callback, fields.text())
        elif record.kind == RecordKind.TAKE:
            self._take(thread, record)
        elif record.kind == RecordKind.CALL:
            self._call(thread, record)
        elif record.kind == RecordKind.BEGIN:
            self._begun(thread, *fields.unpack(_POINTER))
        elif record.kind == RecordKind.END:
            self._ended(thread, record, *fields.unpack(_POINTER))
        elif record.kind == RecordKind.WAIT:
            self._close(thread)
            self.recorder.pause()
        elif record.kind == RecordKind.SENDING:
            self._sending(thread, record)
        elif record.kind == RecordKind.SENT:
            self._sent(thread, *fields.unpack(_SENT))
        elif record.kind == RecordKind.LOST:
            self._missing()

    def finished(self, until_ns: int, patience_ns: int | None) -> tuple[list[CallbackSpan], int]:
        """Return what is over, and up to when that is all; the records end at ``until_ns``."""
        self.recorder.steady_ns = max(until_ns, self.recorder.steady_ns)
        if patience_ns is None:  # the process is no more: what it was sending may have left
            for thread in self._threads.values():
                self.recorder.enter(thread.local)
                if thread.sending is not None:
                    self._sent(thread, 1, thread.sending[1].sequence)
                while thread.frames and thread.frames[-1].ended_ns:
                    self._pop(thread)
        return self.recorder.finished_until(patience_ns)

    def _enter(self, record: Record) -> _Thread:
        recorder = self.recorder
        recorder.steady_ns = record.steady_ns
        recorder.wall_ns = record.wall_ns
        thread = self._threads.get(record.thread)
        if thread is None:
            local = SimpleNamespace(stack=[], thread=next(self._thread_numbers))
            thread = self._threads[record.thread] = _Thread(local)
            recorder.enter(local)
            if record.thread == self._process:
                self._main()
        recorder.enter(thread.local)
        return thread

    def _main(self) -> None:
        running = self.recorder.begin(int(EventKind.CONSTRUCT), None)
        running.entity = self._made.add((), None, EntityKind.MAIN, self._name)
        assert running.span is not None
        running.span.entity = running.entity

    # -- entities -------------------------------------------------------------------------------

    def _tell(self, entity: Entity) -> None:
        self._places[entity.id] = self.recorder.add(entity)

    def _node(self, fields: RecordReader) -> None:
        number, name, namespace = fields.number(), fields.text(), fields.text()
        node = self._made.add((), None, EntityKind.NODE, full_name(namespace, name))
        self._entities[number] = self._last_node = node

    def _end_of(self, kind: EntityKind, fields: RecordReader) -> None:
        number, node = fields.number(), self._entities.get(fields.number())
        name, type_name, qos = fields.text(), fields.text(), fields.qos()
        detail: dict[str, object] = {"action": name.partition(_ACTION)[0]}
        if _ACTION not in name:
            detail = {}
        if kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION):
            detail["qos"] = qos.summary()
        entity = self._made.add((), node, kind, name, type_name, **detail)
        self._entities[number] = entity
        parts = {EntityKind.SERVICE: "_Response", EntityKind.CLIENT: "_Request"}
        if kind is not EntityKind.SUBSCRIPTION and type_name:
            entity.sends_type, entity.sends = _type(type_name + parts.get(kind, ""))
        if kind is EntityKind.PUBLISHER:
            entity.qos_yaml = qos.to_yaml()
            (entity.gid,) = fields.unpack(_GID)
        elif kind is EntityKind.SUBSCRIPTION and type_name:
            entity.takes_type, _ = _type(type_name)

    def _timer(self, fields: RecordReader) -> None:
        number, period_ns = fields.unpack(_TIMER)
        self._timers += 1
        entity = self._made.add(
            (), self._last_node, EntityKind.TIMER, f"timer {self._timers}", period_ns=period_ns
        )
        self._entities[number] = entity

    def _timer_of(self, timer: int, node: int) -> None:
        if timer in self._entities and node in self._entities:
            entity = self._entities[timer]
            entity.node = self._entities[node].id
            self._change(entity, lambda known: replace(known, node=entity.node))

    def _named(self, callback: int, name: str) -> None:
        entity = self._callbacks.get(callback)
        if entity is None:
            return
        if entity.kind is EntityKind.TIMER:
            entity.name = name
            self._change(entity, lambda known: replace(known, name=name))
        else:
            self._change(
                entity, lambda known: replace(known, detail={**known.detail, "callback": name})
            )

    def _change(self, entity: ObservedEntity, change: Callable[[Entity], Entity]) -> None:
        span, place = self._places[entity.id]
        known = span.outputs[place]
        assert isinstance(known, Entity)
        span.outputs[place] = change(known)

    # -- callbacks ------------------------------------------------------------------------------

    def _take(self, thread: _Thread, record: Record) -> None:
        number, sequence, source_ns, ready_ns, gid, is_raw, digest = record.fields.unpack(_TAKEN)
        entity = self._entities.get(number)
        if entity is None:
            return
        _, digest = self._content(record.fields, entity.takes_type if is_raw else None, digest)
        taken = ReceivedInput(
            entity,
            digest,
            digest,
            channel_of(int(_TAKES[entity.kind]), entity.name),
            0 if sequence == _NO_NUMBER else sequence,
            source_ns,
            ready_ns,
            record.spent_ns,
            gid if any(gid) else b"",
        )
        self._begin(thread, entity, taken)

    def _call(self, thread: _Thread, record: Record) -> None:
        number, due_ns = record.fields.unpack(_CALLED)
        if (entity := self._entities.get(number)) is not None:
            taken = ReceivedInput(entity, ready_ns=due_ns, observer_ns=record.spent_ns)
            if entity.id in self._called:
                self._called[entity.id] = taken
            else:
                self._begin(thread, entity, taken)

    def _begin(self, thread: _Thread, entity: ObservedEntity, taken: ReceivedInput | None) -> None:
        self._close(thread)
        kind = EventKind.ACTION if _ACTION in entity.name else _EVENTS[entity.kind]
        self.recorder.begin(int(kind), entity, taken)
        thread.frames.append(_Frame(entity))

    def _begun(self, thread: _Thread, callback: int) -> None:
        entity = self._callbacks.get(callback)
        if entity is None:
            return
        top = thread.frames[-1] if thread.frames else None
        if top is None or top.callback is not None or top.entity is not entity:
            taken = self._called.get(entity.id)  # None: what it gets did not come from rmw
            self._begin(thread, entity, taken)
            top = thread.frames[-1]
        top.callback = callback

    def _ended(self, thread: _Thread, record: Record, callback: int) -> None:
        if not any(frame.callback == callback for frame in thread.frames):
            return
        while thread.frames[-1].callback != callback:
            self._pop(thread)
        thread.frames[-1].ended_ns = record.steady_ns
        if thread.frames[-1].entity.kind is not EntityKind.SERVICE:
            self._pop(thread)

    def _close(self, thread: _Thread) -> None:
        """End what is over in a thread: what has a begin but no end goes on."""
        while thread.frames and (thread.frames[-1].callback is None or thread.frames[-1].ended_ns):
            self._pop(thread)

    def _pop(self, thread: _Thread) -> None:
        recorder, at_ns = self.recorder, self.recorder.steady_ns
        recorder.steady_ns = thread.frames.pop().ended_ns or at_ns
        recorder.end()
        recorder.steady_ns = at_ns

    def begin_late(self) -> None:
        """Take note that what follows is not what came next."""
        self._missing()
        for thread in self._threads.values():
            self.recorder.enter(thread.local)
            self.recorder.pause()

    def _missing(self) -> None:
        """End everything: nobody knows what has come in between."""
        for thread in self._threads.values():
            self.recorder.enter(thread.local)
            if thread.sending is not None:
                self._sent(thread, 1, thread.sending[1].sequence)
            while thread.frames:
                self._pop(thread)

    # -- what is sent ---------------------------------------------------------------------------

    def _sending(self, thread: _Thread, record: Record) -> None:
        number, kind, sequence, is_raw, digest = record.fields.unpack(_SENDING)
        entity = self._entities.get(number)
        if entity is None:
            return
        raw_type = entity.sends_type if is_raw else None
        data, digest = self._content(record.fields, raw_type, digest)
        if entity.name == TOPIC_ROSOUT and entity.sends_type is self._log_type and data:
            log = codec_for(self._log_type).deserialize(data)
            self.recorder.add(
                EmittedLog(entity, log.level, log.name, log.msg, log.function, log.file, log.line)
            )
            return
        span = self.recorder.sending()
        span.observer_ns += record.spent_ns
        sent = SentMessage(int(_SENDS[kind]), entity, digest, data, sequence, 0, record.wall_ns)
        thread.sending = span, sent, record.steady_ns

    def _sent(self, thread: _Thread, is_sent: int, sequence: int) -> None:
        if thread.sending is None:
            return
        span, sent, _ = thread.sending
        thread.sending = None
        sent.after_ns, sent.sequence = self.recorder.time_ns(), sequence
        self.recorder.sent(span, sent if is_sent else None)
        if thread.frames and thread.frames[-1].ended_ns:  # a response leaves after the callback
            thread.frames[-1].ended_ns = self.recorder.steady_ns

    def _content(self, fields: RecordReader, type: Any, digest: int) -> tuple[bytes, int]:
        """Return a message, if it is kept, and its hash: of canonical CDR, which it is but for what
        the user has written."""
        data = fields.rest()
        if data and type is not None:
            with suppress(ValueError):  # the user's bytes may be none of this type
                data = codec_for(type).canonical(data)
                digest = hash64(data)
        self.unreadable += not digest
        return data, digest


def _type(name: str) -> tuple[Any, MessageType]:
    """Return a message's class, if Python has one, and its type."""
    try:
        found = get_message_class(name)
        return found, message_type(found)
    except (SetupError, TypeError):
        return None, MessageType(name)


# One entry of a job: a program, and what it starts.


class ObservedProgram:
    """Reads the files of an entry's processes, which come to lie in a folder."""

    def __init__(self, name: str, folder: Path, ids: count[int], threads: count[int]) -> None:
        self._name = name
        self._folder = folder
        self._numbers = ids, threads
        self.own = 0
        """The number of the process that was started, of whose end the run knows."""
        self._files: dict[Path, tuple[RecordFile, ProgramSpans]] = {}
        self._early: list[CallbackSpan] = []
        self._cpu_ns: dict[Path, int] = {}
        self._ended_ns: dict[Path, int] = {}
        self._triggered_ns: dict[Path, int] = {}

    def look(self, since_ns: int) -> Iterator[tuple[int, str]]:
        """If only the last records are kept: yield times and reasons to write a file, and forget
        what ended before ``since_ns``."""
        self._open()
        for path, (file, _) in list(self._files.items()):
            file.read_made()
            if file.triggered_ns > self._triggered_ns.get(path, 0):
                self._triggered_ns[path] = file.triggered_ns
                yield file.triggered_ns, f"a message on {file.trigger}"
            if path in self._ended_ns:
                if self._ended_ns[path] < since_ns:
                    for known in (self._files, self._ended_ns, self._triggered_ns):
                        known.pop(path, None)
            elif not file.cpu_ns(int(path.stem)):
                self._ended_ns[path] = now_ns()
                if file.status != 0 and int(path.stem) != self.own:
                    how = "was killed" if file.status is None else f"exit status {file.status}"
                    yield now_ns(), f"the end of process {path.stem} of {self._name}: {how}"

    def checked(self) -> list[CallbackSpan]:
        """Return what is new of what checks are about."""
        found: list[CallbackSpan] = []
        for file, spans in self._files.values():
            records, file.checked = file.checked, []
            for record in records:
                spans.add(record)
                if record.kind == RecordKind.SENDING:
                    spans.begin_late()  # nobody knows what it is a part of
            found += spans.finished(now_ns(), CUT_AFTER_NS)[0]
        return found

    @property
    def is_forgotten(self) -> bool:
        """Whether nothing is left of its processes."""
        return not self._files

    def last(self, since_ns: int) -> tuple[list[CallbackSpan], list[str]]:
        """Return the spans that are kept, and what is missing of those since then."""
        self._open()
        found: list[CallbackSpan] = []
        missing = []
        for path, (file, _) in list(self._files.items()):
            at_ns = now_ns()
            made, left = file.last()
            first = next(left, None)
            spans = ProgramSpans(self._name, int(path.stem), *self._numbers)
            start_ns = at_ns if first is None else first.steady_ns
            before = [record for record in made if record.steady_ns < start_ns]
            for record in before:
                spans.add(record)
            if file.overwritten:
                spans.begin_late()
                if start_ns > since_ns:
                    kept_s = format_seconds(at_ns - start_ns)
                    missing.append(
                        f"of {self._name}, all but the last {kept_s} s: its memory is full"
                    )
            left = chain([] if first is None else [first], left)
            for record in heapq.merge(made[len(before) :], left, key=attrgetter("steady_ns")):
                spans.add(record)
            if path in self._ended_ns:
                at_ns = spans.recorder.steady_ns
            found += spans.finished(at_ns, None)[0]
            if file.lost:
                missing.append(f"{file.lost} records of {self._name}, for which there was no room")
            if file.unchecked:
                missing.append(f"checks on {file.unchecked} messages of {self._name}: too many")
            if file.status is None and path in self._ended_ns and int(path.stem) != self.own:
                missing.append(
                    f"of {self._name}, which was killed, what each thread was just doing"
                )
        return found, missing

    def _open(self) -> None:
        for path in sorted(set(self._folder.iterdir()) - self._files.keys()):
            with suppress(OSError, ValueError):
                spans = ProgramSpans(self._name, int(path.stem), *self._numbers)
                self._files[path] = RecordFile(path), spans

    def read(self, *, is_over: bool) -> tuple[list[CallbackSpan], int]:
        """Return the spans that are new, in order, and up to when these are all. ``is_over``: the
        processes are no more."""
        until_ns = now_ns()
        self._open()
        found = self._early
        for path, (file, spans) in self._files.items():
            for record in file.read():
                spans.add(record)
            more, its_ns = spans.finished(file.until_ns, None if is_over else CUT_AFTER_NS)
            found += more
            until_ns = min(until_ns, its_ns)
            self._cpu_ns[path] = max(self._cpu_ns.get(path, 0), file.cpu_ns(int(path.stem)))
        found.sort(key=lambda span: span.start_ns)
        at = len(found) if is_over else sum(span.start_ns < until_ns for span in found)
        self._early = found[at:]
        return found[:at], until_ns

    @property
    def unobserved(self) -> int:
        """How many processes could not make a file."""
        return len(list(self._folder.iterdir()))

    @property
    def lost(self) -> int:
        """How many records found no room."""
        return sum(file.lost for file, _ in self._files.values())

    @property
    def counts(self) -> tuple[int, int, int, int, int]:
        """The figures of all its processes together (``run.Counts``)."""
        spans = [one for _, one in self._files.values()]
        return (
            sum(one.recorder.count for one in spans),
            max((one.recorder.activity_ns for one in spans), default=0),
            sum(one.unreadable for one in spans),
            sum(self._cpu_ns.values()),
            0,
        )
