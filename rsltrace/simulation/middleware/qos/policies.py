"""QoS as this middleware uses it, and who connects to whom.

The compatibility rules are DDS's "requested versus offered" ones, as documented in
https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Quality-of-Service-Settings.html
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum
from typing import Any

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.texts import format_duration


class Reliability(IntEnum):
    """Numbers of ``rmw_qos_reliability_policy_t``."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class Durability(IntEnum):
    """Numbers of ``rmw_qos_durability_policy_t``."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class History(IntEnum):
    """Numbers of ``rmw_qos_history_policy_t``."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class Liveliness(IntEnum):
    """Numbers of ``rmw_qos_liveliness_policy_t``."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


class PolicyKind(IntEnum):
    """Numbers of ``rmw_qos_policy_kind_t``."""

    INVALID = 1
    DURABILITY = 2
    DEADLINE = 4
    LIVELINESS = 8
    RELIABILITY = 16
    LIVELINESS_LEASE_DURATION = 256


INFINITE_NS = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Qos:
    """A QoS profile; durations in nanoseconds, 0 or ``INFINITE_NS`` meaning no limit."""

    history: History
    depth: int
    reliability: Reliability
    durability: Durability
    deadline_ns: int
    lifespan_ns: int
    liveliness: Liveliness
    lease_ns: int
    avoid_ros_namespace_conventions: bool = False

    def resolved(self, *, publisher: bool, peers: list[Qos]) -> Qos:
        """Replace system defaults and "best available" by what the middleware settles on.

        System defaults are Fast DDS's: writers are reliable, readers best effort, both volatile,
        keep last 1. "Best available" for a subscription is the strongest policy that every
        present publisher offers; a publisher simply offers the strongest.
        """
        history, depth = self.history, self.depth
        if history in (History.SYSTEM_DEFAULT, History.UNKNOWN):
            history = History.KEEP_LAST
        if history is History.KEEP_LAST and depth == 0:
            depth = 1
        reliability = self.reliability
        if reliability in (Reliability.SYSTEM_DEFAULT, Reliability.UNKNOWN):
            reliability = Reliability.RELIABLE if publisher else Reliability.BEST_EFFORT
        elif reliability is Reliability.BEST_AVAILABLE:
            strong = publisher or all(p.reliability is Reliability.RELIABLE for p in peers)
            reliability = Reliability.RELIABLE if strong else Reliability.BEST_EFFORT
        durability = self.durability
        if durability in (Durability.SYSTEM_DEFAULT, Durability.UNKNOWN):
            durability = Durability.VOLATILE
        elif durability is Durability.BEST_AVAILABLE:
            strong = publisher or all(p.durability is Durability.TRANSIENT_LOCAL for p in peers)
            durability = Durability.TRANSIENT_LOCAL if strong else Durability.VOLATILE
        liveliness = self.liveliness
        if liveliness is not Liveliness.MANUAL_BY_TOPIC:
            liveliness = Liveliness.AUTOMATIC
        return replace(
            self,
            history=history,
            depth=depth,
            reliability=reliability,
            durability=durability,
            liveliness=liveliness,
        )

    @property
    def keep(self) -> int | None:
        """The size of a queue; None: unlimited."""
        return None if self.history is History.KEEP_ALL else max(self.depth, 1)

    def describe(self) -> str:
        """Return the policies in words, without those that are not limited."""
        words = [self.reliability.name, self.durability.name]
        words.append("KEEP_ALL" if self.keep is None else f"KEEP_LAST {self.keep}")
        if self.liveliness is Liveliness.MANUAL_BY_TOPIC:
            words.append("LIVELINESS MANUAL_BY_TOPIC")
        limits = ("deadline_ns", "lease_ns", "lifespan_ns")
        texts = [
            f"{name.removesuffix('_ns')} {format_duration(value)}"
            for name in limits
            if 0 < (value := getattr(self, name)) < INFINITE_NS
        ]
        return ", ".join((*(word.lower().replace("_", " ") for word in words), *texts))

    def to_yaml(self) -> str:
        """Return the YAML list that rosbag2 keeps as ``offered_qos_profiles``."""
        lines = [
            f"- history: {self.history.name.lower()}",
            f"  depth: {self.depth}",
            f"  reliability: {self.reliability.name.lower()}",
            f"  durability: {self.durability.name.lower()}",
            *_yaml_duration("deadline", self.deadline_ns),
            *_yaml_duration("lifespan", self.lifespan_ns),
            f"  liveliness: {self.liveliness.name.lower()}",
            *_yaml_duration("liveliness_lease_duration", self.lease_ns),
            "  avoid_ros_namespace_conventions: "
            + ("true" if self.avoid_ros_namespace_conventions else "false"),
        ]
        return "\n".join(lines)

    def summary(self) -> dict[str, object]:
        """Return the policies to show for an entity; durations only if they are limits."""
        shown: dict[str, object] = {
            "history": self.history.name.lower(),
            "depth": self.depth,
            "reliability": self.reliability.name.lower(),
            "durability": self.durability.name.lower(),
        }
        for name in ("deadline_ns", "lifespan_ns", "lease_ns"):
            if 0 < getattr(self, name) < INFINITE_NS:
                shown[name] = getattr(self, name)
        if self.liveliness is Liveliness.MANUAL_BY_TOPIC:
            shown["liveliness"] = "manual_by_topic"
        return shown

    @staticmethod
    def from_summary(shown: Mapping[str, object]) -> Qos:
        """Return the profile that ``summary`` shows; what it does not show is as in the default."""
        policies: dict[str, Any] = {}
        for name, kind in _ENUMS.items():
            value = str(shown.get(name)).upper()
            if value in kind.__members__:
                policies[name] = kind[value]
        for name in ("depth", "deadline_ns", "lifespan_ns", "lease_ns"):
            if isinstance(shown.get(name), int):
                policies[name] = shown[name]
        return replace(DEFAULT_QOS, **policies)


_ENUMS: dict[str, type[IntEnum]] = {
    "history": History,
    "reliability": Reliability,
    "durability": Durability,
    "liveliness": Liveliness,
}


def incompatible_policies(offered: Qos, requested: Qos) -> list[PolicyKind]:
    """Return the policies that prevent a connection, none if they match.

    The first is the one that Fast DDS reports, which counts a lease as liveliness.
    """
    found = []
    if (
        offered.reliability is Reliability.BEST_EFFORT
        and requested.reliability is Reliability.RELIABLE
    ):
        found.append(PolicyKind.RELIABILITY)
    if (
        offered.liveliness is Liveliness.AUTOMATIC
        and requested.liveliness is Liveliness.MANUAL_BY_TOPIC
    ) or (offered.lease_ns or INFINITE_NS) > (requested.lease_ns or INFINITE_NS):
        found.append(PolicyKind.LIVELINESS)
    if (offered.deadline_ns or INFINITE_NS) > (requested.deadline_ns or INFINITE_NS):
        found.append(PolicyKind.DEADLINE)
    if (
        offered.durability is Durability.VOLATILE
        and requested.durability is Durability.TRANSIENT_LOCAL
    ):
        found.append(PolicyKind.DURABILITY)
    return found


def _yaml_duration(key: str, duration_ns: int) -> list[str]:
    # rosbag2 writes "infinite" as the largest pair that its duration type holds.
    sec, nsec = divmod(duration_ns or INFINITE_NS, 1_000_000_000)
    return [f"  {key}:", f"    sec: {sec}", f"    nsec: {nsec}"]


DEFAULT_QOS = Qos(
    history=History.KEEP_LAST,
    depth=10,
    reliability=Reliability.RELIABLE,
    durability=Durability.VOLATILE,
    deadline_ns=0,
    lifespan_ns=0,
    liveliness=Liveliness.AUTOMATIC,
    lease_ns=0,
)
"""What rclcpp and rclpy call the default profile."""
