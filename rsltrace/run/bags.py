"""The bags of a job: opened, checked and merged into the graph."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rsltrace.job import BagSpec, Job
from rsltrace.loop.stop import Stop
from rsltrace.run.stopping import has_stop

if TYPE_CHECKING:
    from rsltrace.bag import Bag
    from rsltrace.ros.world import World


def open_bag_of(job: Job, spec: BagSpec) -> Any:
    """Open one bag of a job; a context manager. Raises BagError."""
    from rsltrace.bag import open_bag

    return open_bag(
        job.resolve(spec.path),
        topics=spec.topics,
        exclude=spec.exclude,
        start_offset_ns=spec.start_offset_ns,
    )


def start_ns_of(job: Job, bags: list[Bag]) -> int:
    """Return when the run starts: what the job says, else the first message of the bags, else 0."""
    if job.start_ns is not None:
        return job.start_ns
    return min((bag.start_ns for bag in bags), default=0)


def check_bag_types(job: Job, bags: list[Bag]) -> None:
    """Raise BagError if a recorded topic has a type that is not installed."""
    from rsltrace.ros.player import check_type

    for spec, bag in zip(job.bags, bags, strict=True):
        for topic in bag.topics:
            check_type(bag=spec.path, topic=topic.name, type_name=topic.type_name)


def start_players(world: World, job: Job, bags: list[Bag]) -> None:
    """Make a publisher for every recorded topic and merge the bags by time, then by order."""
    if not bags:
        return
    from rclpy.node import Node

    from rsltrace.model.event import EventKind
    from rsltrace.ros.player import Player, make_publisher

    core = world.core
    streams: list[Iterator[tuple[int, Any, bytes]]] = []

    def build() -> None:
        player = Node("rosbag2_player", start_parameter_services=False, enable_rosout=False)
        publishers: dict[str, Any] = {}
        for spec, bag in zip(job.bags, bags, strict=True):
            for topic in bag.topics:
                if topic.name not in publishers:
                    publishers[topic.name] = make_publisher(
                        core,
                        player.handle,
                        bag=spec.path,
                        topic=topic.name,
                        type_name=topic.type_name,
                        qos=_qos_values(topic.qos),
                    )
            ends = [publishers[topic.name] for topic in bag.topics]
            streams.append(_messages(bag, ends))
        world.keep(player)

    core.run_outside(lambda: "the bag player", EventKind.CONSTRUCT, 0, None, build)
    if core.loop.stopped is not None:
        return
    ends_run = not has_stop(job)

    def on_end() -> None:
        if ends_run:
            core.loop.stop_after_step(Stop("end of the bag"))

    Player(core, heapq.merge(*streams, key=lambda message: message[0]), on_end).start()


def _messages(bag: Bag, publishers: list[Any]) -> Iterator[tuple[int, Any, bytes]]:
    for stamp_ns, topic, data in bag.messages():
        yield stamp_ns, publishers[topic], data


def _qos_values(qos: Any) -> dict[str, Any]:
    if qos is None:
        return {}
    return {
        name: getattr(value, "name", value)
        for name in ("reliability", "durability", "history", "depth")
        if (value := getattr(qos, name, None)) is not None
    }
