"""Functions of rclpy that no simulation calls, because the loop does their work itself.

Whoever replaces one (a monitoring library, say) waits in vain: a run tells of it, and so does
``audit``.
"""

from __future__ import annotations

_TAKES = (
    *("_take_timer", "_take_subscription", "_take_client", "_take_service"),
    *("_take_guard_condition", "_take_waitable", "_make_handler", "can_execute"),
    "_wait_for_ready_callbacks",
)
EXECUTOR = "rclpy.executors.Executor"
_GROUP = ("can_execute", "beginning_execution", "ending_execution")

NEVER_CALLED: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        (
            EXECUTOR,
            "rclpy.executors.SingleThreadedExecutor",
            "rclpy.executors.MultiThreadedExecutor",
        ),
        _TAKES,
    ),
    "rclpy.callback_groups.MutuallyExclusiveCallbackGroup": _GROUP,
    "rclpy.callback_groups.ReentrantCallbackGroup": _GROUP,
}
"""The methods by the names of their classes. A subclass of a callback group is asked, and so is an
executor's ``wait_for_ready_callbacks``."""


__all__ = ["EXECUTOR", "NEVER_CALLED"]
