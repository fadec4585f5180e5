"""Seeing the first output that is not as recorded when it comes about, and ending the run there."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rsltrace.replay.one_node.outputs import Put
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import OutputKind

if TYPE_CHECKING:
    from rsltrace.run.session import Session
    from rsltrace.simulation.loop.loop import EventLoop

_SENT = frozenset(
    map(int, (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG))
)


class Watch(EventObserver):
    """Compares the outputs of ``node`` with ``recorded`` ones, and ends the run with ``stop``."""

    order = ObserverOrder.OUTPUTS

    def __init__(self, recorded: Sequence[Put], node: str, stop: Stop) -> None:
        self._stop = stop
        self._node = node
        self._own: dict[int, str] = {}
        self._nodes: set[int] = set()
        self._in_order = deque(put for put in recorded if put.key[0] is not OutputKind.EXCEPTION)
        self._expected: dict[tuple[int, str], deque[Put]] = {}
        for put in self._in_order:
            self._expected.setdefault((int(put.key[0]), put.key[1]), deque()).append(put)
        self._met: set[int] = set()
        self._sent: list[tuple[int, int, int]] = []
        self._loop: EventLoop

    def attach(self, session: Session) -> None:
        """Compare what comes from now on."""
        self._loop = session.loop
        session.world.domain.dispatcher.add_observer(self)

    def entity_created(self, entity: Entity) -> None:
        """Remember the node and what belongs to it."""
        if entity.node == entity.id and entity.name == self._node:
            self._nodes.add(entity.id)
        if entity.node in self._nodes:
            self._own[entity.id] = entity.name

    def output(self, kind: int, entity: int, content_hash: int) -> None:
        """Keep what is sent until the event is over."""
        if kind in _SENT:
            self._sent.append((kind, entity, content_hash))

    def after_event(self) -> None:
        """End the run if the outputs of the event were not as recorded."""
        if not self._as_recorded(self._loop.now_ns):
            self._loop.stop(self._stop)

    def _as_recorded(self, now_ns: int) -> bool:
        """Return whether what an event has sent was recorded, and nothing is missing until now."""
        sent, self._sent = self._sent, []
        for kind, entity, content_hash in sent:
            name = TOPIC_ROSOUT if kind == OutputKind.LOG else self._own.get(entity)
            if entity not in self._own or name is None:
                continue
            expected = self._expected.get((kind, name))
            if not expected:
                return False
            put = expected.popleft()
            self._met.add(put.place)
            if put.stamp_ns != now_ns or put.output.hash != content_hash:
                return False
        waiting = self._in_order
        while waiting and waiting[0].place in self._met:
            self._met.discard(waiting.popleft().place)
        return not waiting or waiting[0].stamp_ns >= now_ns
