"""Callback groups: rclpy's two own kinds are looked at directly, others through their methods.

A plain callback runs to its end before the loop does anything else, so only a suspended coroutine
ever keeps a mutually exclusive group busy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core


def is_busy(group: Any, wrapper: Any) -> bool:
    """Return whether ``group`` forbids to run ``wrapper``'s callback now."""
    active = getattr(group, "_active_entity", group)  # a mutually exclusive group has one
    if active is None:
        return False
    return active is not group or (group is not None and not group.can_execute(wrapper))


def must_wait(core: Core, handle: Any, wrapper: Any) -> bool:
    """Return whether a callback that is ready must wait for its group; if so it is parked, and is
    ready again when the group is free."""
    if not is_busy(wrapper.callback_group, wrapper):
        return False
    core.park(wrapper.callback_group, handle, lambda: core.loop.ready.appendleft(handle))
    return True


def begin(group: Any, wrapper: Any) -> None:
    """Mark that a callback is under way that may be suspended."""
    if group is not None:
        group.beginning_execution(wrapper)


def end(core: Core, group: Any, wrapper: Any) -> None:
    """Mark its end, and let those run who waited."""
    if group is not None:
        group.ending_execution(wrapper)
        core.group_freed(group)
