"""Writing spans down as the events of a trace, in a thread of its own."""

from __future__ import annotations

import sys
import threading
import time
from array import array
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Protocol

import numpy as np

from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.native.message_observer import channel_of
from rsltrace.native.observed_entities import ObservedEntity
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    EmittedLog,
    ReceivedInput,
    SentMessage,
    TaskCreation,
)
from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import PREFIX_REQUEST, PREFIX_RESPONSE, TIMING
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_EVENT, OutputKind
from rsltrace.trace.model.texts import NS_PER_S
from rsltrace.trace.native import CUT_AFTER_NS
from rsltrace.trace.recorder import Recorder

# Who sent what a callback got, by channel, sequence number, content, and publisher or time.
#
# Several publishers of a topic count alike and may say the same. Their gid tells them apart where
# it is known; rclpy does not give it. Otherwise what was received was sent (its source timestamp)
# while the call that sent it was under way.

KEPT = 200_000
"""Messages sent that are remembered: what comes later than after so many has no known cause."""

SLACK_NS = 1_000_000
"""How far the middleware's clock may be from ours."""

_TAKEN = b"taken"
_Key = tuple[str, int, int]
_Place = tuple[int, int, int, int, bytes]


class CauseIndex:
    """Remembers what was sent, and finds it again."""

    def __init__(self, kept: int = KEPT) -> None:
        self._places: defaultdict[_Key, list[_Place]] = defaultdict(list)
        self._turns: defaultdict[_Key, dict[int, count[int]]] = defaultdict(dict)
        self._order: deque[_Key] = deque()
        self._kept = kept
        self.unknown = 0
        """Messages taken whose sender was not found: another process's, or too old."""

    def sent(self, sent: SentMessage, event: int, output: int) -> None:
        """Remember which output of which event a message is."""
        key = channel_of(sent.kind, sent.entity.name), sent.sequence, sent.digest
        self._places[key].append((event, output, sent.before_ns, sent.after_ns, sent.entity.gid))
        self._order.append(key)
        if len(self._order) > self._kept:
            oldest = self._order.popleft()
            self._places[oldest].pop(0)
            if not self._places[oldest]:
                del self._places[oldest]
                self._turns.pop(oldest, None)

    def of(self, taken: ReceivedInput) -> tuple[int, int]:
        """Return the event and output from which an input came; ``NO_EVENT`` if that is unknown."""
        if not taken.channel:
            return NO_EVENT, 0
        key = taken.channel, taken.sequence, taken.digest
        places = self._places.get(key, ())
        if taken.gid:
            for event, output, *_, gid in places:
                if gid == taken.gid:
                    return event, output
            places = [place for place in places if not place[4]]
        during = [place[:2] for place in places if place[2] <= taken.source_ns <= place[3]]
        if len(during) == 1:  # which of several clients' equal requests at once, nobody knows
            return during[0]
        if places and not taken.source_ns:  # of actions, which do not tell when
            return self._of_action(key, taken)
        if len(places) == 1:
            event, output, before_ns, after_ns, _ = places[0]
            if before_ns - SLACK_NS <= taken.source_ns <= after_ns + SLACK_NS:
                return event, output
        self.unknown += 1
        return NO_EVENT, 0

    def _of_action(self, key: _Key, taken: ReceivedInput) -> tuple[int, int]:
        """Feedback comes in its order; a request or response comes once."""
        places = self._places[key]
        if not taken.sequence:
            turn = self._turns[key].setdefault(taken.entity.id, count())
            return places[min(next(turn), len(places) - 1)][:2]
        left = [at for at, place in enumerate(places) if place[4] != _TAKEN]
        if len(left) != 1:
            self.unknown += 1
            return NO_EVENT, 0
        event, output, before_ns, after_ns, _ = places[left[0]]
        places[left[0]] = event, output, before_ns, after_ns, _TAKEN
        return event, output


_EVERY_S = 0.05
_KEPT_EVERY_NS = NS_PER_S
"""How much of a run that is killed is not in its trace, at most."""
_PREFIX = {OutputKind.REQUEST: PREFIX_REQUEST, OutputKind.RESPONSE: PREFIX_RESPONSE}


@dataclass(frozen=True, slots=True)
class ClockPair:
    """The system clock and the steady one at one moment, in nanoseconds.

    Stamps of a trace are system time as the steady clock carries it on: it never goes back.
    """

    wall_ns: int
    steady_ns: int

    @classmethod
    def now(cls) -> ClockPair:
        """Read both."""
        return cls(time.time_ns(), time.monotonic_ns())

    def stamp(self, steady_ns: int) -> int:
        """Return the system time of a reading of the steady clock."""
        return self.wall_ns + steady_ns - self.steady_ns


class SpanSource(Protocol):
    """Where spans come from. No other ones began before ``until_ns`` than it has given."""

    @property
    def until_ns(self) -> int: ...

    def finished(self, patience_ns: int | None) -> list[CallbackSpan]:
        """Take those before which all is over, in order of their starts."""


