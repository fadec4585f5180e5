"""The orders of ROS's own executors, which look at what is ready only now and then.

An executor that waits on a wait set learns of messages at *polling points*. What was ready there is
run, each entity once and in a fixed order; what arrives meanwhile is for the next polling point,
whatever its priority (Casini, Blaß, Lütkebohle, Brandenburg: Response-time analysis of ROS 2
processing chains under reservation-based scheduling, ECRTS 2019).
"""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.loop.policy import Candidate, Moment

_RCLCPP = ("timer", "subscription", "service", "client")
_RCLPY = ("timer", "subscription", "guard_condition", "client", "service")
_Key = tuple[int, int]


class WaitSet:
    """rclcpp's executor, up to Humble, as the analyses have it: a timer that is due runs first,
    polling point or not; then what the last polling point has found: subscriptions, services,
    clients, others, each kind in the order of creation."""

    def __init__(self) -> None:
        self._found: dict[str, set[_Key]] = {}

    def choose(self, ready: Sequence[Candidate], moment: Moment) -> int:
        """Return what runs next on the executor of the first that is ready."""
        executor = ready[0].executor
        mine = [index for index, one in enumerate(ready) if one.executor == executor]
        at_once = [index for index in mine if self._needs_no_polling(ready[index])]
        if at_once:
            return min(at_once, key=lambda index: self.place(ready[index]))
        found = self._found.get(executor, set())
        left = [index for index in mine if _key(ready[index]) in found]
        if not left:  # a polling point
            left = mine
            found = self._found[executor] = {_key(ready[index]) for index in mine}
        chosen = min(left, key=lambda index: self.place(ready[index]))
        found.discard(_key(ready[chosen]))
        return chosen

    def _needs_no_polling(self, candidate: Candidate) -> bool:
        return candidate.kind == "timer"

    def place(self, candidate: Candidate) -> tuple[int, ...]:
        """Return what those that a polling point has found are sorted by."""
        return _rank(_RCLCPP, candidate.kind, last=True), candidate.entity_id


class RclpyWaitSet(WaitSet):
    """rclpy's single-threaded executor: timers wait for polling points, too. Actions and the like
    come first, then node by node timers, subscriptions, guard conditions, clients, services."""

    def _needs_no_polling(self, candidate: Candidate) -> bool:
        return False

    def place(self, candidate: Candidate) -> tuple[int, ...]:
        rank = _rank(_RCLPY, candidate.kind, last=False)
        node = getattr(getattr(candidate.item, "node", None), "entity_id", 0)
        return min(rank, 0), node, rank, candidate.entity_id


def _key(candidate: Candidate) -> _Key:
    return candidate.entity_id, candidate.thread


def _rank(kinds: tuple[str, ...], kind: str, *, last: bool) -> int:
    """Return the place of a kind; others come before (-1) or after all."""
    if kind in kinds:
        return kinds.index(kind)
    return len(kinds) if last else -1
