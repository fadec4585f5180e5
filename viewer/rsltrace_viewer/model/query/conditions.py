"""Conditions on events, evaluated for a whole segment at once, and walking to what matches.

A condition answers with a mask over the events of a segment. Cheap ones look at columns of
numbers; those that must read messages are given a mask of the events still in question.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from rsltrace.errors import ConditionError, TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.event import EventFlag, EventKind, Output, OutputKind
from rsltrace.trace.segments import event_of, output_of
from rsltrace.trace.words.logs import log_record
from rsltrace_viewer.model.run import Run, Segment

if TYPE_CHECKING:
    from rsltrace.checks.conditions.trace_events import TraceCondition

Mask = npt.NDArray[np.bool_]
Ids = npt.NDArray[np.uint32]


def ids(found: Iterable[int]) -> Ids:
    """Return entity ids as ``OfEntities`` wants them."""
    return np.array(sorted(found), dtype=np.uint32)


class EventFilter(Protocol):
    """Something an event can fulfil."""

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        """Return which events of ``segment`` fulfil it; only those in ``among`` need an answer."""
        ...

    def can_be_in(self, run: Run, number: int) -> bool:
        """Return False if nothing in segment ``number`` can fulfil it, without reading it."""
        ...


class _Anywhere:
    __slots__ = ()

    def can_be_in(self, run: Run, number: int) -> bool:
        """Return True: only reading the segment tells."""
        return True


@dataclass(frozen=True, slots=True, eq=False)
class OfEntities(_Anywhere):
    """Events of entities in ``ids`` (sorted); with ``outputs`` also those that send from one."""

    ids: Ids
    outputs: bool = False

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found: Mask = np.isin(segment.events["entity"], self.ids)
        if self.outputs:
            outputs = run.segment_outputs(segment.number)
            _set(found, segment, outputs["event"][np.isin(outputs["entity"], self.ids)])
        return found


@dataclass(frozen=True, slots=True, eq=False)
class OfKinds(_Anywhere):
    kinds: npt.NDArray[np.uint8]

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found: Mask = np.isin(segment.events["kind"], self.kinds)
        return found


@dataclass(frozen=True, slots=True)
class WithFlag(_Anywhere):
    flag: EventFlag

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found: Mask = (segment.events["flags"] & np.uint8(int(self.flag))) != 0
        return found


@dataclass(frozen=True, slots=True)
class Silent(_Anywhere):
    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found: Mask = segment.events["outputs"] == 0
        return found


@dataclass(frozen=True, slots=True)
class Between:
    """Events whose ``field`` (``stamp`` or ``index``) is in ``low`` … ``high``, both included."""

    field: str
    low: int
    high: int

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        values = segment.events[self.field]
        found: Mask = (values >= np.uint64(self.low)) & (values <= np.uint64(self.high))
        return found

    def can_be_in(self, run: Run, number: int) -> bool:
        """Compare with the segment's own range."""
        row = run.segments[number]
        if self.field == "stamp":
            first, last = int(row["start_stamp"]), int(row["end_stamp"])
        else:
            first = int(row["first_event"])
            last = first + int(row["events"]) - 1
        return first <= self.high and last >= self.low


@dataclass(frozen=True, slots=True)
class HashBegins(_Anywhere):
    """Events whose input or output hash begins with hex digits."""

    digits: str

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        shift = np.uint64(64 - 4 * len(self.digits))
        wanted = np.uint64(int(self.digits, 16))
        events = segment.events
        found: Mask = np.zeros(len(events), dtype=np.bool_)
        for name in ("input_hash", "output_hash"):
            found |= (events[name] >> shift == wanted) & (events[name] != 0)
        return found


@dataclass(frozen=True, slots=True)
class WithOutput(_Anywhere):
    """Events with an output of some kinds for which ``accept`` (if any) says yes."""

    kinds: frozenset[OutputKind]
    accept: Callable[[Run, Output], bool] | None = None

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        outputs = run.segment_outputs(segment.number)
        of_kind = outputs[np.isin(outputs["kind"], [int(kind) for kind in self.kinds])]
        found = np.zeros(len(segment.events), dtype=np.bool_)
        if self.accept is None:
            _set(found, segment, of_kind["event"])
            return found
        for row in of_kind:
            place = int(row["event"]) - segment.first
            if among[place] and not found[place]:
                found[place] = self.accept(run, output_of(row, run.trace.name))
        return found


@dataclass(frozen=True, slots=True)
class Where(_Anywhere):
    """Events of which a condition is true, in the language of breakpoints and checks."""

    condition: TraceCondition

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        """Return the mask. What it cannot be evaluated of does not fulfil it."""
        outputs = run.segment_outputs(segment.number)
        left: Mask = among.copy()
        if (entities := self.condition.entities) is not None:
            left &= OfEntities(entities, outputs=True).mask(run, segment, among)
        ends = np.searchsorted(outputs["event"], segment.events["index"], side="right").tolist()
        for place in np.flatnonzero(left).tolist():
            begin = ends[place - 1] if place else 0
            own = [output_of(row, run.trace.name) for row in outputs[begin : ends[place]]]
            try:
                left[place] = self.condition.holds(
                    event_of(segment.events[place], run.trace.name), own
                )
            except (ConditionError, TraceError):
                left[place] = False
        return left


