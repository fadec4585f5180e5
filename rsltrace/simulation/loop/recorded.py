"""The policy ``recorded``: what a recording ran next runs next, event by event."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rsltrace.errors import RunError
from rsltrace.simulation.loop.policy import Candidate, Moment
from rsltrace.simulation.loop.search_policies import After
from rsltrace.simulation.loop.wait_set import RclpyWaitSet
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.stamp import format_seconds

THE_RUN = "the run"
"""The name of entity 0."""

_OF_THE_RUN = {
    int(EventKind.CONSTRUCT): "the construction of a node",
    int(EventKind.CLOCK_JUMP): "the jump to the start",
    int(EventKind.OUTSIDE): "something that the run was told from outside",
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


def described(entity: Entity, node: str) -> str:
    """Name an entity, of the node of that name, as ``RecordedEvent.name`` does."""
    if entity.kind is EntityKind.SYSTEM:
        return THE_RUN
    what = f"{entity.kind.label} {entity.name}"
    return f"{node}: {what}" if node else what


def event_text(kind: int, name: str, stamp_ns: int) -> str:
    """Describe an event for people; ``name`` is that of the entity."""
    if name == THE_RUN:
        name = _OF_THE_RUN.get(kind, name)
    if kind == EventKind.FAULT:
        name = f"a fault of {name}"
    goes_on = ", which goes on," if kind == EventKind.RESUME else ""
    return f"{name}{goes_on} at {format_seconds(stamp_ns)} s"


class Recorded:
    """The order of a recording.

    ``event`` returns the recording's event of an index, or None after its end; from there on it is
    first come, first served. Entities are the same if their names are: ``name_of`` returns the name
    of one of this run, by its id. ``chosen`` chooses as the recording's own policy did: then the
    run is the recording's as long as it does the same, which whoever ends the events has to
    look at (``simulation/middleware/events/recorded_run.py``). Where nobody knows what it chose (None) the
    events are all there is, and what has none of its own, see ``choices.py``, runs as it comes.

    :raises RunError: from ``choose``, if what the recording has next cannot run now.
    """

    follows_chains = True
    """Its policy may have gone by the periods of chains."""

    def __init__(
        self,
        file: str,
        event: Callable[[int], RecordedEvent | None],
        chosen: Callable[[Sequence[Candidate], Moment], int | None] | None,
        name_of: Callable[[int], str | None],
    ) -> None:
        self.file = file
        self.event = event
        self.name_of = name_of
        self._chosen = chosen
        self.polls_from_ns: int | None = None
        self.forget: Callable[[str], None] | None = None

    def poll_as(self, policy: RclpyWaitSet | After) -> None:
        """Have executors poll as in the recording: of that policy's choices, all follow from what
        has happened."""
        self._chosen = policy.choose
        self.polls_from_ns, self.forget = policy.polls_from_ns, policy.forget

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
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
        self, ready: Sequence[Candidate], moment: Moment, expected: RecordedEvent
    ) -> RunError:
        names = ", ".join(f"{c.node}: {c.kind} {c.entity}" for c in ready[:_SHOWN])
        more = ", …" if len(ready) > _SHOWN else ""
        here = f"here at {format_seconds(moment.now_ns)} s ready are {names}{more}"
        return self.cannot_follow(moment.events, expected, here)

    def cannot_follow(self, index: int, expected: RecordedEvent, here: str) -> RunError:
        """Return the error that this run does not do what the recording did."""
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
    """Say whether there is an event if something runs.

    There is none if a full queue has dropped the message it stood for, if an executor of the user's
    own is only told of it, or if somebody wakes who may just go on waiting.
    """
    node = getattr(item, "node", None)
    is_told = getattr(node, "mailbox", None) is not None
    is_there = bool(getattr(item, "queue", True)) and not getattr(item, "destroyed", False)
    return is_there and not is_told and not getattr(item, "quiet", False)
