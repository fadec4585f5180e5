"""Play recorded messages into the graph at their recorded times: exact, no polling."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.pubsub import PublisherHandle
from rsltrace.doors.rclpy.wire.interfaces import get_message_class
from rsltrace.errors import BagError, SetupError
from rsltrace.loop.loop import ORDER_BAG
from rsltrace.middleware.qos import Durability, History, Liveliness, Qos, Reliability
from rsltrace.model.event import NO_EVENT, EventKind
from rsltrace.trace.chain import hash64

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core

_BAG = int(EventKind.BAG)
_NAMES = {"reliability": Reliability, "durability": Durability, "history": History}

# (stamp in ns, publisher, serialized message)
Message = tuple[int, "BagPublisher", bytes]


class Player:
    """Publishes a stream of recorded messages, one event each.

    ``on_end`` is called when the last message has been published.
    """

    def __init__(self, core: Core, messages: Iterator[Message], on_end: Callable[[], None]) -> None:
        self._core = core
        self._messages = messages
        self._on_end = on_end
        self._publisher: BagPublisher
        self._raw = b""
        self._schedule = core.loop.schedule
        self._hash = hash64 if core.recorder is not None else _no_hash
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
            data = publisher._canonical(self._raw)
        except ValueError as error:
            raise BagError(
                f"message {self.played + 1} of the bag, on {publisher.topic}, is not a "
                f"{publisher.type_name}: {error}"
            ) from error
        digest = self._hash(data)
        self._core.execute(
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


class BagPublisher(PublisherHandle):
    """A recorded topic. It is dispatched by the player only."""

    def dispatch(self) -> None:
        raise AssertionError("never in a queue")


def check_type(*, bag: str, topic: str, type_name: str) -> type:
    """Return the message class of a recorded topic.

    :raises BagError: if its type is not installed.
    """
    try:
        return get_message_class(type_name)
    except SetupError as error:
        raise BagError(
            f"{bag}: topic {topic} has type {type_name}, which is not installed here. Install its "
            f"package, or leave the topic out (exclude: [{topic}])\n  {error}"
        ) from error


def begins_with_header(message_class: Any) -> bool:
    """Return whether the first field of a message is a ``std_msgs/Header``."""
    fields = message_class.get_fields_and_field_types()
    return next(iter(fields.values()), "") == "std_msgs/Header"


def make_publisher(
    core: Core,
    node: NodeHandle,
    *,
    bag: str,
    topic: str,
    type_name: str,
    qos: dict[str, Any],
) -> BagPublisher:
    """Create the publisher of a recorded topic."""
    message_class = check_type(bag=bag, topic=topic, type_name=type_name)
    return BagPublisher(core, node, message_class, topic, recorded_qos(qos))


def progress_publisher(core: Core, node: NodeHandle, topic: str) -> BagPublisher:
    """Create the publisher of the player's progress, a Float32."""
    return BagPublisher(
        core, node, get_message_class("std_msgs/msg/Float32"), topic, recorded_qos({})
    )


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
