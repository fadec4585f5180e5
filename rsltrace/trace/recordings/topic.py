"""What a bag says about its topics: frozen values, as given in the recording."""

from __future__ import annotations

from dataclasses import dataclass

DURATION_INFINITE_NS = 2**63 - 1
"""A QoS duration without end, as ROS 2 writes it."""


@dataclass(frozen=True, slots=True)
class BagQos:
    """The QoS one publisher offered when it was recorded.

    Policies are ROS's lower-case words (``keep_last``, ``reliable``, ``transient_local``,
    ``unknown``, ...). Durations are in nanoseconds: 0 is "not specified",
    ``DURATION_INFINITE_NS`` is without end. ``depth`` is often 0: publishers do not announce it.
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

    ``offered_qos`` has one entry per publisher that was recorded. ``message_count`` counts the
    whole recording, whatever the start offset. ``schema_text`` is the type's definition in
    ``schema_encoding`` (``ros2msg`` or ``ros2idl``) with its dependencies, if the recording
    carries it; ``type_hash`` is ``RIHS01_...`` or empty.
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
        """What all recorded publishers offered alike, or ``None`` when unknown or at odds."""
        distinct = set(self.offered_qos)
        return next(iter(distinct)) if len(distinct) == 1 else None
