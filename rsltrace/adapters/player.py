"""The adapter for recordings: publishes messages of bags at their recorded times, without polling.

It knows no client library: a recorded topic has a type by name, and whoever opens it says how the
recorded bytes become canonical CDR.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.errors import BagError
from rsltrace.simulation.loop.loop import ORDER_BAG
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import Publisher, Transport
from rsltrace.simulation.middleware.qos.policies import (
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
)
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import NO_EVENT, EventKind

_BAG = int(EventKind.BAG)
_NAMES = {"reliability": Reliability, "durability": Durability, "history": History}

# (stamp in ns, publisher, serialized message)
Message = tuple[int, "BagPublisher", bytes]


class Player:
    """Publishes a stream of recorded messages, one event each.

    ``name`` says whose they are, for errors. ``on_end`` is called when the last message has been
    published.
    """

    def __init__(
        self, domain: Domain, messages: Iterator[Message], name: str, on_end: Callable[[], None]
    ) -> None:
        self._name = name
        self._dispatcher = domain.dispatcher
        self._messages = messages
        self._on_end = on_end
        self._publisher: BagPublisher
        self._raw = b""
        self._schedule = domain.loop.schedule
        self._hash = hash64 if domain.dispatcher.recorder is not None else _no_hash
        self.played = 0

    def start(self) -> None:
        """Schedule the first message."""
        self._next()

    def _next(self) -> None:
        message = next(self._messages, None)
        if message is None:
            self._on_end()
            return
        stamp_ns, self._publisher, self._raw = message
        self._schedule(stamp_ns, self._publish, order=ORDER_BAG)

    def _publish(self) -> None:
        publisher = self._publisher
        try:
            data = publisher.canonical(self._raw)
        except ValueError as error:
            raise BagError(
                f"message {self.played + 1} of {self._name}, on {publisher.topic}, is not a "
                f"{publisher.type_name}: {error}"
            ) from error
        digest = self._hash(data)
        self._dispatcher.execute(
            publisher,
            publisher.entity_id,
            publisher.node,
            _BAG,
            publisher.send,
            (data, digest),
            NO_EVENT,
            0,
            digest,
        )
        self.played += 1
        self._next()


def _no_hash(data: bytes) -> int:
    return 0


class BagPublisher(Publisher):
    """A recorded topic. It is dispatched by the player only."""

    def __init__(
        self,
        transport: Transport,
        node: Participant,
        topic: str,
        type: MessageType,
        qos: Qos,
        canonical: Callable[[bytes], bytes],
    ) -> None:
        super().__init__(transport, node, topic, type, qos)
        self.canonical = canonical

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")


def make_publisher(
    domain: Domain,
    node: Participant,
    topic: str,
    type: MessageType,
    canonical: Callable[[bytes], bytes],
    qos: dict[str, Any],
) -> BagPublisher:
    """Create the publisher of a recorded topic; ``canonical`` gives canonical CDR, or raises
    ValueError for what is no message of that type."""
    publisher = BagPublisher(domain.transport, node, topic, type, recorded_qos(qos), canonical)
    domain.graph.add_publisher(publisher)
    return publisher


def recorded_qos(values: dict[str, Any]) -> Qos:
    """Return the QoS to offer for a recorded topic; what was not recorded is rclcpp's default.

    A recording often says "unknown" where the middleware did not tell; reliable is then the
    choice that every subscription can connect to.
    """

    def policy(name: str, default: Any) -> Any:
        text = str(values.get(name, "")).upper()
        kind = _NAMES[name]
        found = kind.__members__.get(text)
        usable = found is not None and text not in ("UNKNOWN", "SYSTEM_DEFAULT")
        return found if usable else default

    return Qos(
        history=policy("history", History.KEEP_LAST),
        depth=max(int(values.get("depth") or 10), 1),
        reliability=policy("reliability", Reliability.RELIABLE),
        durability=policy("durability", Durability.VOLATILE),
        deadline_ns=0,
        lifespan_ns=0,
        liveliness=Liveliness.AUTOMATIC,
        lease_ns=0,
    )
