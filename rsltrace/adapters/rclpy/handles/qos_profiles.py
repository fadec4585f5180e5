"""QoS profiles, from rclpy's structures to the middleware's and back."""

from __future__ import annotations

from typing import Any

from rsltrace.simulation.middleware.qos.policies import (
    INFINITE_NS,
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
)


def qos_of(profile: Any) -> Qos:
    """Read an ``rmw_qos_profile_t`` of rclpy."""
    values = profile.to_dict()
    return Qos(
        history=History(int(values["history"])),
        depth=int(values["depth"]),
        reliability=Reliability(int(values["reliability"])),
        durability=Durability(int(values["durability"])),
        deadline_ns=_limit(values["deadline"].nanoseconds),
        lifespan_ns=_limit(values["lifespan"].nanoseconds),
        liveliness=Liveliness(int(values["liveliness"])),
        lease_ns=_limit(values["liveliness_lease_duration"].nanoseconds),
        avoid_ros_namespace_conventions=bool(values["avoid_ros_namespace_conventions"]),
    )


def profile_of(qos: Qos) -> dict[str, Any]:
    """Return what ``TopicEndpointInfo`` takes for a QoS profile."""
    from rclpy.duration import Duration

    return {
        "history": int(qos.history),
        "depth": qos.depth,
        "reliability": int(qos.reliability),
        "durability": int(qos.durability),
        "lifespan": Duration(nanoseconds=qos.lifespan_ns or INFINITE_NS),
        "deadline": Duration(nanoseconds=qos.deadline_ns or INFINITE_NS),
        "liveliness": int(qos.liveliness),
        "liveliness_lease_duration": Duration(nanoseconds=qos.lease_ns or INFINITE_NS),
        "avoid_ros_namespace_conventions": qos.avoid_ros_namespace_conventions,
    }


def _limit(duration_ns: int) -> int:
    return 0 if duration_ns >= INFINITE_NS else int(duration_ns)
