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
    check_type,
    open_bag_of,
    qos_override,
    qos_values,
    run_start_ns,
    with_progress,
)
from rsltrace.trace.recordings.playback import Playback

_SETTLED_S = 0.5
_SETTLED_WITHIN_S = 30.0
"""How long the player waits for anybody to listen: constructors load models, machines are busy."""

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
    publishers: dict[tuple[str, str], Any] = {}
    streams: list[_Played] = []
    for entry in bags:
        ends = []
        for topic in entry.bag.topics:
            key = entry.name_of(topic), topic.type_name
            if key not in publishers:
                qos = {**qos_values(topic.qos), **qos_override(entry.spec, topic.name)}
                kind = check_type(entry.spec.path, topic)
                publishers[key] = node.create_publisher(kind, key[0], _profile(qos))
            ends.append(publishers[key])
        streams.append(_messages(entry.playback, ends))
    merged: _Played = heapq.merge(*streams, key=lambda message: message[0])
    if job.progress is not None:
        kind = get_message_class("std_msgs/msg/Float32")
        progress = node.create_publisher(kind, job.progress, 10)
        publishers[job.progress, ""] = progress
        merged = with_progress(merged, progress, bags)
    _wait_for_listeners(list(publishers.values()))
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


def _messages(playback: Playback, publishers: list[Any]) -> _Played:
    for stamp_ns, topic, data in playback.messages():
        yield stamp_ns, publishers[topic], data


def _wait_for_listeners(publishers: list[Any]) -> None:
    """Wait until as many subscriptions have been found as there are, as far as anybody can tell."""
    since = begun = time.monotonic()
    before: list[int] = []
    while time.monotonic() - begun < _SETTLED_WITHIN_S:
        found = [publisher.get_subscription_count() for publisher in publishers]
        if found != before:
            since, before = time.monotonic(), found
        elif any(found) and time.monotonic() - since > _SETTLED_S:
            return
        time.sleep(0.02)


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
