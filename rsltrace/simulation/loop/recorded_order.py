"""The policy ``recorded``: repeats the order of a recording, event by event."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.loop.ordered import OrderedLoop, ReadyItem
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint, FifoUntil
from rsltrace.simulation.loop.timer_queue import NEVER_NS, TimerState
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


# A native run says when each callback began, and with which message. Callbacks run in that order
# and at those times: timers when they ran, not when they are due. Callbacks that overlapped run one
# after the other, in the order of their starts.

CALLBACKS = frozenset(
    map(int, (EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT))
)
"""Events with a place in the order; all others run as soon as they can."""

Message = tuple[str, int]
"""A message, request or response: the name of its sender, and its number, counted from 1."""

_CALLBACK_KINDS = frozenset(("timer", "subscription", "service", "client"))
_PATIENCE_NS = 100_000_000
"""How long a callback is waited for that cannot run in its turn, in simulated time."""


@dataclass(slots=True)
class NativeStep:
    """A callback of the native run, or (``perform``) what a node sent that does not run here.

    ``name`` is that of its entity, ``message`` what it got, None if that is unknown.
    """

    number: int
    stamp_ns: int
    kind: int
    name: str
    message: Message | None = None
    input_hash: int = 0
    perform: Callable[[], None] | None = None

    def __str__(self) -> str:
        got = (
            "" if self.message is None else f" with message {self.message[1]} of {self.message[0]}"
        )
        return f"event {self.number}, {self.name}{got}"


class NativeOrder:
    """The order of a native run, which ended before ``end_ns``, or is left then, ``until`` a time.

    What it has of this run is known by ``names``: a unique one for each entity, by its id.
    """

    def __init__(
        self, file: str, end_ns: int, names: Mapping[int, str], until: str | None = None
    ) -> None:
        self.file = file
        self.until = until
        self.end_ns = end_ns
        self._names = names
        self._steps: Iterator[NativeStep] = iter(())
        self._known: Mapping[str, int] = {}
        self.next: NativeStep | None = None
        """The first callback that has not run."""
        self.sent: dict[tuple[int, int], tuple[int, int]] = {}
        """By event and output of this run: the entity that sent, and the number of its message."""
        self._taken: set[tuple[str, Message | None]] = set()
        self._late: set[Message] = set()
        self._count = self._followed = 0
        self._first: tuple[NativeStep, str] | None = None

    def begin(self, steps: Iterable[NativeStep], known: Mapping[str, int]) -> Sequence[NativeStep]:
        """Follow ``steps``; return those that come too late. ``known`` are the entities of the
        native run and how much each sent."""
        every = tuple(steps)
        self._taken = {(one.name, one.message) for one in every}
        left = self.until is not None
        following = [one for one in every if not left or one.stamp_ns < self.end_ns]
        self._steps, self._known = iter(following), known
        self.next = next(self._steps, None)
        return [one for one in every if left and one.stamp_ns >= self.end_ns]

    def done(self) -> None:
        """Go on to the next callback."""
        assert self.next is not None
        if self.next.perform is None:
            self._count += 1
            self._followed += 1
        self.next = next(self._steps, None)

    def skip(self) -> None:
        """Go on to the next callback: this one cannot run."""
        step = self.next
        assert step is not None
        if self._first is None:
            self._first = step, self._why_not(step)
        if step.message is not None:
            self._late.add(step.message)
        self._count += 1
        self.next = next(self._steps, None)

    def _why_not(self, step: NativeStep) -> str:
        if step.name not in self._names.values():
            return "there is none here"
        if step.kind == EventKind.TIMER:
            return "it was cancelled or destroyed here"
        if step.message is None:
            return "nothing with that content was sent here"
        sent = step.message in map(self._message, self.sent)
        return "it did not get that message here" if sent else "that message was not sent here"

    def loses(self, candidate: Candidate) -> bool:
        """Drop a message from its queue that its callback did not get in the native run; return
        whether there was one."""
        name, item = self._names.get(candidate.entity_id, ""), candidate.item
        if name not in self._known or (name, None) in self._taken:
            return False
        for place, sent in self._arrivals(item):
            if not ((name, sent) in self._taken or self._is_new(sent)):
                del item.queue[place]
                return True
        return False

    def holds(self, candidate: Candidate) -> bool:
        """Whether something runs in its turn only: a callback that the native run has, too, and
        what it got there."""
        if candidate.kind not in _CALLBACK_KINDS:
            return False
        if self._names.get(candidate.entity_id) not in self._known:
            return False
        for place, sent in self._arrivals(candidate.item):
            if self._is_new(sent):
                _to_front(candidate.item.queue, place)
                return False
        return True

    def _arrivals(self, item: Any) -> Iterator[tuple[int, Message]]:
        """Yield what waits in the queue of a callback, and where."""
        for place, arrival in enumerate(getattr(item, "queue", ())):
            sent = self._message(arrival[item.origin][:2])
            if sent is not None:
                yield place, sent

    def _is_new(self, sent: Message) -> bool:
        """Whether a message has no turn (any more)."""
        return sent in self._late or sent[1] > self._known.get(sent[0], 0)

    def is_next(self, candidate: Candidate) -> bool:
        """Whether the next callback is this one; its message is then the first in its queue."""
        step = self.next
        assert step is not None
        item = candidate.item
        if self._names.get(candidate.entity_id) != step.name:
            return False
        if step.kind == EventKind.TIMER:
            return True
        for place, arrival in enumerate(item.queue):
            *cause, digest = arrival[item.origin]
            sent = self._message(tuple(cause))
            if sent == step.message or (step.message is None and digest == step.input_hash):
                _to_front(item.queue, place)
                return True
        return False

    def _message(self, cause: tuple[int, int]) -> Message | None:
        sent = self.sent.get(cause)
        return None if sent is None else (self._names.get(sent[0], ""), sent[1])

    def notes(self) -> Iterator[str]:
        """Yield how far the order was followed, and where it first was not."""
        count = self._count + sum(one.perform is None for one in self._left())
        of = self.file if self.until is None else f"{self.file} up to {self.until} s"
        if self._followed == count:
            yield f"all {count} callbacks of {of} ran in its order"
            return
        if self._first is None:  # the run ended before
            yield f"the first {self._followed} of {count} callbacks of {of} ran in its order"
            return
        step, why = self._first
        yield f"of {count} callbacks of {of} {self._followed} ran in its order"
        yield f"the first that did not is {step}: {why}"

    def _left(self) -> Iterator[NativeStep]:
        if self.next is not None:
            yield self.next
            yield from self._steps


def _to_front(queue: deque[Any], place: int) -> None:
    arrival = queue[place]
    del queue[place]
    queue.appendleft(arrival)


class NativeOrderLoop(OrderedLoop):
    """The loop of a run that follows a recording; ``order`` is that of a native run, or None."""

    order: NativeOrder | None = None
    _missed = (-1, -1)

    @property
    def keeps_all(self) -> bool:  # type: ignore[override]
        """Whether queues drop nothing: the native run says what was lost."""
        return self.order is not None

    @property
    def following(self) -> NativeOrder | None:
        """The order as long as it says what runs."""
        order = self.order
        if order is None or (order.next is None and self.now_ns >= order.end_ns):
            return None
        return order

    def next_timer(self) -> TimerState | None:
        """Return the next timer that does not wait for its turn."""
        order = self.following
        if order is None:
            return super().next_timer()
        places = ((one, self.place(one.owner)) for one in self._all_timers())  # type: ignore[arg-type]
        return next((one for one, place in places if not order.holds(place.candidate)), None)

    def next_ns(self) -> int | None:
        own_ns, order = super().next_ns(), self.following
        if order is None:
            return own_ns
        at_ns = order.end_ns if order.next is None else order.next.stamp_ns
        if at_ns <= self.now_ns:
            at_ns = self.now_ns if self._is_overdue(order) else at_ns + _PATIENCE_NS
        return at_ns if own_ns is None else min(own_ns, at_ns)

    def stepped(self, next_ns: int, end_ns: int) -> int:
        """Return the next time: that of the native run as long as it is followed; once it is left,
        the end of a step, of those that follow each other from then on."""
        order = self.order
        if order is None or order.until is None:
            return super().stepped(next_ns, end_ns)
        if self.following is not None:
            return next_ns
        step_ns = next_ns + (order.end_ns - next_ns) % self.min_step_ns
        return min(step_ns, max(end_ns, next_ns))

    def _all_timers(self) -> list[TimerState]:
        return self.timers.due(NEVER_NS)[0]

    def _is_overdue(self, order: NativeOrder) -> bool:
        """Whether nothing can happen that the next callback could still wait for."""
        own_ns = super().next_ns()
        return order.next is None or own_ns is None or own_ns > order.next.stamp_ns + _PATIENCE_NS

    def _next(self) -> ReadyItem | None:
        order = self.following
        if order is None or self._forced is not None:
            return super()._next()
        for place in self.runnable():
            if order.loses(place.candidate):
                self._take_out(place)
            elif not order.holds(place.candidate):
                self._take_out(place)
                return place
        while (step := order.next) is not None and step.stamp_ns <= self.now_ns:
            if step.perform is not None:
                order.done()
                step.perform()
                return self._next()
            place_or_none = self._awaited(order, step)
            if place_or_none is not None:
                order.done()
                return place_or_none
            if self._missed != (step.number, self.events) or not self._is_overdue(order):
                self._missed = step.number, self.events
                return None
            order.skip()
        return None

    def _awaited(self, order: NativeOrder, step: NativeStep) -> ReadyItem | None:
        """Return the next callback of the native run if it can run."""
        if step.kind != EventKind.TIMER:
            for place in self._ready.runnable():
                if order.is_next(place.candidate):
                    self._take_out(place)
                    return place
            return None
        for timer in self._all_timers():
            place = self.place(timer.owner)  # type: ignore[arg-type]
            if order.is_next(place.candidate) and self._runs(place):
                timer.deadline_ns = self.now_ns  # as natively, it is due when it runs
                return place
        return None
