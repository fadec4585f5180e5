"""The entities of a ROS graph: what can run a callback or produce an output."""

from __future__ import annotations

from enum import IntEnum

from rsltrace.fast_dataclass import dataclass


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
        """The displayed name: ``guard condition``."""
        return self.name.lower().replace("_", " ")


WITH_TOPIC = frozenset(
    (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION, EntityKind.CLIENT, EntityKind.SERVICE)
)
"""Kinds of entities named after a topic or service."""


@dataclass(frozen=True, slots=True)
class Entity:
    """One entity of the graph.

    ``id`` counts up in creation order and is never reused. ``node`` is the id of the owning node (a
    node owns itself; 0 is the run). ``name`` is the fully qualified topic, service or node name; a
    timer, guard condition or task is named after its callback. ``type`` is the interface
    (``std_msgs/msg/UInt64``) or empty. ``detail`` has what only some kinds have (QoS, period_ns,
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
        """Where the function of its events is defined, ``module.py:24``; "" if unknown."""
        source = self.detail.get("source")
        return source if isinstance(source, str) else ""
