"""Export a trace for Perfetto (ui.perfetto.dev): TrackEvent packets of its protobuf format.

A node is a group of tracks: one for each callback group, and more where callbacks overlap. In a
native run, each thread is a track. A callback is a slice as long as it took: its execution time in
a simulation, the measured duration in a native run. Most callbacks of a simulation take no time;
they are instants, which Perfetto shows at every zoom. A made-up length would overlap with others.

The trace is read once, a segment at a time. Packets are not in the order of time: Perfetto sorts
them, and keeps packets of equal time in the order of the file.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import OutputError, SetupError, TraceError
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    EventKind,
    Output,
    OutputKind,
    RandomDecision,
    decision_duration,
)
from rsltrace.trace.model.finding import GuardMode
from rsltrace.trace.model.regular_file import check_output_file, replacement_of
from rsltrace.trace.model.texts import NS_PER_S, printable, shortened
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import output_of
from rsltrace.trace.timings import iterate_timings
from rsltrace.trace.words.entities import RUN_NAME, kind_label
from rsltrace.trace.words.events import EventWords

_EVENTS_AHEAD = 32 * 4096
"""How far effects of an event are looked for. A later one has no arrow from its cause."""
_PACKETS_TOGETHER = 4096
_TEXT_MAX = 1000
_SEQUENCE = 1
_RECEIVING = (int(EventKind.SUBSCRIPTION), int(EventKind.SERVICE), int(EventKind.CLIENT))
_NOTED = frozenset((OutputKind.LOG, OutputKind.EXCEPTION))
_OUTPUTS = [int(kind) for kind in (*_NOTED, OutputKind.MESSAGE, OutputKind.DRAW, OutputKind.ENTITY)]
_STAMP_MAX = 1 << 62
_LANES_MAX = 64
_QUEUE, _RATE = 0, 1
_TOPICS = -1
"""In place of a node: what has the rates of topics."""


def require_perfetto() -> Any:
    """Return the module of Perfetto's messages. Raises SetupError if it is not installed."""
    try:
        from perfetto.protos.perfetto.trace import perfetto_trace_pb2
    except Exception as error:  # protobuf's own, if it is older than the definitions
        raise SetupError(
            f"Perfetto's definitions cannot be loaded ({error}); install them with: "
            "pip install 'rsltrace[perfetto]'"
        ) from error
    return perfetto_trace_pb2


def export_perfetto(
    trace: Path,
    output: Path,
    *,
    force: bool = False,
    progress: Callable[[int, int], None] = lambda written, total: None,
) -> int:
    """Write a trace to the Perfetto file ``output``; return the number of events.

    ``progress`` is called now and then with the numbers of events written and in total. The file
    appears when it is complete.

    :raises SetupError: if the ``perfetto`` package is not installed.
    :raises TraceError: if the trace cannot be read.
    :raises OutputError: if the file exists (without ``force``) or cannot be written.
    """
    messages = require_perfetto()
    check_output_file(output, [trace], force=force, example="run.pftrace")
    with Trace.open(trace) as opened:
        try:
            with replacement_of(output) as work, work.open("xb") as file:
                packets = _Packets(file, messages)
                _Export(opened, packets).write(progress)
                packets.flush()
        except OSError as error:
            raise OutputError(f"{output} cannot be written: {error.strerror or error}") from error
        return opened.event_count


