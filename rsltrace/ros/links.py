"""Links with a model: messages, requests and responses that take time, get lost or come twice.

A graph without models has no links, and its publications go straight into the queues.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.chance.channel import LOST_BURST, LOST_DROP, LOST_OUTAGE, Channel
from rsltrace.chance.network import NetworkPlan
from rsltrace.model.draw import Draw, encode_draw
from rsltrace.model.event import OutputKind
from rsltrace.ros.qos import Reliability
from rsltrace.ros.qos_status import MESSAGE_LOST

if TYPE_CHECKING:
    from rsltrace.ros.core import Core
    from rsltrace.ros.pubsub import Delivery, PublisherHandle, SubscriptionHandle
    from rsltrace.ros.services import ClientHandle, Exchange, ServiceHandle

_DRAW = int(OutputKind.DRAW)
_DELAY = encode_draw(Draw.DELAY)
_LOST = {
    LOST_DROP: encode_draw(Draw.DROP),
    LOST_BURST: encode_draw(Draw.BURST),
    LOST_OUTAGE: encode_draw(Draw.OUTAGE),
}


class Network:
    """Makes the links of one world, from the plan of its job."""

    def __init__(self, core: Core, plan: NetworkPlan) -> None:
        self._core = core
        self._plan = plan
        self._counts: dict[tuple[str, str, str], int] = {}
        self._ends: dict[int, tuple[str, int]] = {}
        self._exchanges: dict[tuple[int, int, str], Channel | None] = {}

    def link(self, publisher: PublisherHandle, subscription: SubscriptionHandle) -> Link:
        """Return the link of two endpoints that have just been connected."""
        channel = self._plan.topic_channel(
            publisher.topic,
            self._end("publisher", publisher.topic, publisher),
            self._end("subscription", publisher.topic, subscription),
            reliable=subscription.qos.reliability is Reliability.RELIABLE,
        )
        return Link(self._core, publisher, subscription, channel)

    def exchange(
        self, client: ClientHandle, server: ServiceHandle, direction: str, exchange: Exchange
    ) -> None:
        """Bring a ``request`` to the server, or a ``response`` to the client."""
        receiver: Any = server if direction == "request" else client
        key = (client.entity_id, server.entity_id, direction)
        if key not in self._exchanges:
            self._exchanges[key] = self._plan.service_channel(
                client.service,
                self._end("client", client.service, client),
                self._end("service", client.service, server),
                direction,
            )
        channel = self._exchanges[key]
        core = self._core
        now_ns = core.loop.now_ns
        sent_ns = now_ns + core.busy_ns
        delay_ns = 0
        if channel is not None:
            delay_ns = channel.transmit(sent_ns)
            note(core, receiver.entity_id, _LOST[delay_ns] if delay_ns < 0 else _DELAY | delay_ns)
            if delay_ns < 0:
                return
        arrive = partial(_arrive, receiver, exchange)
        if sent_ns + delay_ns == now_ns:
            arrive()
        else:
            core.loop.schedule(sent_ns + delay_ns, arrive)

    def _end(self, kind: str, name: str, endpoint: Any) -> tuple[str, int]:
        """Return (node, how many such endpoints it has made before this one)."""
        end = self._ends.get(endpoint.entity_id)
        if end is None:
            node = endpoint.node.fully_qualified_name
            key = (kind, name, node)
            ordinal = self._counts.get(key, 0)
            self._counts[key] = ordinal + 1
            end = self._ends[endpoint.entity_id] = (node, ordinal)
        return end


def note(core: Core, entity: int, draw: int) -> None:
    """Write down what chance has decided, as an output of the event under way."""
    if core.recorder is not None:
        core.recorder.output(_DRAW, entity, draw)


def _arrive(receiver: Any, exchange: Any) -> None:
    if not receiver._destroyed:
        receiver.deliver(exchange)


class Link:
    """From one publisher to one subscription; ``channel`` is None if nothing is the matter.

    What a reliable publisher cannot send during an outage waits in ``_held``, which holds as many
    messages as its history: later ones push the oldest out, as in DDS.
    """

    def __init__(
        self,
        core: Core,
        publisher: PublisherHandle,
        subscription: SubscriptionHandle,
        channel: Channel | None,
    ) -> None:
        self.subscription = subscription
        self._core = core
        self._channel = channel
        self._held: deque[tuple[Delivery, int]] = deque(maxlen=publisher.qos.keep)
        self._lost = 0

    def send(self, delivery: Delivery) -> None:
        """Send a message on its way."""
        core = self._core
        loop = core.loop
        now_ns = loop.now_ns
        arrival_ns = now_ns + core.busy_ns
        channel = self._channel
        if channel is not None:
            delay_ns = channel.transmit(arrival_ns)
            if delay_ns < 0:
                note(core, self.subscription.entity_id, _LOST[delay_ns])
                self._lost += 1
                return
            recorder = core.recorder
            if recorder is not None:
                recorder.output(_DRAW, self.subscription.entity_id, _DELAY | delay_ns)
            if channel.duplicate_ns >= 0:
                self._duplicate(delivery, arrival_ns + channel.duplicate_ns)
            if channel.held_until_ns >= 0:
                self._hold(delivery, arrival_ns + delay_ns, channel.held_until_ns)
                return
            arrival_ns += delay_ns
        if arrival_ns == now_ns:
            self._arrive(delivery)
        else:
            loop.schedule(arrival_ns, partial(self._arrive, delivery))

    def _arrive(self, delivery: Delivery) -> None:
        subscription = self.subscription
        if subscription._destroyed:
            return
        if self._lost:
            lost, self._lost = self._lost, 0
            subscription.events.add(MESSAGE_LOST, total=lost)
        subscription.deliver((*delivery[:6], self._core.loop.now_ns))

    def _duplicate(self, delivery: Delivery, arrival_ns: int) -> None:
        core = self._core
        note(
            core,
            self.subscription.entity_id,
            encode_draw(Draw.DUPLICATE, arrival_ns - core.loop.now_ns),
        )
        core.loop.schedule(arrival_ns, partial(self._arrive, delivery))

    def _hold(self, delivery: Delivery, arrival_ns: int, until_ns: int) -> None:
        if not self._held:
            self._core.loop.schedule(until_ns, self._release)
        elif len(self._held) == self._held.maxlen:
            self._lost += 1
        self._held.append((delivery, arrival_ns))

    def _release(self) -> None:
        """Let go of what has waited through an outage."""
        held = list(self._held)
        self._held.clear()
        now_ns = self._core.loop.now_ns
        for delivery, arrival_ns in held:
            action: Callable[[], None] = partial(self._arrive, delivery)
            self._core.loop.schedule(max(arrival_ns, now_ns), action)
