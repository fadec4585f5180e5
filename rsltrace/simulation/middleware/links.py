"""Links with a model: messages, requests and responses are delayed, lost or duplicated.

A graph without models has no links; its publications go straight into the queues.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from heapq import heappush
from typing import Any, Protocol

from rsltrace.compiled import LinkFields, core
from rsltrace.simulation.chance.channel import (
    LOST_BURST,
    LOST_DROP,
    LOST_OUTAGE,
    LinkChannel,
    NetworkPlan,
)
from rsltrace.simulation.chance.distribution import Sampler
from rsltrace.simulation.loop.loop import ORDER_RELEASE, Release
from rsltrace.simulation.middleware.entity import DomainEntity, Receiver
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.interface import MessageFault, TopicFaults
from rsltrace.simulation.middleware.qos.policies import INFINITE_NS, Qos, Reliability
from rsltrace.simulation.middleware.qos.timing import MESSAGE_LOST, RequestedLease, finite
from rsltrace.simulation.middleware.subscription import Delivery, Subscription
from rsltrace.trace.model.event import RandomDecision, encode_decision

# Fast links: every message arrives, in order, at once or later. With a delay on every link, most
# events of a run come this way, so lookups are bound once in a closure, arrivals go straight into
# the loop's queue.

Send = Callable[[bytes, int, int, int, int, int], None]
"""Sends a message on its way: what a ``Delivery`` has from the CDR on."""

_FAST_LINK_DELAY = encode_decision(RandomDecision.DELAY)


class FastLink(Protocol):
    """A link that keeps the order; ``last_ns`` is when the last message arrives."""

    subscription: Subscription
    last_ns: int

    def expects(self, arrive: Callable[[Release], object]) -> bool:
        """Whether a message is due now that has not arrived yet."""

    def enter(self, release: Release) -> None:
        """Let a message arrive that takes no time, after those that are due before it."""


def fast_send(dispatcher: Dispatcher, link: FastLink, delay: Sampler) -> Send:
    """Return how ``link`` sends if it only delays and keeps the order."""
    loop = dispatcher.loop
    under_way = dispatcher.event
    subscription = link.subscription
    entity, keep = subscription.entity_id, subscription.keep
    scheduled, next_place = loop.scheduled, loop.next_place

    def arrive(release: Release) -> Subscription | None:
        if subscription.destroyed:
            return None
        queue = subscription.queue
        if len(queue) == keep:
            subscription.drop()
        queue.append(release)
        if subscription.active:
            return subscription
        subscription.awaken()
        return None

    def send(
        data: bytes, event: int, position: int, digest: int, stamp_ns: int, count: int
    ) -> None:
        leaves_ns = loop.now_ns
        if under_way.busy_ns:
            leaves_ns += under_way.busy_ns
        delay_ns = delay(leaves_ns)
        arrival_ns = leaves_ns + delay_ns
        if arrival_ns < link.last_ns:
            arrival_ns = link.last_ns
            delay_ns = arrival_ns - leaves_ns
        link.last_ns = arrival_ns
        recorder = dispatcher.recorder
        if recorder is not None:
            recorder.draw(entity, _FAST_LINK_DELAY | delay_ns)
        place = next_place()
        release = (
            arrival_ns, ORDER_RELEASE, place, arrive, data, event, position, digest, stamp_ns, count
        )  # fmt: skip
        if delay_ns:
            heappush(scheduled, release)
        else:
            link.enter(release)

    return send


def direct_send(dispatcher: Dispatcher, link: FastLink) -> Send:
    """Return how ``link`` sends if it is perfect.

    Only messages that an execution time delays wait in the loop's queue, and what must not overtake
    them.
    """
    loop = dispatcher.loop
    under_way = dispatcher.event
    scheduled = loop.scheduled
    subscription = link.subscription
    arrived = subscription.arrived

    def arrive(release: Release) -> Receiver | None:
        return None if subscription.destroyed else arrived(release)

    def send(
        data: bytes, event: int, position: int, digest: int, stamp_ns: int, count: int
    ) -> None:
        now_ns = loop.now_ns
        late_ns = under_way.busy_ns
        if late_ns or (scheduled and scheduled[0][0] <= now_ns and link.expects(arrive)):
            what = (data, event, position, digest, stamp_ns, count)
            loop.schedule_release(now_ns + late_ns, arrive, *what)
        elif (
            arrived((now_ns, 0, 0, None, data, event, position, digest, stamp_ns, count))
            is not None
        ):
            loop.ready.append(subscription)

    return send


# Canonical CDR, publishing event, which of its outputs, content hash, publication stamp (ns) and
# number: what a Delivery has from [4] on.
Message = tuple[bytes, int, int, int, int, int]

_DELAY = encode_decision(RandomDecision.DELAY)
_LOST = {
    LOST_DROP: encode_decision(RandomDecision.DROP),
    LOST_BURST: encode_decision(RandomDecision.BURST),
    LOST_OUTAGE: encode_decision(RandomDecision.OUTAGE),
}


class ServiceLink:
    """The requests of one client to one server, or the responses."""

    def __init__(
        self, dispatcher: Dispatcher, receiver: Receiver, channel: LinkChannel | None
    ) -> None:
        self._dispatcher = dispatcher
        self._receiver = receiver
        self._entity = receiver.entity_id
        self._channel = channel
        self._plain = channel.plain if channel is not None and channel.keep_order else None
        self._last_ns = 0

    def send(self, exchange: Any) -> None:
        """Send a request or response."""
        dispatcher = self._dispatcher
        loop = dispatcher.loop
        now_ns = loop.now_ns
        arrival_ns = now_ns + dispatcher.event.busy_ns
        channel = self._channel
        if self._plain is not None:  # the usual case: some time, in order
            delay_ns = self._plain(arrival_ns)
            if arrival_ns + delay_ns < self._last_ns:
                delay_ns = self._last_ns - arrival_ns
            self._last_ns = arrival_ns = arrival_ns + delay_ns
            dispatcher.draw(self._entity, _DELAY | delay_ns)
        elif channel is not None:
            delay_ns = channel.transmit(arrival_ns)
            draw = (
                _LOST[delay_ns] if delay_ns < 0 else encode_decision(RandomDecision.DELAY, delay_ns)
            )
            dispatcher.draw(self._entity, draw)
            if delay_ns < 0:
                return
            arrival_ns += delay_ns
        if arrival_ns == now_ns:
            self._arrive(exchange)
        else:
            loop.schedule_release(arrival_ns, self._released, exchange)

    def _released(self, release: Release) -> Any:
        if self._receiver.destroyed:
            return None
        return self._receiver.arrived(release[4])

    def _arrive(self, exchange: Any) -> None:
        if not self._receiver.destroyed:
            self._receiver.deliver(exchange)


class PublisherLink(LinkFields):
    """The link from a publisher to a subscription; ``channel`` is None if messages arrive at once.

    What a reliable publisher cannot send during an outage waits in ``_held``, as many messages as
    its history: later ones push the oldest out, as in DDS. ``last_ns`` is when the last message in
    order arrives.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        offered: Qos,
        subscription: Subscription,
        channel: LinkChannel | None,
        faults: TopicFaults | None = None,
    ) -> None:
        self.subscription = subscription
        self._faults = faults
        self._loop = dispatcher.loop
        self._dispatcher = dispatcher
        self._channel = channel
        self._held: deque[tuple[Message, list[int]]] = deque(maxlen=offered.keep)
        self._lost = 0
        self._behind_ns = 0
        """When the last message arrives that a fault makes late: later ones come after it."""
        self.last_ns = 0
        self._receiver = subscription.entity_id
        self._lifespan_ns = min(
            limit if finite(limit) else INFINITE_NS
            for limit in (offered.lifespan_ns, subscription.qos.lifespan_ns)
        )
        self._timed = self._lifespan_ns != INFINITE_NS or subscription.timed
        self._lease: RequestedLease | None = None
        lease_ns = subscription.qos.lease_ns
        if finite(lease_ns):
            events = subscription.events
            self._lease = RequestedLease(self._loop, lease_ns, subscription.qos.liveliness, events)
            for outage in channel.outages if channel is not None else ():
                self._lease.cut_off(outage.from_ns, outage.to_ns)
        self.send: Send = self._send
        if self._timed or faults is not None:
            return
        if channel is None:
            self.send = direct_send(dispatcher, self)
        elif channel.plain and channel.keep_order:
            if core is None:
                self.send = fast_send(dispatcher, self, channel.plain)
            else:  # the same, compiled
                link: Any = self
                self._delay, self._arrives = channel.plain, link.arrive_delayed
                self.send = link.send_delayed

    def _send(
        self, data: bytes, event: int, position: int, digest: int, stamp_ns: int, count: int
    ) -> None:
        dispatcher = self._dispatcher
        now_ns = self._loop.now_ns
        arrival_ns = now_ns + dispatcher.event.busy_ns
        message = (data, event, position, digest, stamp_ns, count)
        channel = self._channel
        fault = None
        if self._faults is not None:
            fault = self._faults.for_node(self.subscription.node.fully_qualified_name)
        if fault is not None:
            self._send_faulty(fault, message, arrival_ns)
            return
        if channel is not None:
            delay_ns = channel.transmit(arrival_ns)
            if delay_ns < 0:
                dispatcher.draw(self._receiver, _LOST[delay_ns])
                self._lost += 1
                return
            dispatcher.draw(self._receiver, encode_decision(RandomDecision.DELAY, delay_ns))
            arrivals_ns = [arrival_ns + delay_ns]
            if channel.duplicate_ns >= 0:
                copy_ns = arrival_ns + channel.duplicate_ns
                dispatcher.draw(
                    self._receiver, encode_decision(RandomDecision.DUPLICATE, copy_ns - now_ns)
                )
                arrivals_ns.append(copy_ns)
            self.last_ns = max(self.last_ns, *arrivals_ns)
            if channel.held_until_ns >= 0:
                self._hold(message, arrivals_ns, channel.held_until_ns)
                return
            for arrival_ns in arrivals_ns:
                self._schedule_arrival(message, arrival_ns)
            return
        self._schedule_arrival(message, max(arrival_ns, self._behind_ns))

    def _send_faulty(self, fault: MessageFault, message: Message, sent_ns: int) -> None:
        """Send a message with a fault.

        The link's model draws for it as for any other, so later messages are not affected.
        """
        draw, channel = self._dispatcher.draw, self._channel
        sent_ns += fault.late_ns
        delay_ns = channel.transmit(sent_ns) if channel is not None else 0
        if fault.is_lost or delay_ns < 0:
            draw(self._receiver, _LOST[LOST_DROP if fault.is_lost else delay_ns])
            self._lost += 1
            return
        arrivals_ns = [max(sent_ns + delay_ns, self._behind_ns)]
        draw(self._receiver, encode_decision(RandomDecision.DELAY, fault.late_ns + delay_ns))
        if channel is not None and channel.duplicate_ns >= 0:
            arrivals_ns.append(sent_ns + channel.duplicate_ns)
        if fault.copy_ns >= 0:
            arrivals_ns.append(arrivals_ns[-1] + fault.copy_ns)
        now_ns = self._loop.now_ns
        for copy_ns in arrivals_ns[1:]:
            draw(self._receiver, encode_decision(RandomDecision.DUPLICATE, copy_ns - now_ns))
        if channel is None:
            self._behind_ns = arrivals_ns[-1]
        else:
            channel.hold_back(arrivals_ns[-1])
            self.last_ns = max(self.last_ns, *arrivals_ns)
        if channel is not None and channel.held_until_ns >= 0:
            self._hold(message, arrivals_ns, channel.held_until_ns)
            return
        for arrival_ns in arrivals_ns:
            self._schedule_arrival(message, arrival_ns)

    def _schedule_arrival(self, message: Message, arrival_ns: int) -> None:
        loop = self._loop
        now_ns = loop.now_ns
        if arrival_ns <= now_ns and not self.expects(self._arrive):
            self._arrive((now_ns, ORDER_RELEASE, 0, self._arrive, *message))
        else:
            loop.schedule_release(arrival_ns, self._arrive, *message)

    def enter(self, release: Release) -> None:
        """Let a message arrive that takes no time: now, unless others are due before it."""
        loop, arrive = self._loop, release[3]
        if release[0] != loop.now_ns or self.expects(arrive):
            heappush(loop.scheduled, release)
        elif arrive(release) is not None:
            loop.ready.append(self.subscription)

    def expects(self, arrive: Callable[[Release], Any]) -> bool:
        """Whether a due message has not arrived yet: none must overtake it."""
        scheduled, now_ns = self._loop.scheduled, self._loop.now_ns
        return bool(scheduled and scheduled[0][0] <= now_ns) and any(
            release[3] == arrive and release[0] <= now_ns for release in scheduled
        )

    def _arrive(self, release: Release) -> None:
        subscription = self.subscription
        if subscription.destroyed:
            return
        if self._lost:
            lost, self._lost = self._lost, 0
            subscription.events.add(MESSAGE_LOST, total=lost)
        loop = self._loop
        arrived: Delivery = (loop.now_ns, *release[1:])
        if self._timed:
            if self._lease is not None:
                self._lease.seen()
            if subscription.deadline is not None:
                subscription.deadline.seen()
            if self._lifespan_ns != INFINITE_NS:
                stale_ns = arrived[8] + self._lifespan_ns
                if stale_ns <= loop.now_ns:
                    return
                loop.schedule_release(stale_ns, self._expire, arrived)
        subscription.deliver(arrived)

    def _expire(self, release: Release) -> None:
        """Drop a message that was not taken within its lifespan."""
        queue = self.subscription.queue
        for place, waiting in enumerate(queue):
            if waiting is release[4]:
                del queue[place]
                return

    def sign_of_life(self) -> None:
        """Tell the subscription that its publisher is alive; outages hide it."""
        channel, now_ns = self._channel, self._loop.now_ns
        hidden = channel is not None and channel.cut_off_until(now_ns) is not None
        if self._lease is not None and not hidden:
            self._lease.seen()

    def acked_ns(self) -> int:
        """Return when all acknowledged messages so far have arrived."""
        if self.subscription.qos.reliability is not Reliability.RELIABLE:
            return 0
        return self.last_ns

    def close(self) -> None:
        """Forget the publisher or subscription."""
        if self._lease is not None:
            self._lease.gone()

    def _hold(self, message: Message, arrivals_ns: list[int], until_ns: int) -> None:
        if not self._held:
            self._loop.schedule(until_ns, self._release)
        elif len(self._held) == self._held.maxlen:
            self._lost += 1
            self.subscription.drop(len(self._held))
        self._held.append((message, arrivals_ns))

    def _release(self) -> None:
        """Send what has waited through an outage."""
        held = list(self._held)
        self._held.clear()
        loop = self._loop
        for message, arrivals_ns in held:
            for arrival_ns in arrivals_ns:
                loop.schedule_release(max(arrival_ns, loop.now_ns), self._arrive, *message)


