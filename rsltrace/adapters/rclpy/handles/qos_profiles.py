"""QoS profiles, from rclpy's structures to the middleware's and back."""

from __future__ import annotations

from typing import Any, NamedTuple

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
    """Return 0 for a duration that is infinite or "best available", a nanosecond less."""
    return 0 if duration_ns >= INFINITE_NS - 1 else int(duration_ns)


# The words of ``rmw_qos_profile_check_compatible``. Of each policy: what a publisher offers and a
# subscription wants so that they are incompatible, the error then, and the warnings if the value of
# both, of the publisher or of the subscription may be anything.

_POLICIES = {
    "reliability": (
        (Reliability.BEST_EFFORT, Reliability.RELIABLE),
        "Best effort publisher and reliable subscription",
        "Publisher reliability is %s and subscription reliability is %s",
        "Reliable subscription, but publisher is %s",
        "Best effort publisher, but subscription is %s",
    ),
    "durability": (
        (Durability.VOLATILE, Durability.TRANSIENT_LOCAL),
        "Volatile publisher and transient local subscription",
        "Publisher durabilty is %s and subscription durability is %s",
        "Transient local subscription, but publisher is %s",
        "Volatile publisher, but subscription is %s",
    ),
    "liveliness": (
        (Liveliness.AUTOMATIC, Liveliness.MANUAL_BY_TOPIC),
        "Publisher's liveliness is automatic and subscription's is manual by topic",
        "Publisher liveliness is %s and subscription liveliness is %s",
        "Subscription's liveliness is manual by topic, but publisher's is %s",
        "Publisher's liveliness is automatic, but subscription's is %s",
    ),
}
_LIMITS = {
    "durability": (
        "deadline",
        "Subscription has a deadline, but publisher does not",
        "Subscription deadline is less than publisher deadline",
    ),
    "liveliness": (
        "liveliness_lease_duration",
        "Subscription has a liveliness lease duration, but publisher does not",
        "Subscription liveliness lease duration is less than publisher",
    ),
}
"""Of each limit, after the policy that is checked before it: the errors if a publisher has none, or
a longer one than the subscription."""
_UNKNOWN = {
    "reliability": Reliability.UNKNOWN,
    "durability": Durability.UNKNOWN,
    "liveliness": Liveliness.UNKNOWN,
}
_OK, _WARNING, _ERROR = 0, 1, 2


class QosResult(NamedTuple):
    """Stands in for ``QoSCheckCompatibleResult``."""

    compatibility: Any
    reason: str


def compatibility(publisher: dict[str, Any], subscription: dict[str, Any]) -> tuple[int, str]:
    """Return whether two profiles (as ``to_dict`` has them) are compatible, and why not."""
    errors, warnings = [], []
    for policy, (bad, error, both, of_publisher, of_subscription) in _POLICIES.items():
        pair = (int(publisher[policy]), int(subscription[policy]))
        words = ["unknown" if value else "system_default" for value in pair]
        may_be_anything = [value in (0, _UNKNOWN[policy]) for value in pair]
        if pair == bad:
            errors.append(error)
        elif all(may_be_anything):
            warnings.append(both % tuple(words))
        elif may_be_anything[0] and pair[1] == bad[1]:
            warnings.append(of_publisher % words[0])
        elif may_be_anything[1] and pair[0] == bad[0]:
            warnings.append(of_subscription % words[1])
        if policy in _LIMITS:
            name, without, less = _LIMITS[policy]
            limit, wanted = publisher[name].nanoseconds, subscription[name].nanoseconds
            if wanted and not limit:
                errors.append(without)
            elif wanted and wanted < limit:
                errors.append(less)
    if errors:
        return _ERROR, "".join(f"ERROR: {text};" for text in errors)
    return _WARNING if warnings else _OK, "".join(f"WARNING: {text};" for text in warnings)