class SpanWriter(threading.Thread):
    """Takes spans from a source and writes them, until ``finish`` is called."""

    def __init__(
        self,
        source: SpanSource,
        recorder: Recorder,
        clocks: ClockPair,
        base_dir: Path,
        look: Callable[[], None] | None = None,
    ) -> None:
        """``look`` is called again and again if nothing is written before ``finish``."""
        super().__init__(name="rsltrace span writer", daemon=True)
        self._source = source
        self._recorder = recorder
        self._clocks = clocks
        self._base_dir = base_dir
        self._look = look
        self._over = threading.Event()
        self.causes = CauseIndex()
        self.error: BaseException | None = None
        """Why nothing is written any more."""
        self._observer_ns = array("Q")
        self._channels: dict[int, int] = {}
        """Those of the trace, by the ids of entities that something was written of."""
        self.cpu_ns = 0
        """Processor time of this thread."""

    @property
    def count(self) -> int:
        """How many events have been written."""
        return self._recorder.index

    @property
    def observer_ns(self) -> int:
        """The median of what observing a callback took in its thread."""
        return int(np.median(self._observer_ns)) if self._observer_ns else 0

    def run(self) -> None:
        try:
            kept_ns = time.monotonic_ns()
            while not self._over.wait(_EVERY_S):
                if self._look is not None:
                    self._look()
                    continue
                self.write(CUT_AFTER_NS)
                if time.monotonic_ns() - kept_ns >= _KEPT_EVERY_NS:
                    self._recorder.writer.flush()
                    kept_ns = time.monotonic_ns()
                self.cpu_ns = time.thread_time_ns()
        except BaseException as error:
            self.error = error
        self.cpu_ns = time.thread_time_ns()

    def finish(self) -> None:
        """Write what is left. Nothing must begin any more.

        :raises OutputError: the trace cannot be written.
        """
        self._over.set()
        self.join()
        if self.error is not None:
            raise self.error
        self.write(None)

    def write(self, patience_ns: int | None) -> None:
        for span in self._source.finished(patience_ns):
            self._write(span)

    def _write(self, span: CallbackSpan) -> None:
        recorder = self._recorder
        span.index = index = recorder.index
        stamp_ns = self._clocks.stamp(span.start_ns)
        for position, output in enumerate(span.outputs):
            if isinstance(output, SentMessage):
                self._sent(output, stamp_ns)
                self.causes.sent(output, index, position)
            elif isinstance(output, Entity):
                recorder.entity(replace(output, created_ns=stamp_ns))
            elif isinstance(output, EmittedLog):
                self._logged(output, stamp_ns)
            elif isinstance(output, CallbackError):
                entity = 0 if span.entity is None else span.entity.id
                digest = hash64(f"{output.kind}\0{output.said}".encode())
                recorder.detail(OutputKind.EXCEPTION, entity, stamp_ns, output.traceback, digest)
            else:
                assert isinstance(output, TaskCreation)
                recorder.output(OutputKind.TASK, 0 if span.entity is None else span.entity.id, 0)
        cause_event, cause_output = NO_EVENT, 0
        taken = span.taken
        if taken is not None:
            cause_event, cause_output = self.causes.of(taken)
        elif span.cause is not None and span.cause[0].index >= 0:
            cause_event, cause_output = span.cause[0].index, span.cause[1]
        self._timing(span, index, stamp_ns)
        self._observer_ns.append(span.observer_ns)
        recorder.end_event(
            stamp_ns,
            span.kind,
            span.flags,
            0 if span.entity is None else span.entity.id,
            cause_event,
            cause_output,
            0 if taken is None else taken.input_hash,
        )

    def _timing(self, span: CallbackSpan, index: int, stamp_ns: int) -> None:
        taken = span.taken
        packed = TIMING.pack(
            index,
            span.start_ns,
            span.wall_ns,
            span.end_ns - span.start_ns,
            span.observer_ns,
            0 if taken is None else taken.source_ns,
            0 if taken is None else taken.ready_ns,
            0 if taken is None else taken.sequence,
            span.thread,
        )
        self._recorder.writer.add_timing(packed, stamp_ns)

    def _sent(self, sent: SentMessage, stamp_ns: int) -> None:
        prefix = _PREFIX.get(OutputKind(sent.kind), "")
        channel = self._channel(sent.entity, prefix) if sent.data else -1
        self._recorder.message(sent.kind, sent.entity.id, channel, stamp_ns, sent.data, sent.digest)

    def _channel(self, entity: ObservedEntity, prefix: str) -> int:
        if entity.id not in self._channels:
            self._channels[entity.id] = -1
            topic, recorder = prefix + entity.name, self._recorder
            if entity.sends is not None and recorder.keep_payload(topic):
                text, type_hash = entity.sends.describe()
                self._channels[entity.id] = recorder.writer.add_channel(
                    topic,
                    entity.sends.name,
                    text,
                    qos_yaml=entity.qos_yaml,
                    type_hash="" if prefix else type_hash,
                )
        return self._channels[entity.id]

    def _logged(self, logged: EmittedLog, stamp_ns: int) -> None:
        record = logged.entity.sends_type(
            level=logged.severity,
            name=logged.name,
            msg=logged.text,
            file=self._portable(logged.file),
            function=logged.function,
            line=logged.line,
        )
        record.stamp.sec, record.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
        data = codec_for(logged.entity.sends_type).serialize(record)
        channel = self._channel(logged.entity, "")
        self._recorder.message(
            OutputKind.LOG, logged.entity.id, channel, stamp_ns, data, hash64(log_content(data))
        )

    def _portable(self, file: str) -> str:
        path = Path(file)
        for base in (self._base_dir, Path(sys.prefix)):
            if path.is_relative_to(base):
                return str(path.relative_to(base))
        return path.name