class Network:
    """Makes the links of one world, from the plan of its job."""

    def __init__(self, dispatcher: Dispatcher, plan: NetworkPlan) -> None:
        self._dispatcher = dispatcher
        self._plan = plan
        self._counts: dict[tuple[str, str, str], int] = {}
        self._ends: dict[int, tuple[str, int]] = {}
        self._requests: dict[tuple[int, int], ServiceLink] = {}
        self._responses: dict[tuple[int, int], ServiceLink] = {}

    def link(
        self,
        publisher: DomainEntity,
        topic: str,
        qos: Qos,
        subscription: Subscription,
        faults: TopicFaults | None,
    ) -> PublisherLink:
        """Return the link of a publisher to a subscription."""
        channel = self._plan.topic_channel(
            topic,
            self._end("publisher", topic, publisher),
            self._end("subscription", topic, subscription),
            reliable=subscription.qos.reliability is Reliability.RELIABLE,
        )
        return PublisherLink(self._dispatcher, qos, subscription, channel, faults)

    def request(self, service: str, client: Receiver, server: Receiver, exchange: Any) -> None:
        key = (client.entity_id, server.entity_id)
        way = self._requests.get(key)
        if way is None:
            channel = self._service_channel(service, client, server, "request")
            way = self._requests[key] = ServiceLink(self._dispatcher, server, channel)
        way.send(exchange)

    def response(self, service: str, client: Receiver, server: Receiver, exchange: Any) -> None:
        key = (client.entity_id, server.entity_id)
        way = self._responses.get(key)
        if way is None:
            channel = self._service_channel(service, client, server, "response")
            way = self._responses[key] = ServiceLink(self._dispatcher, client, channel)
        way.send(exchange)

    def _service_channel(
        self, service: str, client: Receiver, server: Receiver, what: str
    ) -> LinkChannel | None:
        return self._plan.service_channel(
            service,
            self._end("client", service, client),
            self._end("service", service, server),
            what,
        )

    def _end(self, kind: str, name: str, endpoint: DomainEntity) -> tuple[str, int]:
        """Return (node, number of its earlier endpoints of this kind)."""
        end = self._ends.get(endpoint.entity_id)
        if end is None:
            node = endpoint.node.fully_qualified_name
            key = (kind, name, endpoint.node.key)
            count = self._counts.get(key, 0)
            self._counts[key] = count + 1
            end = self._ends[endpoint.entity_id] = (node, endpoint.node.ordinal(count))
        return end