class _Packets:
    """Writes packets to a file, a few thousand at a time, with names stored once."""

    def __init__(self, file: IO[bytes], messages: Any) -> None:
        self._file = file
        self._new: Callable[[], Any] = messages.Trace
        self._batch = self._new()
        self._event: Any = messages.TrackEvent
        self._tracks = 0
        self._names: dict[str, int] = {}
        first = self._add(0)
        first.sequence_flags = messages.TracePacket.SEQ_INCREMENTAL_STATE_CLEARED
        first.interned_data.debug_annotation_names.add(iid=1, name="event")
        self._needs = messages.TracePacket.SEQ_NEEDS_INCREMENTAL_STATE

    def flush(self) -> None:
        # One message after the other is one message with all their packets.
        self._file.write(self._batch.SerializeToString())
        self._batch = self._new()  # clearing a message does not give its memory back

    def track(self, name: str, parent: int = 0, unit: str | None = None) -> int:
        """Add a track and return its number; a counter if it has a ``unit``."""
        self._tracks += 1
        descriptor = self._add(0).track_descriptor
        descriptor.uuid, descriptor.name = self._tracks, shortened(name, _TEXT_MAX)
        if parent:
            descriptor.parent_uuid = parent
        if unit is not None:
            descriptor.counter.unit_name = unit
        return self._tracks

    def slice(
        self,
        track: int,
        begin_ns: int,
        duration_ns: int,
        name: str,
        event: int,
        effects: list[int],
        cause: int,
    ) -> None:
        """Add a slice; an instant if it has no duration.

        ``event`` is its number in the trace. ``effects`` and ``cause`` (0: none) are the numbers of
        the arrows that begin and end here.
        """
        kind = self._event.TYPE_SLICE_BEGIN if duration_ns else self._event.TYPE_INSTANT
        packet, one = self._track_event(track, begin_ns, kind)
        number = self._names.get(name)
        if number is None:
            number = self._names[name] = len(self._names) + 1
            shown = shortened(name, _TEXT_MAX)
            packet.interned_data.event_names.add(iid=number, name=shown)
        one.name_iid = number
        one.debug_annotations.add(name_iid=1, uint_value=event)
        if effects:
            one.flow_ids.extend(effects)
        if cause:
            one.terminating_flow_ids.append(cause)
        if duration_ns:
            self._track_event(track, begin_ns + duration_ns, self._event.TYPE_SLICE_END)

    def note(self, track: int, stamp_ns: int, text: str, event: int) -> None:
        """Add an instant with a text of its own."""
        _, one = self._track_event(track, stamp_ns, self._event.TYPE_INSTANT)
        one.name = shortened(text, _TEXT_MAX)
        one.debug_annotations.add(name_iid=1, uint_value=event)

    def count(self, track: int, stamp_ns: int, value: float) -> None:
        _, one = self._track_event(track, stamp_ns, self._event.TYPE_COUNTER)
        one.double_counter_value = value

    def _track_event(self, track: int, stamp_ns: int, kind: int) -> tuple[Any, Any]:
        packet = self._add(stamp_ns)
        one = packet.track_event
        one.type, one.track_uuid = kind, track
        return packet, one

    def _add(self, stamp_ns: int) -> Any:
        if len(self._batch.packet) >= _PACKETS_TOGETHER:
            self.flush()
        packet = self._batch.packet.add()
        packet.trusted_packet_sequence_id = _SEQUENCE
        packet.timestamp = stamp_ns
        if self._tracks:
            packet.sequence_flags = self._needs
        return packet


@dataclass(slots=True)
class _Lane:
    """A track of callbacks that do not overlap."""

    track: int
    end_ns: int = 0


@dataclass(slots=True)
class _Counter:
    """A counter's track and last value. Of a rate: the last messages, and when they were sent."""

    track: int
    value: float = 0
    sent: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class _Chunk:
    """A segment: its events and outputs, and which events have an arrow from their cause."""

    events: npt.NDArray[np.void]
    outputs: npt.NDArray[np.void]
    linked: npt.NDArray[np.bool_]
    effects: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


def _chunks(trace: Trace) -> Iterator[_Chunk]:
    """Yield the segments; ``effects`` are (event, receiving entity or 0) by what caused it."""
    waiting: deque[_Chunk] = deque()
    effects: dict[int, list[tuple[int, int]]] = {}
    ahead = 0
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        first = waiting[0].events["index"][0] if waiting else events["index"][0]
        causes = events["cause_event"]
        linked = (causes >= first) & (causes < events["index"])  # NO_EVENT is larger than any
        receivers = np.where(np.isin(events["kind"], _RECEIVING), events["entity"], 0)
        columns = (causes, events["index"], receivers)
        for cause, index, entity in zip(*(one[linked].tolist() for one in columns), strict=True):
            effects.setdefault(cause, []).append((index, entity))
        waiting.append(_Chunk(events, outputs, linked, effects))
        ahead += len(events)
        while ahead > _EVENTS_AHEAD:
            ahead -= len(waiting[0].events)
            yield waiting.popleft()
    yield from waiting


