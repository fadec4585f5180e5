"""The bags of a job, played in real time by a process of their own."""

from __future__ import annotations

import heapq
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.messages.interfaces import get_message_class
from rsltrace.job import Job
from rsltrace.native.processes.plans import THE_BAGS
from rsltrace.run.plans.bags import (
    PLAYER,
    BagInput,
    check_bag_types,
    open_bag_of,
    played_streams,
    run_start_ns,
    with_progress,
)

_LOOK_S = 0.02
_SETTLED_LOOKS = 25
_LOOKS_MAX = 1500
"""How long the player waits for anybody to listen: constructors load models, machines are busy, and
one that stands still takes no time from them."""

_Played = Iterator[tuple[int, Any, bytes]]


def player(job: Job, stack: ExitStack) -> JobEntry:
    """Return the main that plays the bags of a job, which are open as long as ``stack`` is.

    :raises BagError: a bag cannot be read, or a type of it is not installed.
    """
    bags = [stack.enter_context(open_bag_of(job, index)) for index in range(len(job.bags))]
    check_bag_types(job, bags)
    return JobEntry(THE_BAGS, partial(_play, job, bags), [], argv=[PLAYER])


def _play(job: Job, bags: list[BagInput]) -> None:
    import rclpy
    from rclpy.node import Node

    rclpy.init(args=[])
    node = Node(PLAYER, start_parameter_services=False, enable_rosout=False)

    def publisher(topic: str, kind: type, qos: dict[str, Any]) -> Any:
        return node.create_publisher(kind, topic, _profile(qos))

    streams, publishers = played_streams(bags, publisher)
    merged: _Played = heapq.merge(*streams, key=lambda message: message[0])
    if job.progress is not None:
        kind = get_message_class("std_msgs/msg/Float32")
        progress = node.create_publisher(kind, job.progress, 10)
        publishers.append(progress)
        merged = with_progress(merged, progress, bags)
    _wait_for_listeners(publishers)
    _publish(merged, run_start_ns(job, bags))
    node.destroy_node()
    rclpy.try_shutdown()


def _publish(messages: _Played, start_ns: int) -> None:
    """Publish each message when it is due."""
    begun_ns = time.monotonic_ns()
    for stamp_ns, publisher, data in messages:
        left_ns = stamp_ns - start_ns - (time.monotonic_ns() - begun_ns)
        time.sleep(max(left_ns, 0) / 1e9)
        publisher.publish(bytes(data))


def _wait_for_listeners(publishers: list[Any]) -> None:
    """Wait until as many subscriptions have been found as there are, as far as anybody can tell."""
    same, before = 0, list[int]()
    for _ in range(_LOOKS_MAX):
        found = [publisher.get_subscription_count() for publisher in publishers]
        same = same + 1 if found == before else 0
        if any(found) and same > _SETTLED_LOOKS:
            return
        before = found
        time.sleep(_LOOK_S)


def _profile(values: dict[str, Any]) -> Any:
    """Return a QoS profile of rclpy's; what is not said is the usual one."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    kinds = {
        "reliability": ReliabilityPolicy,
        "durability": DurabilityPolicy,
        "history": HistoryPolicy,
    }
    given = {
        name: kinds[name][str(value).upper()] if name in kinds else value
        for name, value in values.items()
    }
    return QoSProfile(**{"depth": 10, **given})
