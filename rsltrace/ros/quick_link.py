"""The usual link in a hurry: every message takes some time and arrives, in the order of sending.

With a delay on every link, most events of a run are messages that come this way. What a link has to
look up is therefore bound once, in a closure, and its arrivals go straight into the loop's queue.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappush
from typing import TYPE_CHECKING

from rsltrace.chance.distribution import Sampler
from rsltrace.loop.loop import ORDER_RELEASE, EventLoop
from rsltrace.model.draw import Draw, encode_draw

if TYPE_CHECKING:
    from rsltrace.ros.core import Core
    from rsltrace.ros.links import Link
    from rsltrace.ros.pubsub import Delivery

Send = Callable[[bytes, int, int, int, int, int], None]
"""Sends a message on its way: the fields of a ``Delivery`` up to the publication number."""

_DELAY = encode_draw(Draw.DELAY)


def expects(loop: EventLoop, arrive: Callable[[Delivery], None]) -> bool:
    """Whether something is due now that has not arrived yet: a bag's message must not overtake."""
    return any(entry[3] == arrive and entry[0] <= loop.now_ns for entry in loop.scheduled)


def quick_send(core: Core, link: Link, delay: Sampler) -> Send:
    """Return how ``link`` sends, if it does nothing but delay and keeps the order."""
    loop = core.loop
    subscription = link.subscription
    entity = subscription.entity_id
    ready, scheduled, next_place = loop.ready, loop.scheduled, loop.next_place

    def arrive(delivery: Delivery) -> None:
        if subscription.destroyed:
            return
        subscription.queue.append(delivery)
        if subscription.wrapper is not None:
            ready.append(subscription)
        else:
            subscription.find_wrapper()

    def send(
        data: bytes, event: int, position: int, digest: int, stamp_ns: int, count: int
    ) -> None:
        now_ns = loop.now_ns
        leaves_ns = now_ns + core.busy_ns
        delay_ns = delay(leaves_ns)
        arrival_ns = leaves_ns + delay_ns
        if arrival_ns < link.last_ns:
            arrival_ns = link.last_ns
            delay_ns = arrival_ns - leaves_ns
        link.last_ns = arrival_ns
        recorder = core.recorder
        if recorder is not None:
            recorder.draw(entity, _DELAY | delay_ns)
        delivery = (data, event, position, digest, stamp_ns, count, arrival_ns)
        if (
            not delay_ns
            and arrival_ns == now_ns
            and (link.expected_ns != now_ns or not expects(loop, arrive))
        ):
            arrive(delivery)
        else:
            link.expected_ns = arrival_ns
            heappush(scheduled, (arrival_ns, ORDER_RELEASE, next_place(), arrive, delivery))

    return send
