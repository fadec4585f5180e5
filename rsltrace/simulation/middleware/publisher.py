"""Publishers: a message is sent once and delivered to every matched subscription."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rsltrace.compiled import PublisherFields, core
from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import MessageType, TopicFaults
from rsltrace.simulation.middleware.links import Network, PublisherLink
from rsltrace.simulation.middleware.qos.policies import Durability, Qos, Reliability
from rsltrace.simulation.middleware.qos.timing import EndpointEvents, OfferedQosTimers, finite
from rsltrace.simulation.middleware.subscription import Delivery, Subscription
from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import OutputKind

Watcher = Callable[[Any, bytes], None]
"""Is called with the publisher and the canonical bytes of each message on a topic."""

MessageFilter = Callable[[Any, bytes], bytes | None]
"""Is called with the publisher and the canonical bytes of a message that is about to be published,
and returns those that are published in their place; None: the message is not published."""


class TopicObservers:
    """Observers of a topic: ``filter`` decides what is published, ``watchers`` are called after."""

    def __init__(self) -> None:
        self.filter: MessageFilter | None = None
        self.watchers: list[Watcher] = []


class Transport:
    """How messages reach receivers. ``network`` is None in a run without link models; ``faults``
    are those of single messages, by topic."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self.dispatcher = dispatcher
        self.network: Network | None = None
        self.faults: dict[str, TopicFaults] = {}
        self.observers: dict[str, TopicObservers] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def channel(
        self, topic: str, type: MessageType, qos_yaml: str = "", *, with_hash: bool = False
    ) -> int:
        """Return the trace's channel for a topic, or -1 if its payloads are not kept."""
        recorder = self.dispatcher.recorder
        if recorder is None or not recorder.keep_payload(topic):
            return -1
        channel = self._channels.get((topic, type.name))
        if channel is None:
            text, type_hash = type.describe()
            channel = recorder.writer.add_channel(
                topic,
                type.name,
                text,
                qos_yaml=qos_yaml,
                type_hash=type_hash if with_hash else "",
            )
            self._channels[topic, type.name] = channel
        return channel