class _Export:
    def __init__(self, trace: Trace, packets: _Packets) -> None:
        self._trace = trace
        self._packets = packets
        self._words = EventWords(trace)
        self._names: dict[tuple[int, int, int], tuple[str, str]] = {}
        self._lanes: dict[tuple[int, str], list[_Lane]] = {}
        self._groups: dict[tuple[int, str], int] = {}
        self._queues: dict[int, _Counter] = {}
        self._rates: dict[str, _Counter] = {}
        self._changes: list[tuple[int, int, int, int]] = []
        self._nodes = {
            entity.id for entity in trace.entities.values() if entity.kind is EntityKind.NODE
        }
        self._native = is_native(trace)

    def write(self, progress: Callable[[int, int], None]) -> None:
        total, written = self._trace.event_count, 0
        timings = iterate_timings(self._trace)
        for chunk in _chunks(self._trace):
            timing = list(islice(timings, len(chunk.events))) if self._native else []
            if self._native and len(timing) < len(chunk.events):
                raise TraceError(f"{self._trace.name}: its timings are not those of its events")
            if int(chunk.events["stamp"].max()) > _STAMP_MAX:
                raise TraceError(f"{self._trace.name}: an event is later than any time of ROS")
            self._write_chunk(chunk, timing)
            written += len(chunk.events)
            progress(written, total)
        self._count_until(2 * _STAMP_MAX + 1)
        for counter in self._rates.values():
            self._packets.count(counter.track, counter.last_ns, 0)
        self._write_findings()

    def _write_chunk(self, chunk: _Chunk, timings: list[tuple[int, int]]) -> None:
        outputs: dict[int, list[Output]] = {}
        kinds, hashes = chunk.outputs["kind"], chunk.outputs["hash"]
        wanted = np.isin(kinds, _OUTPUTS)
        wanted &= (kinds != OutputKind.DRAW) | (hashes >> np.uint64(56) == RandomDecision.EXECUTION)
        wanted &= (kinds != OutputKind.ENTITY) | np.isin(chunk.outputs["entity"], list(self._nodes))
        for row in chunk.outputs[wanted]:
            output = output_of(row, self._trace.name)
            outputs.setdefault(output.event, []).append(output)
        names = ("index", "stamp", "entity", "kind")
        columns = (chunk.events[name].tolist() for name in names)
        rows = zip(*columns, chunk.linked.tolist(), strict=True)
        for place, (index, begin_ns, entity, kind, linked) in enumerate(rows):
            own = outputs.get(index, [])
            node = self._node(entity, kind, own)
            name, group = self._describe(kind, entity, node)
            if timings:
                duration_ns, thread = timings[place]
                duration_ns, group = min(duration_ns, _STAMP_MAX), f"thread {thread}"
            else:
                duration_ns = _execution_ns(entity, own)
            effects = chunk.effects.pop(index, [])
            self._packets.slice(
                self._lane(node, group, begin_ns, duration_ns),
                begin_ns,
                duration_ns,
                name,
                index,
                [effect + 1 for effect, _ in effects],
                index + 1 if linked else 0,
            )
            # A message of a simulation leaves when the execution time is over.
            left_ns = begin_ns if timings else begin_ns + duration_ns
            for _, receiver in effects:
                self._change(left_ns, receiver, 1)
            if linked and kind in _RECEIVING:
                self._change(begin_ns, entity, -1)
            for output in own:
                if output.kind is OutputKind.MESSAGE:
                    heappush(self._changes, (left_ns, _RATE, output.entity, 1))
                elif output.kind in _NOTED:
                    track = self._track(node, "log" if output.kind is OutputKind.LOG else "errors")
                    text = self._words.output(output)
                    self._packets.note(track, begin_ns, text.removeprefix("log "), index)
            self._count_until(begin_ns)

    def _write_findings(self) -> None:
        owners = {self._words.names.name(node): node for node in self._nodes}
        for stamp_ns, finding in self._trace.answers_in_order():
            if finding.mode is not GuardMode.VIRTUAL:
                track = self._track(owners.get(printable(finding.node), 0), "findings")
                text = printable(f"{finding.source.value} {finding.call}")
                self._packets.note(track, stamp_ns, text, finding.event)

    def _node(self, entity: int, kind: int, outputs: list[Output]) -> int:
        """Return the node of an event, 0 for the run: of a constructor the new node."""
        if kind == EventKind.CONSTRUCT:
            for output in outputs:
                if output.entity in self._nodes:
                    return output.entity
        found = self._trace.entities.get(entity)
        return found.node if found is not None else 0

    def _describe(self, kind: int, entity: int, node: int) -> tuple[str, str]:
        """Return the name of a callback, with its node in a native run, and its group."""
        found = self._names.get((kind, entity, node))
        if found is None:
            names = self._words.names
            name = f"{kind_label(EventKind, kind)} {names.name(entity or node)}".rstrip()
            owner = names.node(node) if self._native and entity else ""
            known = self._trace.entities.get(entity)
            group = printable(str(known.detail.get("group", ""))) if known is not None else ""
            found = f"{owner}: {name}" if owner else name, group
            self._names[kind, entity, node] = found
        return found

    def _track(self, node: int, name: str = "") -> int:
        """Return a track of a node, by default the one that has the others below it."""
        track = self._groups.get((node, name))
        if track is None:
            parent = self._track(node) if name else 0
            shown = name or ("topics" if node == _TOPICS else self._words.names.name(node))
            track = self._groups[node, name] = self._packets.track(shown or RUN_NAME, parent)
        return track

    def _lane(self, node: int, group: str, begin_ns: int, duration_ns: int) -> int:
        """Return a track of a callback group or thread that is free for that time."""
        lanes = self._lanes.setdefault((0 if self._native else node, group), [])
        lane = next((lane for lane in lanes if lane.end_ns <= begin_ns), None)
        if lane is None and len(lanes) == _LANES_MAX:
            lane = lanes[-1]
        elif lane is None:
            parent = 0 if self._native else self._track(node)
            lane = _Lane(self._packets.track(group or "callbacks", parent))
            lanes.append(lane)
        lane.end_ns = begin_ns + duration_ns
        return lane.track

    def _change(self, stamp_ns: int, entity: int, by: int) -> None:
        if entity and entity in self._trace.entities:
            heappush(self._changes, (stamp_ns, _QUEUE, entity, by))

    def _count_until(self, stamp_ns: int) -> None:
        """Write the counters up to a time: nothing changes before it any more."""
        while self._changes and self._changes[0][0] < stamp_ns:
            *key, by = heappop(self._changes)
            while self._changes and [*self._changes[0][:3]] == key:
                by += heappop(self._changes)[3]
            at_ns, what, entity = key
            if what == _RATE:
                self._rate(at_ns, entity, by)
            elif by:
                self._waiting(at_ns, entity, by)

    def _waiting(self, stamp_ns: int, entity: int, by: int) -> None:
        counter = self._queues.get(entity)
        if counter is None:
            found = self._trace.entity(entity)
            name = f"{self._words.names.name(entity)} waiting"
            track = self._packets.track(name, self._track(found.node), "messages")
            counter = self._queues[entity] = _Counter(track)
        counter.value += by
        self._packets.count(counter.track, stamp_ns, counter.value)

    def _rate(self, stamp_ns: int, publisher: int, sent: int) -> None:
        """Count messages of a topic. A rate holds from one message to the next."""
        topic = self._words.names.name(publisher)
        counter = self._rates.get(topic)
        if counter is None:
            track = self._packets.track(f"{topic} rate", self._track(_TOPICS), "Hz")
            self._rates[topic] = _Counter(track, 0, sent, stamp_ns)
            return
        if stamp_ns == counter.last_ns:  # of another publisher
            counter.sent += sent
            return
        rate = counter.sent * NS_PER_S / (stamp_ns - counter.last_ns)
        if rate != counter.value:
            self._packets.count(counter.track, counter.last_ns, rate)
        counter.value, counter.sent, counter.last_ns = rate, sent, stamp_ns


def _execution_ns(entity: int, outputs: list[Output]) -> int:
    """Return the execution time of an event of a simulation, 0 if it takes none."""
    for output in outputs:
        if output.kind is OutputKind.DRAW and output.entity == entity:
            return decision_duration(output.hash, RandomDecision.EXECUTION) or 0
    return 0
