"""The policy ``recorded`` of a native run: what ran next there runs next, where it can.

A native run does not do the same again: its timers drift, its messages take their time. So its
order is a wish. Callbacks are the same if their names are, and if each is the one of that number:
the third of a timer is the third of it there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from rsltrace.simulation.loop.policy import Candidate, Moment
from rsltrace.simulation.loop.recorded import RecordedEvent, has_event
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.stamp import format_seconds

CALLBACKS = frozenset(
    map(int, (EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT))
)
"""What has a place in the order; everything else runs as soon as it can."""


class ObservedCallback(NamedTuple):
    """A callback of the native run: which of its events, and what ran."""

    number: int
    event: RecordedEvent


class ObservedOrder:
    """The order of a native run, as far as it can be followed.

    Who is ready before its turn is held back until those are ready that came before, but no longer
    than until the time at which it ran itself, counted from the first callback of both runs.
    ``name_of`` returns the name of an entity of this run, by its id.
    """

    def __init__(
        self, file: str, observed: Sequence[ObservedCallback], name_of: Callable[[int], str | None]
    ) -> None:
        self.file = file
        self.name_of = name_of
        self._observed = observed
        self._places: dict[str, list[int]] = {}
        for place, one in enumerate(observed):
            self._places.setdefault(one.event.name, []).append(place)
        self._counts: dict[str, int] = {}
        self._next = 0
        self._ahead_ns: int | None = None
        self._ran = bytearray(len(observed))
        self._in_turn = self._late = self._others = 0
        self._first: tuple[ObservedCallback, str] | None = None

    def hold_until(self, ready: Sequence[Candidate], moment: Moment) -> int | None:
        """Return until when all that is ready is to wait for who comes before; None: one runs."""
        places = [self._place(one) for one in ready]
        first = min(place for place in places if place is not None) if all_known(places) else None
        if first is None or first <= self._next or self._ahead_ns is None:
            return None
        until_ns = self._observed[first].event.stamp_ns - self._ahead_ns
        return until_ns if until_ns > moment.now_ns else None

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        places = [self._place(one) for one in ready]
        if self._next in places:
            return places.index(self._next)
        if None in places:
            return places.index(None)
        return min(range(len(ready)), key=lambda index: places[index] or 0)

    def happened(self, kind: int, entity: int, now_ns: int) -> None:
        """Take note of an event of this run that is over."""
        name = self.name_of(entity)
        if kind not in CALLBACKS or name is None:
            return
        place = self._place_of(name)
        self._counts[name] = self._counts.get(name, 0) + 1
        if place is None:
            self._others += 1
            return
        if self._ahead_ns is None:
            self._ahead_ns = self._observed[place].event.stamp_ns - now_ns
        self._ran[place] = True
        if place < self._next:
            self._late += 1
            return
        self._in_turn += 1
        if place > self._next and self._first is None:
            missed = self._observed[self._next]
            self._first = missed, self._why(missed, name, now_ns)
        self._next = place + 1

    def _why(self, missed: ObservedCallback, name: str, now_ns: int) -> str:
        """Say why what was missed did not run before an event of that name."""
        there = sum(place < self._next for place in self._places[missed.event.name])
        return (
            f"its run number {there + 1} was not ready here, and {name}, which came after it, did "
            f"not wait any longer than until {format_seconds(now_ns)} s"
        )

    def _place(self, candidate: Candidate) -> int | None:
        if candidate.kind == "resume" or not has_event(candidate.item):
            return None
        name = self.name_of(candidate.entity_id)
        return None if name is None else self._place_of(name)

    def _place_of(self, name: str) -> int | None:
        places, count = self._places.get(name, ()), self._counts.get(name, 0)
        return places[count] if count < len(places) else None

    def notes(self) -> Iterator[str]:
        """Yield how far the order was followed, and where first it was not."""
        count, end = self._next, len(self._observed)
        missing = count - sum(self._ran)
        if self._in_turn == count and not self._others:
            what = "all" if count == end else f"the first {count} of {end}"
            yield f"{what} callbacks of {self.file} ran in its order"
            return
        rest = "" if count == end else f" before this run ended (it has {end})"
        yield (
            f"of {count} callbacks of {self.file}{rest} {self._in_turn} ran in its order, "
            f"{self._late} after others that they came before, {missing} not at all; "
            f"{self._others} ran that it does not have"
        )
        if self._first is not None:
            missed, why = self._first
            yield (
                f"the first that could not run in its turn is event {missed.number}, "
                f"{missed.event}: {why}"
            )


def all_known(places: Sequence[int | None]) -> bool:
    """Whether all have a place."""
    return None not in places
