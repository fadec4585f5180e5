"""The log records of a run, in order, and the events that they belong to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import printable, shortened
from rsltrace.trace.words.logs import LEVEL_WARN, LogRecord, parse_log
from rsltrace_viewer.model.lane_maker import LaneMaker
from rsltrace_viewer.model.run import Run

_TYPE = "rcl_interfaces/msg/Log"
_KEPT_MAX = 200_000
_TEXT_MAX = 500
_MARKED_MAX = 20_000
_PER_STEP = 200


@dataclass(frozen=True, slots=True)
class LogLine:
    """A log record. ``sequence`` is its number in its channel."""

    stamp_ns: int
    sequence: int
    record: LogRecord

    @property
    def text(self) -> str:
        return printable(shortened(self.record.text, _TEXT_MAX))


@dataclass(slots=True)
class Logs:
    """The records found so far. ``more`` counts those that are not kept."""

    lines: list[LogLine]
    more: int = 0

    def count(self, least: int) -> int:
        """Return how many records of a level (30: warning) or worse there are."""
        return sum(1 for line in self.lines if line.record.level >= least)


def read_logs(run: Run) -> Iterator[Logs]:
    """Yield the records of a run as they become known, the last time all. Raises TraceError."""
    channels = frozenset(
        channel.id
        for channel in run.trace.channels.values()
        if channel.topic == TOPIC_ROSOUT and channel.type == _TYPE
    )
    found = Logs([])
    if channels:
        for _, stamp_ns, sequence, data in run.trace.messages_of(channels):
            if len(found.lines) >= _KEPT_MAX:
                found.more += 1
                continue
            try:
                found.lines.append(LogLine(stamp_ns, sequence, parse_log(data)))
            except ValueError:
                continue
            if len(found.lines) % _PER_STEP == 0:
                yield found
    found.lines.sort(key=lambda line: (line.stamp_ns, line.sequence))
    yield found


def event_of(run: Run, line: LogLine) -> int | None:
    """Return the event that logged a record; None if it cannot be found. Raises TraceError."""
    if not run.count:
        return None
    # In columns, not event by event: an instant may have thousands of events that log.
    for number in range(run.segment_of(run.index_at(line.stamp_ns)), len(run.segments)):
        if run.segments[number]["start_stamp"] > line.stamp_ns:
            break
        run.outputs(int(run.segments[number]["first_event"]))  # raises if they are damaged
        outputs = run.segment_outputs(number)
        logged = (outputs["kind"] == int(OutputKind.LOG)) & (outputs["sequence"] == line.sequence)
        for index in outputs["event"][logged].tolist():
            if run.stamp(index) == line.stamp_ns:
                return int(index)
    return None


def first_event(run: Run, logs: Logs, least: int, below: int) -> int | None:
    """Return the event of the first record of a level in ``[least, below)``, if there is one."""
    found = next((line for line in logs.lines if least <= line.record.level < below), None)
    with suppress(TraceError):
        return None if found is None else event_of(run, found)
    return None


def mark_lanes(run: Run, maker: LaneMaker, logs: Logs) -> Iterator[int]:
    """Put warnings and findings of the guard into the lanes of their nodes."""
    found: dict[str, list[tuple[int, int]]] = {"w": [], "g": []}
    for index, met in list(run.trace.findings.items())[:_MARKED_MAX]:
        row = maker.row_of(int(run.row(index)["entity"]))
        if met[0].node in maker.labels:  # a constructor's entity is not of its node
            row = maker.labels.index(met[0].node)
        found["g"].append((run.stamp(index), row))
        yield index
    warnings = [line for line in logs.lines if line.record.level >= LEVEL_WARN]
    for line in warnings[:_MARKED_MAX]:
        try:
            logged_by = event_of(run, line)
        except TraceError:
            continue
        if logged_by is not None:
            row = maker.row_of(int(run.row(logged_by)["entity"]))
            found["w"].append((line.stamp_ns, row))
            yield logged_by
    for sign, places in found.items():
        if places:
            maker.add_signs(sign, places)
