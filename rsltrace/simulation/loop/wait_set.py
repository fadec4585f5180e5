"""The orders of ROS's own executors, which find ready callbacks at polling points.

What a polling point finds runs once per entity in a fixed order; what arrives meanwhile waits for
the next polling point, whatever its priority (Casini, Blaß, Lütkebohle, Brandenburg: Response-time
analysis of ROS 2 processing chains under reservation-based scheduling, ECRTS 2019).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rsltrace.simulation.loop.policy import Candidate, ChoicePoint

_RCLCPP = ("timer", "subscription", "service", "client")
_RCLPY = ("timer", "subscription", "guard_condition", "client", "service")
_ON_NO_EXECUTOR = frozenset(("resume", "thread"))
_Key = tuple[int, int]


class RclcppWaitSetPolicy:
    """rclcpp's executor, up to Humble, as the analyses have it: a timer that is due runs first,
    polling point or not; then what the last polling point has found: subscriptions, services,
    clients, others, each kind in the order of creation."""

    def __init__(self) -> None:
        self._found: dict[str, set[_Key]] = {}

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        executor = ready[0].executor
        mine = [index for index, one in enumerate(ready) if one.executor == executor]
        at_once = [index for index in mine if ready[index].kind == "timer"]
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

    def place(self, candidate: Candidate) -> tuple[int, ...]:
        """Return the sort key of what a polling point has found."""
        return _rank(_RCLCPP, candidate.kind, last=True), candidate.entity_id


class RclpyWaitSetPolicy(RclcppWaitSetPolicy):
    """rclpy's executors, including the user's own. They work in rounds: first the tasks that exist,
    the newest first (the oldest first in releases whose tasks say so); then what a polling point
    finds, each entity once: actions and other waitables, then node by node timers, subscriptions,
    guard conditions, clients, services. What cannot run at its place waits for the next round."""

    polls_from_ns = -1
    """From when on it is asked for all that ``OrderedLoop.polls`` is about."""

    def __init__(self) -> None:
        super().__init__()
        self._rounds: dict[str, _PollingRound] = {}

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        for index, one in enumerate(ready):
            if one.kind in _ON_NO_EXECUTOR:
                return index
        executor = ready[0].executor
        mine = [index for index, one in enumerate(ready) if one.executor == executor]
        tasks = {ready[index].thread: index for index in mine if ready[index].kind == "task"}
        places = [(self.place(ready[i]), i) for i in mine if ready[i].kind != "task"]
        present = self._rounds.setdefault(executor, _PollingRound())
        left = present.left(places, ready)
        if left is not None:
            return left
        number = present.task(tasks, ready)
        if number is None and not places:
            present.begin()
            number = present.task(tasks, ready)
        if number is not None:
            return tasks[number]
        present.poll(ready[index].item for _, index in places)
        chosen = present.left(places, ready)
        assert chosen is not None
        return chosen

    def forget(self, executor: str) -> None:
        """Start a new round for an executor."""
        self._rounds.pop(executor, None)

    def place(self, candidate: Candidate) -> tuple[int, ...]:
        rank = _rank(_RCLPY, candidate.kind, last=False)
        if getattr(candidate.item, "in_waitable", False):
            rank = -1
        node = getattr(getattr(candidate.item, "node", None), "entity_id", 0)
        return min(rank, 0), node, rank, candidate.entity_id


class _PollingRound:
    """The position of an executor in its round: tasks, or what it has found."""

    def __init__(self) -> None:
        self._found: dict[int, Any] = {}
        self._last: tuple[int, ...] = ()
        self.begin()

    def begin(self) -> None:
        self._newest: int | None = None
        self._ran: int | None = None

    def task(self, tasks: Mapping[int, int], ready: Sequence[Candidate]) -> int | None:
        """Return the number of the next task of those that existed at the beginning."""
        if not tasks:
            return None
        oldest_first = any(getattr(ready[i].item, "oldest_first", False) for i in tasks.values())
        ran = self._ran
        if self._newest is None:
            self._newest = max(tasks)
        left = [number for number in tasks if number <= self._newest]
        if ran is not None:
            left = [number for number in left if (number > ran if oldest_first else number < ran)]
        if left:
            self._ran = min(left) if oldest_first else max(left)
            return self._ran
        return None

    def poll(self, items: Iterable[Any]) -> None:
        """Find what is ready."""
        self.begin()
        self._last = ()
        self._found = {id(item): item for item in items}
        for item in self._found.values():
            if hasattr(item, "found"):  # it tells later triggers from those that led here
                item.found()

    def left(
        self, places: Sequence[tuple[tuple[int, ...], int]], ready: Sequence[Candidate]
    ) -> int | None:
        """Take the next of what was found, or None."""
        found = [
            (place, index)
            for place, index in places
            if id(ready[index].item) in self._found and place >= self._last
        ]
        if not found:
            self._found.clear()
            return None
        self._last, chosen = min(found)
        del self._found[id(ready[chosen].item)]
        return chosen


def _key(candidate: Candidate) -> _Key:
    return candidate.entity_id, candidate.thread


def _rank(kinds: tuple[str, ...], kind: str, *, last: bool) -> int:
    """Return the rank of a kind; unknown kinds come first (-1) or last."""
    if kind in kinds:
        return kinds.index(kind)
    return len(kinds) if last else -1
