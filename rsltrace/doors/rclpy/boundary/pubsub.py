"""Publishers and subscriptions: a publication is serialized once and delivered in this process."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.callback_groups import begin
from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle, Receiver, callback_name
from rsltrace.doors.rclpy.stacks.blocking_calls import wait
from rsltrace.doors.rclpy.stacks.tasks import is_coroutine_function, start_coroutine
from rsltrace.doors.rclpy.wire.codec import codec_for
from rsltrace.doors.rclpy.wire.interfaces import schema_text, type_hash
from rsltrace.errors import UnsupportedError
from rsltrace.middleware.endpoint_status import EndpointEvents
from rsltrace.middleware.links import Link
from rsltrace.middleware.qos import Durability, Qos, Reliability
from rsltrace.middleware.qos_timing import Deadline, Offers, finite
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.trace.chain import hash64

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core

_SUBSCRIPTION = int(EventKind.SUBSCRIPTION)
_MESSAGE = int(OutputKind.MESSAGE)

# A message on its way, as the loop's releases are: reception stamp (ns), order and place in the
# loop's queue, who is called; then canonical CDR, index of the publishing event, which of its
# outputs, content hash, publication stamp (ns), publication number.
Delivery = tuple[int, int, int, Any, bytes, int, int, int, int, int]


class PublisherHandle(EntityHandle):
    """Stands in for ``_rclpy.Publisher``.

    ``subscriptions`` are the connected ones in creation order; ``links`` lead to them in a job
    with delay models, and are None in others.
    """

    kind = EntityKind.PUBLISHER
    lists = "publishers"
    output_kind = _MESSAGE

    def __init__(self, core: Core, node: NodeHandle, msg_type: Any, topic: str, qos: Any) -> None:
        self.topic = node.resolve(topic, service=False)
        codec = codec_for(msg_type)
        self.type_name = codec.type_name
        self.msg_type = msg_type
        self._serialize = codec.serialize
        self._canonical = codec.canonical
        peers = [s.qos for s in core.graph.subscriptions(self.topic)]
        profile = qos if isinstance(qos, Qos) else Qos.from_rmw(qos)
        self.qos: Qos = profile.resolved(publisher=True, peers=peers)
        super().__init__(core, node)
        self.subscriptions: list[SubscriptionHandle] = []
        self.links: list[Link] | None = None if core.network is None else []
        self.events: EndpointEvents = EndpointEvents()
        self._offers = Offers.of(core.loop, self.qos, self.events)
        if finite(self.qos.lifespan_ns):
            self.links = []
        self._count = 0
        self._channel: int | None = None
        self._watcher = core.watchers.get(self.topic)
        self._history: deque[Delivery] | None = None
        if self.qos.durability is Durability.TRANSIENT_LOCAL:
            self._history = deque(maxlen=self.qos.keep)
        core.graph.add_publisher(self)

    def publish(self, msg: Any) -> None:
        """Publish a message: a snapshot of it goes to every connected subscription."""
        self.send(self._serialize(msg))

    def publish_raw(self, data: bytes) -> None:
        """Publish a serialized message, in canonical form.

        :raises ValueError: if the bytes are not a message of this topic's type.
        """
        self.send(self._canonical(data))

    def send(self, data: bytes, content_hash: int | None = None) -> None:
        """Deliver canonical CDR bytes; ``content_hash`` if not all of them are content."""
        core = self.core
        loop = core.loop
        now_ns = loop.now_ns
        self._count += 1
        recorder = core.recorder
        if recorder is None:
            core.unrecorded += 1
            digest = position = 0
        else:
            digest = hash64(data) if content_hash is None else content_hash
            channel = self._channel
            if channel is None:
                channel = self._open_channel()
            position = recorder.message(
                self.output_kind, self.entity_id, channel, now_ns, data, digest
            )
        event, count = loop.events, self._count
        loop.activity_ns = now_ns
        if self.links is not None:
            for link in self.links:
                link.send(data, event, position, digest, now_ns, count)
        else:
            delivery = (now_ns, 0, 0, None, data, event, position, digest, now_ns, count)
            ready = loop.ready
            for subscription in self.subscriptions:
                subscription.queue.append(delivery)
                if subscription.wrapper is not None:
                    ready.append(subscription)
                else:
                    subscription.find_wrapper()
        if self._history is not None:
            self._history.append((now_ns, 0, 0, None, data, event, position, digest, now_ns, count))
        if self._offers is not None:
            self._offers.sent()
        if self._watcher is not None:
            self._watcher(self.msg_type, data)

    def send_history(self, subscription: SubscriptionHandle) -> None:
        """Give a late joiner what it asks for and this publisher kept; never by best effort."""
        if (
            not self._history
            or subscription.qos.durability is not Durability.TRANSIENT_LOCAL
            or subscription.qos.reliability is not Reliability.RELIABLE
        ):
            return
        kept = list(self._history)
        wanted = kept[-subscription.qos.keep :] if subscription.qos.keep else kept
        if self.links is None:
            for delivery in wanted:
                subscription.deliver(delivery)
            return
        link = next(link for link in self.links if link.subscription is subscription)
        for delivery in wanted:
            link.send(*delivery[4:])

    def connect(self, subscription: SubscriptionHandle) -> None:
        """Send to this subscription, too; fan-out is in the creation order of subscriptions."""
        if self.links is None and subscription.timed:
            self.links = [Link.between(self.core, self, other) for other in self.subscriptions]
        self.subscriptions.append(subscription)
        self.subscriptions.sort(key=_by_age)
        if self.links is not None:
            self.links.append(Link.between(self.core, self, subscription))
            self.links.sort(key=lambda link: link.subscription.entity_id)

    def assert_liveliness(self) -> None:
        """Show that this publisher is alive, without a message."""
        if self._offers is not None:
            self._offers.asserted()
        for link in self.links or ():
            link.sign_of_life()

    def disconnect(self, subscription: SubscriptionHandle) -> None:
        """Send to this subscription no longer."""
        self.subscriptions.remove(subscription)
        if self.links is not None:
            for link in self.links:
                if link.subscription is subscription:
                    link.close()
            self.links = [link for link in self.links if link.subscription is not subscription]

    def _open_channel(self) -> int:
        self._channel = self.core.channel(
            self.topic,
            self.type_name,
            lambda: (schema_text(self.msg_type), type_hash(self.msg_type) or ""),
            self.qos.to_yaml(),
        )
        return self._channel

    def get_topic_name(self) -> str:
        """Return the resolved topic."""
        return self.topic

    def get_subscription_count(self) -> int:
        """Count the connected subscriptions."""
        return len(self.subscriptions)

    def wait_for_all_acked(self, timeout: Any) -> bool:
        """Wait in simulated time until what was sent has reached every reliable subscription.

        Returns whether it has; without links it has at once.
        """
        limit_ns: int = timeout.nanoseconds
        until_ns = max((link.acked_ns() for link in self.links or ()), default=0)
        left_ns = until_ns - self.core.loop.now_ns
        if left_ns <= 0 or limit_ns == 0:
            return left_ns <= 0
        acked = limit_ns < 0 or left_ns <= limit_ns
        wait(self.core, "its messages to be acknowledged", for_ns=left_ns if acked else limit_ns)
        return acked

    def settle(self) -> bool:
        return True

    def trace_name(self) -> str:
        return self.topic

    def trace_type(self) -> str:
        return self.type_name

    def trace_detail(self) -> dict[str, object]:
        return {"qos": self.qos.summary()}

    def _destroy(self) -> None:
        self.core.graph.remove_publisher(self)
        if self._offers is not None:
            self._offers.end()


class SubscriptionHandle(Receiver):
    """Stands in for ``_rclpy.Subscription``. A full queue drops its oldest message."""

    kind = EntityKind.SUBSCRIPTION
    lists = "subscriptions"
    origin = slice(5, 8)

    def __init__(
        self,
        core: Core,
        node: NodeHandle,
        msg_type: Any,
        topic: str,
        qos: Any,
        content_filter: Any = None,
    ) -> None:
        self.topic = node.resolve(topic, service=False)
        if content_filter is not None:
            self.set_content_filter(*content_filter)
        codec = codec_for(msg_type)
        self.type_name = codec.type_name
        self.msg_type = msg_type
        self._deserialize = codec.deserialize
        peers = [p.qos for p in core.graph.publishers(self.topic)]
        self.qos: Qos = Qos.from_rmw(qos).resolved(publisher=False, peers=peers)
        super().__init__(core, node)
        self.queue: deque[Delivery] = deque(maxlen=self.qos.keep)
        self.timed = any(map(finite, (self.qos.deadline_ns, self.qos.lifespan_ns)))
        self.timed |= finite(self.qos.lease_ns)
        self.publishers: list[PublisherHandle] = []
        self.events: EndpointEvents = EndpointEvents()
        self.deadline: Deadline | None = None
        if finite(self.qos.deadline_ns):
            self.deadline = Deadline(core.loop, self.qos.deadline_ns, self.events)
        self._callback: Any = None
        self._coroutine = False
        self._with_info = False
        core.graph.add_subscription(self)

    def dispatch(self) -> None:
        """Take the oldest message and run the callback with a copy of its own."""
        if not self.may_run():
            return
        wrapper = self.wrapper
        _, _, _, _, data, event, position, digest, _, _ = delivery = self.queue.popleft()
        callback = wrapper._callback
        if callback is not self._callback:
            self._learn(wrapper)
        message = data if wrapper.raw else self._deserialize(data)
        args = (message, _message_info(delivery)) if self._with_info else (message,)
        core = self.core
        if self._coroutine:
            begin(wrapper.callback_group, wrapper)
            start_coroutine(core, self, _SUBSCRIPTION, callback, args, event, position, digest)
            return
        core.execute(
            self, self.entity_id, self.node, _SUBSCRIPTION, callback, args, event, position, digest
        )

    def _learn(self, wrapper: Any) -> None:
        """Look at a callback once, when it is new; users may exchange it."""
        self._callback = wrapper._callback
        self._coroutine = is_coroutine_function(wrapper._callback)
        self._with_info = wrapper._callback_type is not type(wrapper).CallbackType.MessageOnly

    def take_message(self, msg_type: Any, raw: bool) -> Any:
        """Take a message by hand, as a wait set would; None if there is none."""
        if not self.queue:
            return None
        delivery = self.queue.popleft()
        data = delivery[4]
        message = data if raw else codec_for(msg_type).deserialize(data)
        return message, _message_info(delivery)

    def get_topic_name(self) -> str:
        """Return the resolved topic."""
        return self.topic

    def is_cft_enabled(self) -> bool:
        """Return False: there are no content filters."""
        return False

    def set_content_filter(self, expression: str, parameters: list[str]) -> None:
        """Refuse: DDS's filter language is not spoken here (ROS 2 Kilted and later)."""
        raise UnsupportedError(
            f"the subscription of {self.topic} has a content filter ({expression!r}), which cannot "
            "be simulated by this version of rsltrace: compare in the callback instead"
        )

    def get_content_filter(self) -> Any:
        """Refuse, as rclpy does for a subscription without a content filter."""
        assert self.node is not None
        raise self.node.boundary.real.RCLError("content filter topic is not enabled")

    def get_publisher_count(self) -> int:
        """Count the connected publishers."""
        return len(self.publishers)

    def trace_name(self) -> str:
        return self.topic

    def trace_type(self) -> str:
        return self.type_name

    def trace_detail(self) -> dict[str, object]:
        callback = callback_name(getattr(self.wrapper, "callback", None))
        return {"callback": callback, "qos": self.qos.summary()}

    def _destroy(self) -> None:
        self.core.graph.remove_subscription(self)
        self.queue.clear()
        if self.deadline is not None:
            self.deadline.over = True


def _by_age(endpoint: SubscriptionHandle) -> int:
    return endpoint.entity_id


def _message_info(delivery: Delivery) -> dict[str, int | None]:
    """Return the MessageInfo dictionary that rclpy 7 passes to callbacks."""
    return {
        "source_timestamp": delivery[8],
        "received_timestamp": delivery[0],
        "publication_sequence_number": delivery[9],
        "reception_sequence_number": None,
    }
