"""Open, check and merge the bags of a job."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

from rsltrace.errors import BagError, SetupError
from rsltrace.fast_dataclass import dataclass
from rsltrace.job import Job, locate, message_at
from rsltrace.job.values.names import check_topic
from rsltrace.run.plans.faults import BagFaults, check_changes
from rsltrace.run.stop_rules import end_ns_of, has_stop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.format import PREFIX_OWN
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import NS_PER_S, format_duration, format_seconds, printable

if TYPE_CHECKING:
    from rsltrace.adapters.rclpy.handles.node import NodeHandle
    from rsltrace.adapters.rclpy.world import World
    from rsltrace.job import BagSpec
    from rsltrace.trace.recordings import Bag
    from rsltrace.trace.recordings.playback import Playback
    from rsltrace.trace.recordings.topic import BagTopic, StoredTopic

_Messages = Iterator[tuple[int, Any, bytes]]
"""Simulated time, publisher and bytes of messages that play."""

PLAYER = "rosbag2_player"
"""The node that publishes what bags have, named as ``ros2 bag play`` names its own."""
_ACTION = "/_action/"
_SERVICE_EVENT = "/_service_event"
_LONG_GAP_NS = 3600 * NS_PER_S
"""No robot is silent for that long in the middle of a run: the bags are from different days."""


@dataclass(frozen=True)
class BagInput:
    """One entry of ``bags:`` with its open bag, and when its messages play."""

    spec: BagSpec
    bag: Bag
    playback: Playback

    def name_of(self, topic: BagTopic) -> str:
        """Return the topic name under which a recorded topic plays."""
        return self.spec.remappings.get(topic.name, topic.name)


@contextmanager
def open_bag_of(job: Job, index: int) -> Iterator[BagInput]:
    """Open one bag of a job. Raises BagError."""
    from rsltrace.trace.recordings import open_bag
    from rsltrace.trace.recordings.playback import Playback

    spec = job.bags[index]
    try:
        opened = open_bag(
            job.resolve(spec.path),
            topics=spec.topics,
            exclude=spec.exclude,
            start_offset_ns=spec.start_offset_ns,
            duration_ns=spec.duration_ns,
            recover=True,
            skip=never_plays,
        )
    except BagError as error:
        loc: tuple[str | int, ...] = ("bags", index, "path")
        if error.glob in spec.topics:
            loc = ("bags", index, "topics", spec.topics.index(error.glob or ""))
        raise BagError(message_at(job, loc, str(error))) from error
    with opened as bag:
        _check_names(job, index, bag)
        yield BagInput(
            spec,
            bag,
            Playback(
                bag,
                by=spec.by,
                headers=_with_headers(spec, bag) if spec.by == "header_stamp" else frozenset(),
                rate=Fraction(repr(spec.rate)),
                at_ns=spec.at_ns,
                passes=None if spec.loop is True else int(spec.loop) or 1,
            ),
        )


def never_plays(topic: StoredTopic) -> bool:
    """Whether a topic is never played: of a service, an action, or rsltrace's own."""
    own = topic.name.startswith(PREFIX_OWN)
    return own or _ACTION in topic.name or topic.name.endswith(_SERVICE_EVENT)


def _check_names(job: Job, index: int, bag: Bag) -> None:
    """Raise BagError if a name in the job matches no topic that plays."""
    spec, names = job.bags[index], sorted({topic.name for topic in bag.topics})
    for key, globs in (("remappings", spec.remappings), ("qos", spec.qos)):
        for glob in globs:
            if not any(fnmatchcase(name, glob) for name in names):
                text = f"{spec.path} plays no topic {glob!r}: it plays {', '.join(names)}"
                raise BagError(message_at(job, ("bags", index, key, glob), text))


def _with_headers(spec: BagSpec, bag: Bag) -> frozenset[int]:
    return frozenset(
        index
        for index, topic in enumerate(bag.topics)
        if begins_with_header(check_type(spec.path, topic))
    )


