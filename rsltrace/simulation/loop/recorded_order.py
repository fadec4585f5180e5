"""The policy ``recorded``: repeats the order of a recording, event by event."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from rsltrace.errors import RunError
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint, FifoUntil
from rsltrace.simulation.loop.wait_set import RclpyWaitSetPolicy
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import format_seconds

THE_RUN = "the run"
"""The name of entity 0."""

_OF_THE_RUN = {
    int(EventKind.CONSTRUCT): "the construction of a node",
    int(EventKind.CLOCK_JUMP): "the jump to the start",
    int(EventKind.OUTSIDE): "an event from outside of the run",
}
_SHOWN = 5


class RecordedEvent(NamedTuple):
    """One event of the recording: when, of which kind, and what ran (id, and name for people)."""

    stamp_ns: int
    kind: int
    entity_id: int
    name: str

    def __str__(self) -> str:
        return event_text(self.kind, self.name, self.stamp_ns)


def entity_text(entity: Entity, node: str) -> str:
    """Name an entity of a node, as in ``RecordedEvent.name``."""
    if entity.kind is EntityKind.SYSTEM:
        return THE_RUN
    what = f"{entity.kind.label} {entity.name}"
    return f"{node}: {what}" if node else what


def event_text(kind: int, name: str, stamp_ns: int) -> str:
    """Describe an event for people; ``name`` is its entity's."""
    if name == THE_RUN:
        name = _OF_THE_RUN.get(kind, name)
    if kind == EventKind.FAULT:
        name = f"a fault of {name}"
    goes_on = ", which goes on," if kind == EventKind.RESUME else ""
    return f"{name}{goes_on} at {format_seconds(stamp_ns)} s"


class RecordedOrder:
    """The order of a recording.

    ``event`` returns the recorded event of an index, or None after the end; from there on it is
    first come, first served. ``name_of`` returns the name of an entity of this run; entities with
    equal names are the same. ``chosen`` repeats the choices of the recording's policy;
    ``RecordedOrderObserver`` then checks the events. Without it (None) only events are known, and
    what has no event runs as it comes.

    :raises RunError: from ``choose``, if the next recorded event cannot run now.
    """

    follows_chains = True
    """Its policy may have gone by the periods of chains."""

    def __init__(
        self,
        file: str,
        event: Callable[[int], RecordedEvent | None],
        chosen: Callable[[Sequence[Candidate], ChoicePoint], int | None] | None,
        name_of: Callable[[int], str | None],
    ) -> None:
        self.file = file
        self.event = event
        self.name_of = name_of
        self._chosen = chosen
        self.polls_from_ns: int | None = None
        self.forget: Callable[[str], None] | None = None

    def poll_as(self, policy: RclpyWaitSetPolicy | FifoUntil) -> None:
        """Let executors poll as in the recording: this policy's choices follow from the events."""
        self._chosen = policy.choose
        self.polls_from_ns, self.forget = policy.polls_from_ns, policy.forget

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        chosen = None if self._chosen is None else self._chosen(ready, moment)
        expected = self.event(moment.events)
        if expected is None:
            return 0
        if chosen is not None:
            if chosen < len(ready):
                return chosen
            raise self._cannot_choose(ready, moment, expected)
        fitting = [index for index, one in enumerate(ready) if self._is(one, expected)]
        if fitting:
            same = (index for index in fitting if ready[index].entity_id == expected.entity_id)
            return next(same, fitting[0])
        for index, candidate in enumerate(ready):
            if not has_event(candidate.item):
                return index
        raise self._cannot_choose(ready, moment, expected)

    def _cannot_choose(
        self, ready: Sequence[Candidate], moment: ChoicePoint, expected: RecordedEvent
    ) -> RunError:
        names = ", ".join(f"{c.node}: {c.kind} {c.entity}" for c in ready[:_SHOWN])
        more = ", …" if len(ready) > _SHOWN else ""
        here = f"here at {moment.seconds} s ready are {names}{more}"
        return self.cannot_follow(moment.events, expected, here)

    def cannot_follow(self, index: int, expected: RecordedEvent, here: str) -> RunError:
        """Return the error that this run differs from the recording."""
        why = "Nodes, job or input differ from those of the recording"
        if self._chosen is None:
            why += ", or its events are not enough: what its policy chose is not in it (cut off?)"
        return RunError(
            f"the recorded order of {self.file} cannot be followed: its event {index} is "
            f"{expected}, but {here}. {why}; `rsltrace diff` of the two traces shows where"
        )

    def _is(self, candidate: Candidate, expected: RecordedEvent) -> bool:
        goes_on = candidate.kind == "resume"
        if goes_on != (expected.kind == EventKind.RESUME) or not has_event(candidate.item):
            return False
        return self.name_of(candidate.entity_id) == expected.name


def has_event(item: Any) -> bool:
    """Whether running an item makes an event.

    It makes none if a full queue has dropped its message, if it is only handed to one of the user's
    own executors, or if it wakes a call that may continue to wait.
    """
    node = getattr(item, "node", None)
    is_handed_over = getattr(node, "mailbox", None) is not None
    is_there = bool(getattr(item, "queue", True)) and not getattr(item, "destroyed", False)
    return is_there and not is_handed_over and not getattr(item, "quiet", False)


# The order of a native run can only be followed approximately: its timers drift, its messages take
# time. Callbacks correspond by name and number: a timer's third call there is its third call here.

CALLBACKS = frozenset(
    map(int, (EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT))
)
"""Events with a place in the order; all others run as soon as they can."""


class NativeCallback(NamedTuple):
    """A callback of the native run and the number of its event."""

    number: int
    event: RecordedEvent


class NativeOrder:
    """The order of a native run, followed as far as possible.

    A callback that is ready early waits for those before it, but no longer than until its own time
    in the native run, counted from the first callback of both runs. ``name_of`` returns the name of
    an entity of this run.
    """

    def __init__(
        self, file: str, observed: Sequence[NativeCallback], name_of: Callable[[int], str | None]
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
        self._first: tuple[NativeCallback, str] | None = None

    def hold_until(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int | None:
        """Return until when all that is ready waits for earlier callbacks; None: run one now."""
        places = [self._place(one) for one in ready]
        first = (
            min(place for place in places if place is not None) if all_have_places(places) else None
        )
        if first is None or first <= self._next or self._ahead_ns is None:
            return None
        until_ns = self._observed[first].event.stamp_ns - self._ahead_ns
        return until_ns if until_ns > moment.now_ns else None

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        places = [self._place(one) for one in ready]
        if self._next in places:
            return places.index(self._next)
        if None in places:
            return places.index(None)
        return min(range(len(ready)), key=lambda index: places[index] or 0)

    def happened(self, kind: int, entity: int, now_ns: int) -> None:
        """Note an event of this run."""
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

    def _why(self, missed: NativeCallback, name: str, now_ns: int) -> str:
        """Say why the missed callback did not run before an event of that name."""
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
        """Yield how far the order was followed, and where it first was not."""
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


def all_have_places(places: Sequence[int | None]) -> bool:
    return None not in places
