"""What a bag says about its topics, as recorded."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from heapq import heappop, heappush
from typing import Any, Protocol

from rsltrace.trace.model.operation import nested_too_deep
from rsltrace.trace.model.texts import NS_PER_S, yaml_problem

DURATION_INFINITE_NS = 2**63 - 1
"""An infinite QoS duration in ROS 2."""


@dataclass(frozen=True, slots=True)
class BagQos:
    """The QoS that one publisher offered when it was recorded.

    Policies are ROS's lower-case words (``keep_last``, ``reliable``, ``transient_local``,
    ``unknown``, ...). Durations are in nanoseconds: 0 is "not specified", ``DURATION_INFINITE_NS``
    is infinite. ``depth`` is often 0: publishers do not announce it.
    """

    history: str
    depth: int
    reliability: str
    durability: str
    deadline_ns: int
    lifespan_ns: int
    liveliness: str
    liveliness_lease_duration_ns: int
    avoid_ros_namespace_conventions: bool


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a bag; two types on one name are two topics.

    ``offered_qos`` has one entry per recorded publisher. ``message_count`` counts the whole
    recording. ``schema_text`` is the type's definition with dependencies in ``schema_encoding``
    (``ros2msg`` or ``ros2idl``), if recorded; ``type_hash`` is ``RIHS01_...`` or empty.
    """

    name: str
    type_name: str
    serialization_format: str
    offered_qos: tuple[BagQos, ...]
    message_count: int
    schema_text: str | None
    schema_encoding: str
    type_hash: str

    @property
    def qos(self) -> BagQos | None:
        """The QoS of all recorded publishers, None if unknown or different."""
        distinct = set(self.offered_qos)
        return next(iter(distinct)) if len(distinct) == 1 else None


# ``offered_qos_profiles`` is YAML text (in storage files, and in metadata.yaml up to version 8) or
# a parsed list (metadata.yaml from version 9); policies are numbers (up to version 8) or words.

# In the order of the enumerations in rmw/types.h.
HISTORY = ("system_default", "keep_last", "keep_all", "unknown")
RELIABILITY = ("system_default", "reliable", "best_effort", "unknown", "best_available")
DURABILITY = ("system_default", "transient_local", "volatile", "unknown", "best_available")
LIVELINESS = (
    "system_default",
    "automatic",
    "manual_by_node",
    "manual_by_topic",
    "unknown",
    "best_available",
)

# An infinite duration in DDS, and in ROS 2 until Galactic.
_DDS_INFINITE = (0x7FFFFFFF, 0xFFFFFFFF)

# YAML's references can make a text of 1 kB a value whose whole text fills all memory.
_short = reprlib.Repr()
_short.maxlevel = 2


def parse_qos(profiles: object) -> tuple[BagQos, ...]:
    """Return the profiles in a YAML text or parsed list. Raises ``ValueError`` for anything else.

    Missing values are "unknown" or 0.
    """
    if isinstance(profiles, str):
        return _parse_text(profiles)
    if profiles is None:
        return ()
    if not isinstance(profiles, list):
        raise ValueError(f"a list of QoS profiles was expected, not {_short.repr(profiles)}")
    return tuple(_profile(item) for item in profiles)


# A recording repeats few texts for many topics, and parsing YAML is slow.
@lru_cache(maxsize=256)
def _parse_text(text: str) -> tuple[BagQos, ...]:
    if not text.strip():
        return ()
    if nested_too_deep(text) >= 0:
        raise ValueError("the QoS profiles are nested too deeply")
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        value = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, RecursionError) as error:
        raise ValueError(f"the QoS profiles are not YAML: {yaml_problem(error)}") from None
    if isinstance(value, str):
        raise ValueError(f"a list of QoS profiles was expected, not {value!r}")
    return parse_qos(value)


def _profile(item: object) -> BagQos:
    if not isinstance(item, dict):
        raise ValueError(f"a QoS profile was expected, not {_short.repr(item)}")
    depth = item.get("depth", 0)
    return BagQos(
        history=_policy(item.get("history"), HISTORY),
        depth=depth if isinstance(depth, int) else 0,
        reliability=_policy(item.get("reliability"), RELIABILITY),
        durability=_policy(item.get("durability"), DURABILITY),
        deadline_ns=_duration_ns(item.get("deadline")),
        lifespan_ns=_duration_ns(item.get("lifespan")),
        liveliness=_policy(item.get("liveliness"), LIVELINESS),
        liveliness_lease_duration_ns=_duration_ns(item.get("liveliness_lease_duration")),
        avoid_ros_namespace_conventions=item.get("avoid_ros_namespace_conventions") is True,
    )