def bag_notes(job: Job, bags: list[BagInput]) -> Iterator[str]:
    """Yield notes on the bags: what is missing or does not play."""
    for index, entry in enumerate(bags):
        yield from entry.bag.notes
        for number, glob in enumerate(entry.spec.exclude):
            if glob in entry.bag.excluded_nothing and not glob.startswith("*"):
                yield (
                    f"{locate(job, ('bags', index, 'exclude', number))}: {entry.spec.path} has no "
                    f"topic {glob!r}, so nothing is left out for it"
                )
        begin_ns = entry.playback.start_ns
        if job.start_ns is not None and begin_ns < job.start_ns:
            yield (
                f"{entry.spec.path}: begins at {format_seconds(begin_ns)} s, before the run does "
                f"({format_seconds(job.start_ns)} s): what comes earlier plays all at once, at the "
                "start; leave it out with start_offset, or move the bag with at"
            )
        services = [name for name in entry.bag.skipped if name.endswith(_SERVICE_EVENT)]
        actions = sorted({n.partition(_ACTION)[0] for n in entry.bag.skipped if _ACTION in n})
        services = [n.removesuffix(_SERVICE_EVENT) for n in services if _ACTION not in n]
        for what, names in (("services", sorted(services)), ("actions", actions)):
            if names:
                yield (
                    f"{entry.spec.path}: recorded {what} are not played: {', '.join(names)} (only "
                    "topics play; what a server answers, its node must answer again)"
                )
    yield from _time_gaps(job, bags)


def _time_gaps(job: Job, bags: list[BagInput]) -> Iterator[str]:
    """Yield the bags that start long after all bags before them have ended."""
    start_ns = run_start_ns(job, bags)
    run_ends_ns = end_ns_of(job, start_ns)
    until_ns: int | None = start_ns
    for entry in sorted(bags, key=lambda entry: entry.playback.start_ns):
        begin_ns = entry.playback.start_ns
        gap_ns = 0 if until_ns is None else begin_ns - until_ns
        begins = f"{entry.spec.path}: begins at {format_seconds(begin_ns)} s, "
        if run_ends_ns is not None and begin_ns > run_ends_ns:
            end = f"after the end of the run ({format_seconds(run_ends_ns)} s)"
            yield f"{begins}{end}: nothing of it plays; move it with at"
        elif gap_ns > _LONG_GAP_NS:
            gap = f"{format_duration(gap_ns)} after everything before it has played"
            yield f"{begins}{gap}, and simulated time passes until then; move it with at"
        end_ns = entry.playback.end_ns
        until_ns = None if until_ns is None or end_ns is None else max(until_ns, end_ns)


def run_start_ns(job: Job, bags: list[BagInput]) -> int:
    """Return the start of the run: the job's, else the first message of the bags, else 0."""
    if job.start_ns is not None:
        return job.start_ns
    return min((entry.playback.start_ns for entry in bags), default=0)


def check_bag_types(job: Job, bags: list[BagInput]) -> None:
    """Raise BagError if a recorded topic's type is not installed, its name is invalid in ROS, or a
    fault's change does not fit."""
    changes = any(fault.change is not None for fault in job.faults)
    for index, entry in enumerate(bags):
        where = f"{locate(job, ('bags', index, 'path'))}: {entry.spec.path}"
        for topic in entry.bag.topics:
            name = entry.name_of(topic)
            name = name if name.startswith("/") else f"/{name}"
            try:
                check_topic(name)
            except ValueError as error:
                raise BagError(
                    f"{where}: a topic cannot be played: {error}; give it another name "
                    "(remappings), or leave it out (exclude)"
                ) from None
            cls = check_type(where, topic)
            if changes:
                check_changes(job, name, cls)


def check_type(bag: str, topic: BagTopic) -> type:
    """Return the message class of a recorded topic.

    :raises BagError: if its type is not installed.
    """
    from rsltrace.adapters.rclpy.messages.interfaces import get_message_class

    try:
        return get_message_class(topic.type_name)
    except SetupError as error:
        raise BagError(
            f"{bag}: topic {topic.name} has type {printable(topic.type_name)}, which is not "
            f"installed here. Install its package, or leave the topic out (exclude: [{topic.name}])"
            f"\n  {error}"
        ) from error


def begins_with_header(message_class: Any) -> bool:
    fields = message_class.get_fields_and_field_types()
    return next(iter(fields.values()), "") == "std_msgs/Header"


