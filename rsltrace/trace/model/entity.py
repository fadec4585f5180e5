"""What can run a callback or produce an output: the entities of a ROS graph."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class EntityKind(IntEnum):
    """Kinds of entities. The numbers are part of the trace format; never reuse one."""

    SYSTEM = 0
    NODE = 1
    PUBLISHER = 2
    SUBSCRIPTION = 3
    TIMER = 4
    CLIENT = 5
    SERVICE = 6
    GUARD_CONDITION = 7
    TASK = 8
    QOS_EVENT = 9
    ACTION_CLIENT = 10
    ACTION_SERVER = 11
    MAIN = 12
    THREAD = 13

    @property
    def label(self) -> str:
        """The name used on screens: ``guard condition``."""
        return self.name.lower().replace("_", " ")


WITH_TOPIC = frozenset(
    (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION, EntityKind.CLIENT, EntityKind.SERVICE)
)
"""Kinds of entities whose name is that of a topic or service."""


@dataclass(frozen=True, slots=True)
class Entity:
    """One entity of the graph as the trace knows it.

    ``id`` counts up in creation order and is never reused. ``node`` is the id of the owning node
    (a node owns itself; 0 is the run). ``name`` is the fully qualified topic, service or node
    name; a timer, guard condition or task is named after its callback. ``type`` is the interface
    (``std_msgs/msg/UInt64``) or empty. ``detail`` holds what only one kind has (QoS, period_ns,
    callback, source) as JSON-compatible values.
    """

    id: int
    node: int
    kind: EntityKind
    name: str
    type: str
    created_ns: int
    detail: dict[str, object]

    @property
    def source(self) -> str:
        """Where the function that its events run is defined, ``module.py:24``; "" if unknown."""
        source = self.detail.get("source")
        return source if isinstance(source, str) else ""
