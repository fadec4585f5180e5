"""Messages that a job lets go wrong, against a model of what then arrives: no client library."""

from __future__ import annotations

import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.simulation.chance.channel import LinkModel, NetworkPlan
from rsltrace.simulation.chance.distribution import Constant
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.stop import stop_at
from rsltrace.simulation.loop.timer_queue import timer_queue
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.interface import MessageFault, MessageType, TopicFaults
from rsltrace.simulation.middleware.links import Network
from tests.tiers import cases

INT = MessageType("std_msgs/msg/Int32")
PERIOD, MESSAGES = 100, 6

one_fault = st.tuples(
    st.sampled_from(["lost", "late", "twice"]), st.integers(1, MESSAGES), st.integers(0, 350)
)


def arrivals(faults: list[Any], delay: int | None) -> list[tuple[int, int]]:
    """Return when which number arrives; times have no unit."""
    loop = EventLoop(start_ns=0, timers=timer_queue("creation"))
    loop.stop_conditions = (stop_at(PERIOD * (MESSAGES + 20), "the end"),)
    domain = Domain(loop)
    if delay is not None:
        plan = NetworkPlan(default=LinkModel(delay=Constant(delay)))
        domain.transport.network = Network(domain.dispatcher, plan)
    domain.transport.faults["/n"] = TopicFaults(
        [
            MessageFault(
                number,
                is_lost=kind == "lost",
                late_ns=by if kind == "late" else 0,
                copy_ns=by if kind == "twice" else -1,
            )
            for kind, number, by in faults
        ]
    )
    sender, receiver = domain.join("sender"), domain.join("receiver")
    publisher = domain.publisher(sender, "/n", INT)
    found: list[tuple[int, int]] = []

    def hear(data: bytes) -> None:
        found.append((loop.now_ns, struct.unpack("<I", data)[0]))

    def tick() -> None:
        nonlocal count
        count += 1
        if count <= MESSAGES:
            publisher.send(struct.pack("<I", count))

    count = 0
    domain.subscription(receiver, "/n", INT, hear)
    domain.timer(sender, PERIOD, tick)
    loop.run()
    return found


@settings(max_examples=cases(10, 40))
@given(
    st.lists(one_fault, max_size=5, unique_by=lambda fault: fault[1]),
    st.sampled_from([None, 0, 30, 130]),
)
def test_what_arrives_is_what_a_link_that_keeps_the_order_would_bring(
    faults: list[Any], delay: int | None
) -> None:
    happens = {number: (kind, by) for kind, number, by in faults}
    expected, last = [], 0
    for number in range(1, MESSAGES + 1):
        kind, by = happens.get(number, ("", 0))
        if kind == "lost":
            continue
        last = max(number * PERIOD + (by if kind == "late" else 0) + (delay or 0), last)
        expected.append((last, number))
        if kind == "twice":
            last += by
            expected.append((last, number))
    assert arrivals(faults, delay) == expected
