"""Callback groups: rclpy's two own kinds are looked at directly, others through their methods.

A plain callback runs to its end before the loop does anything else, so only a suspended coroutine
or a blocked call ever keeps a mutually exclusive group busy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rsltrace.loop.loop import Dispatchable, EventLoop

# What waits for its callback group: the handle, since when (ns), and what to do when it is free.
Parked = tuple[Dispatchable, int, Callable[[], None]]


class CallbackGroups:
    """The events that wait until their callback group is free."""

    def __init__(self, loop: EventLoop) -> None:
        self._loop = loop
        self.parked: dict[object, list[Parked]] = {}

    def park(self, group: object, handle: Dispatchable, retry: Callable[[], None]) -> None:
        """Keep an event whose callback group is busy; ``retry`` runs when the group is free."""
        self.parked.setdefault(group, []).append((handle, self._loop.now_ns, retry))

    def must_wait(self, handle: Any, wrapper: Any) -> bool:
        """Return whether a callback that is ready must wait for its group; if so it is parked, and
        is ready again when the group is free."""
        if not is_busy(wrapper.callback_group, wrapper):
            return False
        ready = self._loop.ready
        self.park(wrapper.callback_group, handle, lambda: ready.appendleft(handle))
        return True

    def end(self, group: Any, wrapper: Any) -> None:
        """Mark the end of a callback, and let the events run that waited for its group, before
        anything else that is ready."""
        if group is None:
            return
        group.ending_execution(wrapper)
        for _, _, retry in reversed(self.parked.pop(group, ())):
            retry()

    def waiting_for(self, group: object) -> int:
        """Return how many events wait until ``group`` is free."""
        return len(self.parked.get(group, ()))


def is_busy(group: Any, wrapper: Any) -> bool:
    """Return whether ``group`` forbids to run ``wrapper``'s callback now."""
    active = getattr(group, "_active_entity", group)  # a mutually exclusive group has one
    if active is None:
        return False
    return active is not group or (group is not None and not group.can_execute(wrapper))


def begin(group: Any, wrapper: Any) -> None:
    """Mark that a callback is under way that may be suspended."""
    if group is not None:
        group.beginning_execution(wrapper)


def exclusive(group: Any) -> object | None:
    """Return a group if it lets only one callback run at a time."""
    return group if hasattr(group, "_active_entity") else None
