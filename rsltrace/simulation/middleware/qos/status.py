"""The QoS statuses of an endpoint: counts, as DDS keeps them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from rsltrace.simulation.middleware.qos.policies import PolicyKind

MATCHED = "matched"
INCOMPATIBLE = "incompatible"
MESSAGE_LOST = "message_lost"
DEADLINE_MISSED = "deadline_missed"
LIVELINESS_CHANGED = "liveliness_changed"
LIVELINESS_LOST = "liveliness_lost"


@dataclass
class MatchedStatus:
    """``rmw_matched_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    current_count: int = 0
    current_count_change: int = 0


@dataclass
class IncompatibleQosStatus:
    """``rmw_requested_qos_incompatible_event_status_t``."""

    total_count: int = 0
    total_count_change: int = 0
    last_policy_kind: int = 1


@dataclass
class CountStatus:
    """The statuses that only count: deadlines, lost messages, lost liveliness."""

    total_count: int = 0
    total_count_change: int = 0


@dataclass
class LivelinessChangedStatus:
    """``rmw_liveliness_changed_status_t``: publishers that are alive, or not."""

    alive_count: int = 0
    not_alive_count: int = 0
    alive_count_change: int = 0
    not_alive_count_change: int = 0


_KINDS: dict[str, type] = {
    MATCHED: MatchedStatus,
    INCOMPATIBLE: IncompatibleQosStatus,
    LIVELINESS_CHANGED: LivelinessChangedStatus,
}


class EndpointEvents:
    """The statuses of one endpoint, and their listeners."""

    __slots__ = ("_statuses", "listeners")

    def __init__(self) -> None:
        self.listeners: dict[str, Any] = {}  # QosEvents, by status
        self._statuses: dict[str, Any] = {}

    def matched(self, change: int) -> None:
        """Count a peer that connected (+1) or disconnected (-1)."""
        self.add(MATCHED, current=change, **({"total": change} if change > 0 else {}))

    def incompatible(self, policy: PolicyKind) -> None:
        self._status(INCOMPATIBLE).last_policy_kind = int(policy)
        self.add(INCOMPATIBLE, total=1)

    def add(self, name: str, **changes: int) -> None:
        """Add to counts (``total=1`` adds to ``total_count`` and to its change)."""
        status = self._status(name)
        for count, change in changes.items():
            field = f"{count}_count"
            setattr(status, field, getattr(status, field) + change)
            field += "_change"
            setattr(status, field, getattr(status, field) + change)
        listener = self.listeners.get(name)
        if listener is not None:
            listener.trigger()

    def news(self, name: str) -> bool:
        status = self._statuses.get(name)
        return status is not None and any(getattr(status, field) for field in _changes(status))

    def take(self, name: str) -> Any:
        """Return the status and reset its changes."""
        status = self._status(name)
        taken = replace(status)
        for field in _changes(status):
            setattr(status, field, 0)
        return taken

    def _status(self, name: str) -> Any:
        status = self._statuses.get(name)
        if status is None:
            status = self._statuses[name] = _KINDS.get(name, CountStatus)()
        return status


def _changes(status: Any) -> list[str]:
    return [field.name for field in fields(status) if field.name.endswith("_change")]