def _policy(value: object, words: tuple[str, ...]) -> str:
    if isinstance(value, int) and 0 <= value < len(words):
        return words[value]
    if isinstance(value, str) and value.lower() in words:
        return value.lower()
    return "unknown"


def _duration_ns(value: Any) -> int:
    if not isinstance(value, dict):
        return 0
    sec, nsec = value.get("sec", 0), value.get("nsec", 0)
    if not isinstance(sec, int) or not isinstance(nsec, int):
        return 0
    if (sec, nsec) == _DDS_INFINITE:
        return DURATION_INFINITE_NS
    return min(max(sec * NS_PER_S + nsec, 0), DURATION_INFINITE_NS)


@dataclass(frozen=True, slots=True)
class StoredTopic(BagTopic):
    """A topic (in MCAP: a channel) of one storage file; ``id`` is unique in the file."""

    id: int


@dataclass(frozen=True, slots=True)
class Extent:
    """A part of a storage file that is read at once: its position and time span."""

    offset: int
    length: int
    start_ns: int
    end_ns: int


class Storage(Protocol):
    """One open storage file. Every method raises ``BagError`` naming the file.

    ``wanted`` maps the file's topic ids to topic indices; messages before ``first_ns`` are skipped.
    """

    topics: list[StoredTopic]
    message_count: int
    start_ns: int
    end_ns: int
    cut_off: str
    """How much of a truncated file is left, in words; empty for a whole one."""
    with_publish_time: bool
    """If set, messages begin with the publish time: 8 bytes, little-endian."""

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the parts that may contain wanted messages, in file order."""

    def read(
        self, extent: Extent, wanted: Mapping[int, int], first_ns: int
    ) -> Iterator[BagMessage]:
        """Yield the wanted messages of a part in time order, equal times in file order."""

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        """Return the number of wanted messages."""

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        """Return the time of the last wanted message."""

    def close(self) -> None:
        """Close the file."""


# Merge many parts of a recording into one stream of messages by time, with few in memory.
#
# The time span of a part (a chunk, a database) is known before it is read, so it is opened only
# when the stream reaches its start, and dropped at its end.

BagMessage = tuple[int, int, bytes]
"""Log time in nanoseconds, index of the topic, CDR bytes."""


@dataclass(frozen=True, slots=True)
class RecordingPart:
    """A part of a recording. ``order`` is its unique position in the recording.

    ``read`` yields its messages by time (equal times in file order), none before ``start_ns``.
    """

    start_ns: int
    order: int
    read: Callable[[], Iterator[BagMessage]]


def merge(pieces: Iterable[RecordingPart]) -> Iterator[BagMessage]:
    """Yield the messages of all parts by (time, order of the part, position in it)."""
    waiting = sorted(pieces, key=lambda piece: (piece.start_ns, piece.order), reverse=True)
    # The order is unique, so comparisons end there.
    opened: list[tuple[int, int, BagMessage, Iterator[BagMessage]]] = []
    while waiting or opened:
        while waiting and (not opened or (waiting[-1].start_ns, waiting[-1].order) < opened[0][:2]):
            piece = waiting.pop()
            rest = piece.read()
            first = next(rest, None)
            if first is not None:
                heappush(opened, (first[0], piece.order, first, rest))
        if not opened:
            continue
        _, order, message, rest = heappop(opened)
        # Usually one part is open: continue it up to where another may come first.
        limits = [entry[:2] for entry in opened[:1]]
        limits += [(piece.start_ns, piece.order) for piece in waiting[-1:]]
        yield message
        if not limits:
            yield from rest
            continue
        limit_ns, limit_order = min(limits)
        for message in rest:
            stamp_ns = message[0]
            if stamp_ns < limit_ns or (stamp_ns == limit_ns and order < limit_order):
                yield message
            else:
                heappush(opened, (stamp_ns, order, message, rest))
                break