class Publisher(DomainEntity, PublisherFields):
    """Sends a topic.

    ``subscriptions`` are the connected ones in creation order; ``links`` lead to them in a job with
    delay models, else it is None. ``observers`` are those of its topic, or None.
    """

    kind = EntityKind.PUBLISHER
    output_kind = int(OutputKind.MESSAGE)

    def __init__(
        self, transport: Transport, node: Any, topic: str, type: MessageType, qos: Qos
    ) -> None:
        super().__init__(transport.dispatcher, node)
        self._transport = transport
        self.topic = topic
        self.type = type
        self.qos = qos.resolved(publisher=True, peers=[])
        self.subscriptions: list[Subscription] = []
        self.links: list[PublisherLink] | None = None if transport.network is None else []
        self.events = EndpointEvents()
        self._offers = OfferedQosTimers.of(self.dispatcher.loop, self.qos, self.events)
        self._faults = transport.faults.get(topic)
        if finite(self.qos.lifespan_ns) or self._faults is not None:
            self.links = []
        self._count = 0
        self._channel: int | None = None
        self._output_kind = self.output_kind
        self.observers = transport.observers.get(topic)
        self._history: deque[Delivery] | None = None
        if self.qos.durability is Durability.TRANSIENT_LOCAL or self.dispatcher.loop.keeps_all:
            self._history = deque(maxlen=self.qos.keep)

    @property
    def type_name(self) -> str:
        return self.type.name

    def send_any(self, data: bytes, content_hash: int | None = None) -> None:
        """Send canonical CDR bytes; ``content_hash`` if not all of them are content."""
        observers = self.observers
        if observers is not None and observers.filter is not None:
            filtered = observers.filter(self, data)
            if filtered is None:
                return
            if filtered is not data:
                data, content_hash = filtered, self._content_hash(filtered)
        dispatcher = self.dispatcher
        loop = dispatcher.loop
        now_ns = loop.now_ns
        self._count += 1
        recorder = dispatcher.recorder
        if recorder is None:
            dispatcher.unrecorded += 1
            digest = position = 0
        else:
            digest = hash64(data) if content_hash is None else content_hash
            channel = self._channel
            if channel is None:
                channel = self._open_channel()
            position = recorder.message(
                self._output_kind, self.entity_id, channel, now_ns, data, digest
            )
        event, count = loop.events, self._count
        loop.activity_ns = now_ns
        if self.links is not None:
            faults = self._faults
            if faults is not None:
                faults.begin()
            for link in self.links:
                link.send(data, event, position, digest, now_ns, count)
            if faults is not None:
                faults.end()
        else:
            delivery = (now_ns, 0, 0, None, data, event, position, digest, now_ns, count)
            ready = loop.ready
            for subscription in self.subscriptions:
                queue = subscription.queue
                if len(queue) == subscription.keep:
                    subscription.drop()
                queue.append(delivery)
                if subscription.active:
                    ready.append(subscription)
                else:
                    subscription.awaken()
        if self._history is not None:
            self._history.append((now_ns, 0, 0, None, data, event, position, digest, now_ns, count))
        if self._offers is not None:
            self._offers.sent()
        if observers is not None:
            for watch in observers.watchers:
                watch(self, data)

    if core is None or TYPE_CHECKING:
        send = send_any
        """The compiled one does the usual case, without links and watchers, and leaves the others
        to ``send_any``."""

    def _content_hash(self, data: bytes) -> int:
        return hash64(log_content(data) if self.output_kind == OutputKind.LOG else data)

    def _open_channel(self) -> int:
        self._channel = self._transport.channel(
            self.topic, self.type, self.qos.to_yaml(), with_hash=True
        )
        return self._channel

    def connect(self, subscription: Subscription) -> None:
        """Connect a subscription; fan-out is in creation order of subscriptions."""
        if self.links is None and subscription.timed:
            self.links = [self._link_to(other) for other in self.subscriptions]
        insort(self.subscriptions, subscription, key=lambda other: other.entity_id)
        if self.links is not None:
            link = self._link_to(subscription)
            insort(self.links, link, key=lambda link: link.subscription.entity_id)

    def _link_to(self, subscription: Subscription) -> PublisherLink:
        network = self._transport.network
        if network is None:
            return PublisherLink(self.dispatcher, self.qos, subscription, None, self._faults)
        return network.link(self, self.topic, self.qos, subscription, self._faults)

    def disconnect(self, subscription: Subscription) -> None:
        self.subscriptions.remove(subscription)
        if self.links is not None:
            for link in self.links:
                if link.subscription is subscription:
                    link.close()
            self.links = [link for link in self.links if link.subscription is not subscription]

    def disconnect_all(self) -> None:
        self.subscriptions = []
        for link in self.links or ():
            link.close()
        if self.links is not None:
            self.links.clear()

    def send_history(self, subscription: Subscription) -> None:
        """Send a late joiner the kept messages; never by best effort."""
        wants = (
            subscription.qos.durability is Durability.TRANSIENT_LOCAL
            and subscription.qos.reliability is Reliability.RELIABLE
        )
        if not self._history or not (wants or self.dispatcher.loop.keeps_all):
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

    def assert_liveliness(self) -> None:
        if self._offers is not None:
            self._offers.asserted()
        for link in self.links or ():
            link.sign_of_life()

    def acknowledged_ns(self) -> int:
        """Return when all acknowledged messages have arrived."""
        return max((link.acked_ns() for link in self.links or ()), default=0)

    def settle(self) -> bool:
        return True

    def trace_name(self) -> str:
        return self.topic

    def trace_type(self) -> str:
        return self.type.name

    def trace_detail(self) -> dict[str, object]:
        return {"qos": self.qos.summary()}

    def _destroy(self) -> None:
        super()._destroy()
        if self._offers is not None:
            self._offers.end()
