"""Subscriptions: published messages wait in their queue until their callback runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Final

from rsltrace.simulation.middleware.entity import DomainEntity, Receiver, callback_name
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.simulation.middleware.qos.policies import Qos
from rsltrace.simulation.middleware.qos.timing import DeadlineTimer, EndpointEvents, finite
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind

SUBSCRIPTION = int(EventKind.SUBSCRIPTION)

Delivery = tuple[int, int, int, Any, bytes, int, int, int, int, int]
"""A message on its way. It is a plain tuple like the loop's releases, because one is made for each
message and subscription, and the loop sorts them. Its positions have names; hot paths unpack it."""
RECEIVED_NS: Final = 0  # reception stamp
DATA: Final = 4  # canonical CDR; before it are order, place and receiver, as in the loop's releases
EVENT: Final = 5  # index of the publishing event
OUTPUT: Final = 6  # which of its outputs
DIGEST: Final = 7  # hash of the content
SENT_NS: Final = 8  # publication stamp
NUMBER: Final = 9  # publication number


class Subscription(Receiver):
    """Receives a topic; ``callback`` is called with each message's bytes.

    A full queue drops its oldest message. ``qos`` is resolved, ``publishers`` are connected;
    ``timed``: its QoS depends on time.
    """

    kind = EntityKind.SUBSCRIPTION
    origin = slice(EVENT, SENT_NS)

    def __init__(
        self,
        dispatcher: Dispatcher,
        node: Any,
        topic: str,
        type: MessageType,
        qos: Qos,
        callback: Callable[[bytes], object] | None = None,
    ) -> None:
        super().__init__(dispatcher, node)
        self.topic = topic
        self.type = type
        self.qos = qos
        self.callback = callback
        self.keep = None if dispatcher.loop.keeps_all else qos.keep
        self.queue: deque[Delivery] = deque(maxlen=self.keep)
        self.timed = any(map(finite, (qos.deadline_ns, qos.lifespan_ns, qos.lease_ns)))
        self.publishers: list[DomainEntity] = []
        self.events = EndpointEvents()
        self.deadline: DeadlineTimer | None = None
        if finite(qos.deadline_ns):
            self.deadline = DeadlineTimer(dispatcher.loop, qos.deadline_ns, self.events)

    @property
    def type_name(self) -> str:
        return self.type.name

    def dispatch(self) -> None:
        if not self.may_run():
            return
        assert self.callback is not None
        _, _, _, _, data, *cause, _, _ = self.queue.popleft()
        self.dispatcher.execute(
            self, self.entity_id, self.node, SUBSCRIPTION, self.callback, (data,), *cause
        )

    def trace_name(self) -> str:
        return self.topic

    def trace_type(self) -> str:
        return self.type.name

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(self.user_callback()), "qos": self.qos.summary()}

    def _destroy(self) -> None:
        super()._destroy()
        self.queue.clear()
        if self.deadline is not None:
            self.deadline.over = True
