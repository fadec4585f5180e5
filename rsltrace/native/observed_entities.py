"""The entities of a native run: what a trace says of them, found again by rclpy's handles.

They are named as in a simulated run, so that the two can be compared.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.simulation.middleware.interface import MessageType, callback_source
from rsltrace.trace.model.entity import Entity, EntityKind


@dataclass(slots=True)
class ObservedEntity:
    """An entity under observation.

    ``sends`` and ``takes`` say of what types its messages are; ``sequence`` counts what it has
    sent, as the middleware does: only one thread sends, with ``sending``. ``node`` is its node's
    id.
    """

    id: int
    node: int
    kind: EntityKind
    name: str
    sends: MessageType | None = None
    sends_type: Any = None
    takes_type: Any = None
    qos_yaml: str = ""
    gid: bytes = b""
    """A publisher's in the middleware, empty where nobody has asked."""
    sequence: count[int] = field(default_factory=lambda: count(1))
    sending: Any = field(default_factory=threading.RLock, compare=False, repr=False)


class ObservedEntities:
    """Gives out ids, and finds what belongs to one of rclpy's handles or wrappers."""

    def __init__(self, tell: Callable[[Entity], object], ids: count[int] | None = None) -> None:
        self._tell = tell
        self._ids = count(1) if ids is None else ids
        self._lock = threading.Lock()
        self._of: WeakKeyDictionary[Any, ObservedEntity] = WeakKeyDictionary()
        self._news: list[ObservedEntity] | None = None
        self.parts: WeakKeyDictionary[Any, dict[str, ObservedEntity]] = WeakKeyDictionary()
        """The services and topics that an end of an action has, by name."""
        self.rosout: dict[str, ObservedEntity] = {}
        """The publishers of /rosout by the names of loggers."""

    def news(self) -> list[ObservedEntity]:
        """Return what was made since this was asked last; all from the first time on."""
        with self._lock:
            news, self._news = self._news or [], []
        return news

    def find(self, handle: Any) -> ObservedEntity | None:
        """Return what belongs to a handle or wrapper; None if it is not known."""
        return self._of.get(handle)

    def add(
        self,
        keys: tuple[Any, ...],
        node: ObservedEntity | None,
        kind: EntityKind,
        name: str,
        type_name: str = "",
        *,
        runs: object = None,
        **detail: object,
    ) -> ObservedEntity:
        """Make an entity that ``keys`` lead to, and tell the trace of it as an output.

        ``runs`` is the function that its events run.
        """
        number = next(self._ids)
        owner = number if kind is EntityKind.NODE else 0 if node is None else node.id
        entity = ObservedEntity(number, owner, kind, name)
        for key in keys:
            self._of[key] = entity
        with self._lock:
            if self._news is not None:
                self._news.append(entity)
        if source := callback_source(runs):
            detail["source"] = source
        self._tell(Entity(number, owner, kind, name, type_name, 0, detail))
        return entity

    def unnamed(self, wrapper: Any, kind: EntityKind) -> ObservedEntity:
        """Return the entity of a wrapper that is not known (an event handler, say)."""
        found = self._of.get(wrapper)
        if found is not None:
            return found
        name = callback_name(getattr(wrapper, "callback", None)) or type(wrapper).__qualname__
        return self.add((wrapper,), None, kind, name, runs=getattr(wrapper, "callback", None))
