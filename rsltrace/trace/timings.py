"""When each callback of a native run ran, and the latencies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.dtypes import EVENT_DTYPE, TIMING_DTYPE
from rsltrace.trace.format import CDR_HEADER, TIMING, TOPIC_TIMINGS
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT
from rsltrace.trace.reader import Trace

_SUBSCRIPTION_INPUT = (EntityKind.SUBSCRIPTION, EntityKind.SERVICE, EntityKind.CLIENT)


def timings(trace: Trace) -> npt.NDArray[np.void]:
    """Return when each event ran: TIMING_DTYPE, shape (events,); empty for a simulated run.

    :raises TraceError: if the trace contains something else.
    """
    rows = bytearray()
    for data in _packed_timings(trace):
        rows += data
    found = np.frombuffer(bytes(rows), TIMING_DTYPE)[: trace.event_count]  # of a run that was cut
    if len(found) and (
        len(found) != trace.event_count
        or not np.array_equal(found["event"], np.arange(len(found), dtype=np.uint64))
    ):
        raise TraceError(f"{trace.name}: its timings are not those of its events")
    return found


def iterate_timings(trace: Trace) -> Iterator[tuple[int, int]]:
    """Yield duration in nanoseconds and thread of each event of a native run, in order.

    :raises TraceError: if the trace contains something else.
    """
    for index, data in zip(range(trace.event_count), _packed_timings(trace), strict=False):
        row = TIMING.unpack(data)
        if row[0] != index:
            raise TraceError(f"{trace.name}: its timings are not those of its events")
        yield row[3], row[8]


def _packed_timings(trace: Trace) -> Iterator[bytes]:
    for _, _, data in trace.messages(TOPIC_TIMINGS):
        if data[:4] != CDR_HEADER or len(data) != 4 + TIMING_DTYPE.itemsize:
            raise TraceError(f"{trace.name}: a timing in it cannot be read")
        yield data[4:]


@dataclass(frozen=True, slots=True)
class DurationStatistics:
    """Statistics of durations in nanoseconds: number, median, 95 % quantile and maximum."""

    count: int
    median_ns: int
    p95_ns: int
    max_ns: int


def duration_statistics(values: npt.NDArray[np.int64]) -> DurationStatistics | None:
    """Return the statistics of durations, None without any."""
    if not len(values):
        return None
    median, p95 = np.quantile(values, (0.5, 0.95)).astype(np.int64).tolist()
    return DurationStatistics(len(values), median, p95, int(values.max()))


@dataclass(frozen=True, slots=True)
class CallbackFigures:
    """How the callbacks of one entity ran.

    ``duration`` is from start to end of each (or of its parts), ``wait`` from when it was ready,
    ``latency`` from when its input was sent. ``jitter`` is the difference between a timer's period
    and the time between calls. ``lost`` counts missing numbers between received messages, where
    messages are numbered and their publisher is known.
    """

    entity: Entity
    duration: DurationStatistics
    wait: DurationStatistics | None
    latency: DurationStatistics | None
    jitter: DurationStatistics | None
    lost: int | None


def callback_figures(trace: Trace) -> list[CallbackFigures]:
    """Return the figures of all entities of a native run that ran a callback, by id."""
    rows = timings(trace)
    if not len(rows):
        return []
    events = event_columns(trace)
    senders = senders_of(trace, events)
    figures = []
    for number in np.unique(events["entity"]).tolist():
        entity = trace.entity(number)
        if number == 0 or entity.kind is EntityKind.NODE:
            continue
        mine = events["entity"] == number
        own = rows[mine]
        duration = duration_statistics(own["duration"].astype(np.int64))
        assert duration is not None
        inputs = entity.kind in _SUBSCRIPTION_INPUT
        figures.append(
            CallbackFigures(
                entity,
                duration,
                _since(own, "ready"),
                _since(own, "source") if inputs else None,
                _jitter(entity, own),
                missing_numbers(own["sequence"], senders[mine])
                if entity.kind is EntityKind.SUBSCRIPTION
                else None,
            )
        )
    return figures


def busy_threads(trace: Trace) -> dict[int, float]:
    """Return the fraction of the run that callbacks took, by thread."""
    rows = timings(trace)
    if not len(rows):
        return {}
    ends = rows["steady"] + rows["duration"]
    whole = max(int(ends.max() - rows["steady"].min()), 1)
    return {
        thread: float(rows["duration"][rows["thread"] == thread].sum()) / whole
        for thread in np.unique(rows["thread"]).tolist()
    }


def event_columns(trace: Trace) -> npt.NDArray[np.void]:
    """Return the columns of all events that say what ran when, and why."""
    names = ["stamp", "entity", "kind", "flags", "cause_event", "cause_output", "outputs"]
    parts = [events[names] for events in trace.events()]
    return np.concatenate(parts) if parts else np.zeros(0, EVENT_DTYPE)[names]


def senders_of(trace: Trace, events: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
    """Return the sender of each event's input, -1 where it is unknown."""
    parts = [outputs["entity"] for outputs in trace.outputs()]
    entities = np.concatenate(parts) if parts else np.zeros(0, np.uint32)
    firsts = np.cumsum(events["outputs"], dtype=np.int64) - events["outputs"]
    known = events["cause_event"] != NO_EVENT
    senders = np.full(len(events), -1, np.int64)
    causes = events["cause_event"][known].astype(np.int64)
    places = firsts[causes] + events["cause_output"][known]
    senders[known] = entities[places]
    return senders


def _since(rows: npt.NDArray[np.void], column: str) -> DurationStatistics | None:
    known = rows[rows[column] != 0]
    return duration_statistics(known["wall"].astype(np.int64) - known[column].astype(np.int64))


def _jitter(entity: Entity, rows: npt.NDArray[np.void]) -> DurationStatistics | None:
    period = entity.detail.get("period_ns")
    if entity.kind is not EntityKind.TIMER or not isinstance(period, int):
        return None
    return duration_statistics(np.abs(np.diff(rows["steady"].astype(np.int64)) - period))


def missing_numbers(
    sequences: npt.NDArray[np.uint64], senders: npt.NDArray[np.int64]
) -> int | None:
    """Return how many numbers are missing between those received, None if nothing is numbered."""
    known = (sequences != 0) & (senders >= 0)
    if not known.any():
        return None
    lost = 0
    for sender in np.unique(senders[known]).tolist():
        numbers = np.unique(sequences[known & (senders == sender)].astype(np.int64))
        lost += int(numbers[-1] - numbers[0]) + 1 - len(numbers)
    return lost
