"""One opened trace as the viewer needs it: names at hand, a few segments in memory, no more.

Everything on screen comes through here. A segment (a few thousand events) is read when something
in it is looked at and forgotten when others were looked at since, so a trace of ten million events
needs no more memory than a small one.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timezone
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.dtypes import EVENT_DTYPE, OUTPUT_DTYPE
from rsltrace.trace.model.entity import WITH_TOPIC, Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, EventRecord, Output, OutputKind
from rsltrace.trace.model.texts import NS_PER_S, printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import event_of, output_of
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.events import EventWords
from rsltrace.trace.words.phrases import seconds_text

_EPOCH_NS = 1_000_000 * NS_PER_S
_SEGMENTS_KEPT = 24
"""About 0.4 MB each with outputs."""


_STAMP_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Segment:
    """The events of a segment: EVENT_DTYPE, shape (n,); ``first`` is the index of the first."""

    number: int
    first: int
    events: npt.NDArray[np.void]

    @property
    def last(self) -> int:
        return self.first + len(self.events)


class Run:
    """A trace with the look-ups of a viewer.

    Methods may be called from several threads.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.count = trace.event_count
        self.segments = trace.segments
        self._damaged: dict[int, TraceError] = {}
        self._damaged_outputs: dict[int, TraceError] = {}
        self.segment = lru_cache(maxsize=_SEGMENTS_KEPT)(self._segment)
        self.segment_outputs = lru_cache(maxsize=_SEGMENTS_KEPT)(self._segment_outputs)

    @classmethod
    def open(cls, path: Path | str) -> Run:
        """Open a trace. Raises TraceError, TraceFormatError."""
        run = cls(Trace.open(path))
        if run.end_ns >= _STAMP_MAX:
            run.close()
            raise TraceError(f"{path}: an event is later than any time of ROS")
        return run

    @property
    def name(self) -> str:
        """The file's name without its folder."""
        return printable(Path(self.trace.name).name)

    def close(self) -> None:
        self.trace.close()

    # Names.

    @cached_property
    def entities(self) -> Mapping[int, Entity]:
        return self.trace.entities

    @cached_property
    def nodes(self) -> tuple[Entity, ...]:
        return tuple(e for e in self.entities.values() if e.kind is EntityKind.NODE)

    @cached_property
    def words(self) -> EventWords:
        return EventWords(self.trace)

    def node_name(self, entity_id: int) -> str:
        """Return the name of the node that an entity belongs to."""
        return self.words.names.node(entity_id) or RUN_NAME

    def entity_name(self, entity_id: int) -> str:
        """Return the name of an entity; ``#7`` if the trace does not describe it."""
        return self.words.names.name(entity_id)

    @cached_property
    def topics(self) -> tuple[str, ...]:
        return tuple(sorted({e.name for e in self.entities.values() if e.kind in WITH_TOPIC}))

    @cached_property
    def entity_node(self) -> npt.NDArray[np.int64]:
        """By entity id: its node's place in ``nodes``, -1 for the run. Shape (largest id + 1,)."""
        places = {node.id: place for place, node in enumerate(self.nodes)}
        table = np.full(max(self.entities) + 1, -1, dtype=np.int64)
        for entity in self.entities.values():
            table[entity.id] = places.get(entity.node, -1)
        return table

    def ids_on(self, topic: str) -> list[int]:
        """Return the ids of the publishers, subscriptions, clients and services of a name."""
        return [e.id for e in self.entities.values() if e.name == topic and e.kind in WITH_TOPIC]

    # Events.

    def segment_of(self, index: int) -> int:
        """Return the number of the segment with event ``index`` (which must exist)."""
        firsts = self.segments["first_event"]
        return int(np.searchsorted(firsts, np.uint64(index), side="right")) - 1

    def row(self, index: int) -> np.void:
        """Return event ``index`` as a row of EVENT_DTYPE. Raises IndexError if there is none."""
        if not 0 <= index < self.count:
            raise IndexError(f"{self.trace.name} has no event {index}")
        segment = self.segment(self.segment_of(index))
        row: np.void = segment.events[index - segment.first]
        return row

    def event(self, index: int) -> EventRecord:
        """Return event ``index``. Raises IndexError, TraceError."""
        row = self.row(index)
        damage = self._damaged.get(self.segment_of(index))
        if damage is not None:
            raise damage
        return event_of(row, self.trace.name)

    def outputs(self, index: int) -> list[Output]:
        """Return the outputs of event ``index``, in order. Raises IndexError, TraceError."""
        if not 0 <= index < self.count:
            raise IndexError(f"{self.trace.name} has no event {index}")
        number = self.segment_of(index)
        outputs = self.segment_outputs(number)
        damage = self._damaged_outputs.get(number)
        if damage is not None:
            raise damage
        bounds = np.array([index, index + 1], dtype=np.uint64)
        low, high = np.searchsorted(outputs["event"], bounds).tolist()
        return [output_of(row, self.trace.name) for row in outputs[low:high]]

    def stamp(self, index: int) -> int:
        """Return when event ``index`` happened, in ns."""
        return int(self.row(index)["stamp"])

    def index_at(self, stamp_ns: int) -> int:
        """Return the first event at ``stamp_ns`` or later; the last event if there is none later.

        Raises IndexError if there is no event at all.
        """
        if not self.count:
            raise IndexError(f"{self.trace.name} has no event")
        stamp = np.uint64(max(stamp_ns, 0))
        number = int(np.searchsorted(self.segments["end_stamp"], stamp))
        if number >= len(self.segments):
            return self.count - 1
        segment = self.segment(number)
        place = int(np.argmax(segment.events["stamp"] >= stamp))
        return segment.first + place

    @cached_property
    def start_ns(self) -> int:
        """Stamp of the earliest event (0: none)."""
        return int(self.segments["start_stamp"].min()) if len(self.segments) else 0

    @cached_property
    def end_ns(self) -> int:
        """Stamp of the latest event (0: none)."""
        return int(self.segments["end_stamp"].max()) if len(self.segments) else 0

    @cached_property
    def base_ns(self) -> int:
        """The start of the run, from which times count."""
        return self.trace.start_ns

    def start_text(self) -> str:
        """Return the start in simulated time: a date, if times are those since 1970, as of bags."""
        if self.base_ns < _EPOCH_NS:
            return f"{seconds_text(self.base_ns)} s"
        date = datetime.fromtimestamp(self.base_ns // NS_PER_S, tz=timezone.utc)
        return f"{date:%Y-%m-%d %H:%M:%S} UTC"

    def input_of(self, event: EventRecord) -> Output | None:
        """Return the output that was the input of ``event``, or None if no event caused it.

        What goes on after a callback that ran on its own stack has that as its cause, but nothing
        of it as its input.
        """
        if not 0 <= event.cause_event < self.count:
            return None
        outputs = self.outputs(event.cause_event)
        found = outputs[event.cause_output : event.cause_output + 1]
        if event.kind is EventKind.RESUME and not any(o.kind is OutputKind.TASK for o in found):
            return None
        if not found:
            raise TraceError(
                f"event {event.index} names output {event.cause_output} of event "
                f"{event.cause_event} as its cause, which has {len(outputs)}; the trace is damaged"
            )
        return found[0]

    def _segment(self, number: int) -> Segment:
        """Read a segment. Events of a damaged one are stood in for: one can step over them, they
        match nothing, and ``event`` says what is wrong."""
        row = self.segments[number]
        first = int(row["first_event"])
        count = int(row["events"])
        try:
            events = np.ascontiguousarray(next(self.trace.events(first, first + count)))
        except TraceError as error:
            self._damaged[number] = error
            events = np.zeros(count, dtype=EVENT_DTYPE)
            events["index"] = np.arange(first, first + count)
            events["stamp"] = row["start_stamp"]
            events["cause_event"] = NO_EVENT
            events["outputs"] = 0
        return Segment(number, first, events)

    def _segment_outputs(self, number: int) -> npt.NDArray[np.void]:
        row = self.segments[number]
        first = int(row["first_event"])
        try:
            outputs = next(self.trace.outputs(first, first + int(row["events"])))
        except TraceError as error:
            self._damaged_outputs[number] = error
            outputs = np.zeros(0, dtype=OUTPUT_DTYPE)
        return np.ascontiguousarray(outputs)