def start_players(
    world: World, job: Job, bags: list[BagInput], *, is_open: bool = False
) -> BagFaults | None:
    """Make a publisher for each recorded topic, and merge the bags by time.

    Return the faults of what they play (``is_open``: more may be added), or None without bags.
    """
    if not bags:
        return None
    from rclpy.node import Node

    from rsltrace.adapters.player import Player, make_publisher
    from rsltrace.adapters.rclpy.messages.codec import codec_for
    from rsltrace.adapters.rclpy.messages.interfaces import get_message_class, message_type

    domain = world.domain
    faults = BagFaults(job, is_open=is_open)
    streams: list[_Messages] = []
    progress_publishers: list[Any] = []

    def publisher(node: NodeHandle, topic: str, cls: type, qos: dict[str, Any]) -> Any:
        name = node.resolve(topic, service=False)
        canonical = codec_for(cls).canonical
        return make_publisher(domain, node, name, message_type(cls), canonical, qos)

    def build() -> None:
        player = Node(PLAYER, start_parameter_services=False, enable_rosout=False)
        streams.extend(played_streams(bags, partial(publisher, player.handle))[0])
        if job.progress is not None:
            progress = get_message_class("std_msgs/msg/Float32")
            progress_publishers.append(publisher(player.handle, job.progress, progress, {}))
        world.keep(player)

    world.run_outside("the bag player", EventKind.CONSTRUCT, build)
    if domain.loop.stopped is not None:
        return faults
    ends_run = not has_stop(job)

    def on_end() -> None:
        if ends_run:
            domain.loop.stop_after_step(Stop("end of the bag"))

    merged = streams[0]
    if len(streams) > 1:
        merged = heapq.merge(*streams, key=lambda message: message[0])
    merged = faults.played(merged)
    if progress_publishers:
        merged = with_progress(merged, progress_publishers[0], bags)
    paths = " and ".join(entry.spec.path for entry in bags)
    name = f"the {'bag' if len(bags) == 1 else 'bags'} {paths}"
    Player(domain, merged, name, on_end).start()
    return faults


def played_streams(
    bags: list[BagInput], publisher: Callable[[str, type, dict[str, Any]], Any]
) -> tuple[list[_Messages], list[Any]]:
    """Return the messages of each bag with their publishers, and these: one for each name and type,
    which ``publisher(topic, class, QoS)`` makes."""
    publishers: dict[tuple[str, str], Any] = {}
    streams = []
    for entry in bags:
        ends = []
        for topic in entry.bag.topics:
            key = (entry.name_of(topic), topic.type_name)
            if key not in publishers:
                qos = {**_qos_values(topic.qos), **_qos_override(entry.spec, topic.name)}
                publishers[key] = publisher(key[0], check_type(entry.spec.path, topic), qos)
            ends.append(publishers[key])
        streams.append(_messages(entry.playback, ends))
    return streams, list(publishers.values())


def _messages(playback: Playback, publishers: list[Any]) -> _Messages:
    for stamp_ns, topic, data in playback.messages():
        yield stamp_ns, publishers[topic], data


def _span_ns(bags: list[BagInput]) -> tuple[int, int]:
    """Return when the first bag begins and the last one ends."""
    ends = [entry.playback.end_ns for entry in bags]
    assert all(end is not None for end in ends), "a bag that plays forever has no progress"
    return min(entry.playback.start_ns for entry in bags), max(end for end in ends if end)


def with_progress(messages: _Messages, publisher: Any, bags: list[BagInput]) -> _Messages:
    """Insert progress messages from 0 to 1, at each full percent."""
    start_ns, end_ns = _span_ns(bags)
    last_percent, stamp_ns = -1, start_ns
    for message in messages:
        yield message
        stamp_ns = message[0]
        percent = min((stamp_ns - start_ns) * 100 // max(end_ns - start_ns, 1), 99)
        if percent > last_percent:
            last_percent = percent
            yield stamp_ns, publisher, _float32(percent)
    yield stamp_ns, publisher, _float32(100)


def _float32(percent: int) -> bytes:
    return b"\x00\x01\x00\x00" + struct.pack("<f", percent / 100)


def _qos_override(spec: BagSpec, topic: str) -> dict[str, Any]:
    for glob, qos in spec.qos.items():
        if fnmatchcase(topic, glob):
            return qos.values()
    return {}


def _qos_values(qos: Any) -> dict[str, Any]:
    """Return the known policies of a recorded QoS."""
    if qos is None:
        return {}
    return {
        name: getattr(value, "name", value)
        for name in ("reliability", "durability", "history", "depth")
        if (value := getattr(qos, name, None)) is not None
    }
