"""The usual links in a hurry: every message arrives, in the order of sending, at once or later.

With a delay on every link, most events of a run are messages that come this way. What a link has to
look up is therefore bound once, in a closure, its arrivals go straight into the loop's queue, and
its draws to the recorder without a call.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappush
from typing import Protocol

from rsltrace.simulation.chance.distribution import Sampler
from rsltrace.simulation.loop.loop import ORDER_RELEASE, Release
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.receiver import Receiver
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import OUTPUT_CONTENT
from rsltrace.trace.model.draw import Draw, encode_draw
from rsltrace.trace.model.event import OutputKind

Send = Callable[[bytes, int, int, int, int, int], None]
"""Sends a message on its way: what a ``Delivery`` has from the CDR on."""

_DELAY = encode_draw(Draw.DELAY)
_DRAW = int(OutputKind.DRAW)
_pack_output = OUTPUT_CONTENT.pack


class OrderedLink(Protocol):
    """A link that keeps the order; ``last_ns`` is when the last message arrives."""

    subscription: Subscription
    last_ns: int

    def expects(self, arrive: Callable[[Release], object]) -> bool:
        """Whether a message is due now that has not arrived yet."""


def quick_send(dispatcher: Dispatcher, link: OrderedLink, delay: Sampler) -> Send:
    """Return how ``link`` sends, if it does nothing but delay and keeps the order."""
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
        if recorder is not None:  # what Recorder.draw does
            packed = _pack_output(_DELAY | delay_ns, entity, _DRAW)
            recorder.output_hash = hash64(packed, recorder.output_hash)
            add_output = recorder.add_output
            add_output(packed)
            recorder.outputs += 1
        place = next_place()
        release = (
            arrival_ns, ORDER_RELEASE, place, arrive, data, event, position, digest, stamp_ns, count
        )  # fmt: skip
        if delay_ns or arrival_ns != loop.now_ns or link.expects(arrive):
            heappush(scheduled, release)
        elif arrive(release) is not None:
            loop.ready.append(subscription)

    return send


def direct_send(dispatcher: Dispatcher, link: OrderedLink) -> Send:
    """Return how ``link`` sends, if there is nothing the matter with it.

    Only what an execution time holds back waits in the loop's queue, and what must not overtake it.
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
