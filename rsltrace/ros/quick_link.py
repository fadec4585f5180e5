"""The usual link in a hurry: every message takes some time and arrives, in the order of sending.

With a delay on every link, most events of a run are messages that come this way. What a link has to
look up is therefore bound once, in a closure, its arrivals go straight into the loop's queue, and
its draws to the recorder without a call.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappush
from typing import TYPE_CHECKING

from rsltrace.chance.distribution import Sampler
from rsltrace.loop.loop import ORDER_RELEASE, Release
from rsltrace.model.draw import Draw, encode_draw
from rsltrace.model.event import OutputKind
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import OUTPUT_CONTENT

if TYPE_CHECKING:
    from rsltrace.ros.core import Core
    from rsltrace.ros.links import Link

Send = Callable[[bytes, int, int, int, int, int], None]
"""Sends a message on its way: what a ``Delivery`` has from the CDR on."""

_DELAY = encode_draw(Draw.DELAY)
_DRAW = int(OutputKind.DRAW)
_pack_output = OUTPUT_CONTENT.pack


def quick_send(core: Core, link: Link, delay: Sampler) -> Send:
    """Return how ``link`` sends, if it does nothing but delay and keeps the order."""
    loop = core.loop
    subscription = link.subscription
    entity = subscription.entity_id
    ready, scheduled, next_place = loop.ready, loop.scheduled, loop.next_place

    def arrive(release: Release) -> None:
        if subscription.destroyed:
            return
        subscription.queue.append(release)
        if subscription.wrapper is not None:
            ready.append(subscription)
        else:
            subscription.find_wrapper()

    def send(
        data: bytes, event: int, position: int, digest: int, stamp_ns: int, count: int
    ) -> None:
        leaves_ns = loop.now_ns
        if core.busy_ns:
            leaves_ns += core.busy_ns
        delay_ns = delay(leaves_ns)
        arrival_ns = leaves_ns + delay_ns
        if arrival_ns < link.last_ns:
            arrival_ns = link.last_ns
            delay_ns = arrival_ns - leaves_ns
        link.last_ns = arrival_ns
        recorder = core.recorder
        if recorder is not None:  # what Recorder.draw does
            packed = _pack_output(_DELAY | delay_ns, entity, _DRAW)
            recorder.output_hash = hash64(packed, recorder.output_hash)
            recorder.add_output(packed)
            recorder.outputs += 1
        place = next_place()
        release = (
            arrival_ns, ORDER_RELEASE, place, arrive, data, event, position, digest, stamp_ns, count
        )  # fmt: skip
        if delay_ns or arrival_ns != loop.now_ns or link.expects(arrive):
            heappush(scheduled, release)
        else:
            arrive(release)

    return send