@dataclass(frozen=True, slots=True)
class WithFinding:
    """Events in which the guard found something."""

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found = np.fromiter(run.trace.findings, np.uint64, len(run.trace.findings))
        mask: Mask = np.isin(segment.events["index"], found)
        return mask

    def can_be_in(self, run: Run, number: int) -> bool:
        """Most runs have no finding at all."""
        return bool(run.trace.findings)


@dataclass(frozen=True, slots=True)
class Not:
    inner: EventFilter

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        return ~self.inner.mask(run, segment, among)

    def can_be_in(self, run: Run, number: int) -> bool:
        """Return True: what the inner one excludes is wanted here."""
        return True


@dataclass(frozen=True, slots=True)
class All:
    """Events that fulfil all of ``parts``; put the cheap ones first."""

    parts: tuple[EventFilter, ...]

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        left: Mask = among.copy()
        for part in self.parts:
            if not left.any():
                break
            left &= part.mask(run, segment, left)
        return left

    def can_be_in(self, run: Run, number: int) -> bool:
        return all(part.can_be_in(run, number) for part in self.parts)


@dataclass(frozen=True, slots=True)
class Any:
    parts: tuple[EventFilter, ...]

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        found = np.zeros(len(segment.events), dtype=np.bool_)
        for part in self.parts:
            found |= part.mask(run, segment, among & ~found)
        return found

    def can_be_in(self, run: Run, number: int) -> bool:
        return any(part.can_be_in(run, number) for part in self.parts)


def of_nodes(run: Run, owners: frozenset[int]) -> EventFilter:
    """Return the condition of belonging to nodes (by their ids), their constructors included."""
    own = ids(e.id for e in run.entities.values() if e.node in owners)

    def made(run: Run, output: Output) -> bool:
        entity = run.entities.get(output.entity)
        return entity is not None and entity.node in owners

    constructors = OfKinds(np.array([EventKind.CONSTRUCT], dtype=np.uint8))
    making = WithOutput(frozenset((OutputKind.ENTITY,)), made)
    return Any((OfEntities(own), All((constructors, making))))


def log_at_least(level: int) -> WithOutput:
    """Return the condition of a log record of ``level`` (30: warning) or worse."""

    def accept(run: Run, output: Output) -> bool:
        record = log_record(run.trace, output)
        return record is not None and record.level >= level

    return WithOutput(frozenset((OutputKind.LOG,)), accept)


def says(text: str) -> WithOutput:
    """Return the condition of a log, exception or other detail that contains ``text``."""
    folded = text.casefold()
    kinds = frozenset(OutputKind) - {
        OutputKind.MESSAGE,
        OutputKind.REQUEST,
        OutputKind.RESPONSE,
        OutputKind.ENTITY,
    }
    return WithOutput(kinds, lambda run, output: folded in run.words.output(output).casefold())


RAISED: EventFilter = Any(
    (WithFlag(EventFlag.RAISED), WithOutput(frozenset((OutputKind.EXCEPTION,))))
)
GUARD_FINDING: EventFilter = WithFinding()
ANY_LOG: EventFilter = WithOutput(frozenset((OutputKind.LOG,)))


def mask_of(run: Run, condition: EventFilter, number: int) -> tuple[Segment, Mask]:
    """Return segment ``number`` and which of its events fulfil ``condition``."""
    segment = run.segment(number)
    return segment, condition.mask(run, segment, np.ones(len(segment.events), dtype=np.bool_))


def find(run: Run, condition: EventFilter, start: int, step: int) -> Iterator[int | None]:
    """Walk from event ``start`` (which does not count) on, by ``step`` 1 or back by -1.

    Yields None after each segment without a match, so that a caller may stop or show progress,
    and the indexes of the matches, nearest first. Segments that cannot be read count as without.
    """
    if not run.count:
        return
    numbers = range(
        run.segment_of(min(max(start, 0), run.count - 1)),
        len(run.segments) if step > 0 else -1,
        step,
    )
    for number in numbers:
        if not condition.can_be_in(run, number):
            continue
        try:
            segment, mask = mask_of(run, condition, number)
        except TraceError:
            yield None
            continue
        places = np.flatnonzero(mask) + segment.first
        places = places[places > start] if step > 0 else places[places < start][::-1]
        if not len(places):
            yield None
        yield from places.tolist()


def _set(found: Mask, segment: Segment, indexes: npt.NDArray[np.uint64]) -> None:
    found[(indexes - np.uint64(segment.first)).astype(np.intp)] = True
