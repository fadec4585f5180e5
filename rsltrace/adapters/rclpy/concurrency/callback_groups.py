"""Callback groups: rclpy's two kinds are read directly, custom ones through their methods.

A plain callback runs to its end before anything else, so only a suspended coroutine or a blocked
call keeps a mutually exclusive group busy. The methods of a custom group are called as rclpy's
executors do. A group that refuses is asked again when one of its callbacks has ended, and whenever
nothing else is ready.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.errors import RunError
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.middleware.domain import Domain

Parked = tuple[Dispatchable, int, Callable[[], None]]
"""A handle that waits for its callback group, since when (ns), and the function to call then."""


class CallbackGroups:
    """The events that wait until their callback group is free."""

    def __init__(self, domain: Domain) -> None:
        self._loop = domain.loop
        self._event = domain.event
        self.parked: dict[object, list[Parked]] = {}
        self._looked_after = -1

    def park(self, group: object, handle: Dispatchable, retry: Callable[[], None]) -> None:
        """Keep an event whose callback group is busy; ``retry`` runs when the group is free."""
        self.parked.setdefault(group, []).append((handle, self._loop.now_ns, retry))
        if is_custom(group) and self._look not in self._loop.idle:
            self._loop.idle.append(self._look)

    def must_wait(self, handle: Any, wrapper: Any) -> bool:
        """Return whether a ready callback must wait for its group; if so it is parked until the
        group is free."""
        ready, group = self._loop.ready, wrapper.callback_group
        if is_custom(group):
            return not self.enter(handle, wrapper, lambda: ready.appendleft(handle))
        if not is_busy(group, wrapper):
            return False
        self.park(group, handle, lambda: ready.appendleft(handle))
        return True

    def enter(self, handle: Any, wrapper: Any, retry: Callable[[], None]) -> bool:
        """Begin a callback of a custom group until the event ends, or park it if the group refuses.

        :raises RunError: if a method of the group raised.
        """
        group = wrapper.callback_group
        if all(_call(group, name, wrapper) for name in ("can_execute", "beginning_execution")):
            self._event.on_end = lambda: self.end(group, wrapper)
            return True
        self.park(group, handle, retry)
        return False

    def begin_coroutine(self, group: Any, wrapper: Any) -> None:
        """Mark the begin of a coroutine; it marks its end itself."""
        if is_custom(group):
            self._event.on_end = None  # ``enter`` has begun it
        else:
            begin(group, wrapper)

    def _look(self) -> bool:
        """Ask custom groups once more: their state may have changed."""
        own = [group for group in self.parked if is_custom(group)]
        if not own:
            self._loop.idle.remove(self._look)
        if self._looked_after == self._loop.events:
            return False
        self._looked_after = self._loop.events
        free = [group for group in own if self._lets_any(group)]
        for group in free:
            self._retry(group)
        return bool(free)

    def _lets_any(self, group: object) -> bool:
        parked: list[Any] = [handle for handle, _, _ in self.parked[group]]
        return any(_call(group, "can_execute", handle.wrapper) for handle in parked)

    def end(self, group: Any, wrapper: Any) -> None:
        """Mark the end of a callback, and run next the events that waited for its group."""
        if group is None:
            return
        if is_custom(group):
            _call(group, "ending_execution", wrapper)
        else:
            group.ending_execution(wrapper)
        self._retry(group)

    def _retry(self, group: object) -> None:
        for _, _, retry in reversed(self.parked.pop(group, ())):
            retry()

    def waiting_for(self, group: object) -> int:
        return len(self.parked.get(group, ()))


def is_busy(group: Any, wrapper: Any) -> bool:
    """Return whether ``group`` forbids to run ``wrapper``'s callback now."""
    if is_custom(group):
        return not _call(group, "can_execute", wrapper)
    active = getattr(group, "_active_entity", group)  # a mutually exclusive group has one
    if active is None:
        return False
    return active is not group or (group is not None and not group.can_execute(wrapper))


def is_custom(group: object) -> bool:
    """Return whether a group's class overrides the methods of rclpy's groups."""
    if group is None:
        return False
    kind = type(group)
    known = _custom.get(kind)
    if known is None:
        known = _custom[kind] = _has_methods_of_its_own(kind)
    return known


_custom: WeakKeyDictionary[type, bool] = WeakKeyDictionary()


def _has_methods_of_its_own(kind: type) -> bool:
    from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

    return not any(
        all(getattr(kind, name) is getattr(own, name) for name in _METHODS)
        for own in (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup)
    )


_METHODS = ("can_execute", "beginning_execution", "ending_execution")


def _call(group: Any, method: str, wrapper: Any) -> Any:
    try:
        return getattr(group, method)(wrapper)
    except Exception as error:
        name = f"{type(group).__qualname__}.{method}"
        raise RunError(
            f"the callback group's {name} raised {type(error).__qualname__}: {error}"
        ) from error


def begin(group: Any, wrapper: Any) -> None:
    """Mark the begin of a callback that may be suspended."""
    if group is not None:
        group.beginning_execution(wrapper)


def exclusive_group(group: Any) -> object | None:
    """Return the group if it is mutually exclusive."""
    return group if hasattr(group, "_active_entity") else None
