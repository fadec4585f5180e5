"""The book of entities: their ids, and when the trace is told of each."""

from __future__ import annotations

from typing import Any, Protocol

from rsltrace.simulation.middleware.events.census import Census
from rsltrace.simulation.middleware.events.observer import EventObserver
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.recorder import Recorder


class Recordable(Protocol):
    """Something that has an id in the trace. ``announced`` says whether the trace is told of it."""

    announced: bool

    def settle(self) -> bool:
        """Return whether its owner is known by now."""

    def entity(self) -> Entity:
        """Return it as the trace describes it."""


class EntityBook:
    """Gives out ids, and keeps what has been created until it can be written down.

    ``pending`` was created in the event under way, ``unowned`` still has no owner (a timer that no
    node lists yet). ``census`` is that of the run, if it has one; ``observers`` are told
    of each entity.
    """

    def __init__(self) -> None:
        self.pending: list[Recordable] = []
        self.unowned: list[Recordable] = []
        self.census: Census | None = None
        self.observers: tuple[EventObserver, ...] = ()
        self._count = 0

    def new_id(self) -> int:
        """Return the next entity id; 0 is the run itself."""
        self._count += 1
        return self._count

    def settle(self, recorder: Recorder | None) -> None:
        """Write down the entities created in this event, now that their owners are known."""
        waiting, self.unowned = self.unowned, []
        created = [*waiting, *self.pending]
        self.pending.clear()
        for one in created:
            if not one.settle():
                self.unowned.append(one)
            elif one.announced and (recorder is not None or self.observers):
                entity = one.entity()
                if recorder is not None:
                    recorder.entity(entity)
                for observer in self.observers:
                    observer.entity_created(entity)

    def look_again(self, node: Any) -> None:
        """Write down in this event what of ``node`` has waited for an owner."""
        if self.unowned:  # a timer made long before its node is spun is written down now
            waiting, self.unowned = self.unowned, []
            for one in waiting:
                owned = getattr(one, "node", None) is node
                (self.pending if owned else self.unowned).append(one)
