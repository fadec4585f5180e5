"""The goals of an action server, each with its state machine.

The rules are those of rcl_action (ROS 2 Jazzy).
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.handles.destroyable import Handle

# Numbers of action_msgs/msg/GoalStatus.
ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 3, 4, 5, 6
_TRANSITIONS = {
    (ACCEPTED, "EXECUTE"): EXECUTING,
    (ACCEPTED, "CANCEL_GOAL"): CANCELING,
    (EXECUTING, "CANCEL_GOAL"): CANCELING,
    (EXECUTING, "SUCCEED"): SUCCEEDED,
    (EXECUTING, "ABORT"): ABORTED,
    (CANCELING, "SUCCEED"): SUCCEEDED,
    (CANCELING, "ABORT"): ABORTED,
    (CANCELING, "CANCELED"): CANCELED,
}


class GoalHandle(Handle):
    """Stands in for ``_rclpy.ActionGoalHandle``: the state machine of one accepted goal."""

    def __init__(self, real: Any, goals: dict[bytes, GoalHandle], info: Any) -> None:
        super().__init__()
        goal_id = bytes(info.goal_id.uuid)
        if goal_id in goals:
            raise real.RCLError("goal ID already exists")
        self._real = real
        self.info = info
        self.status = ACCEPTED
        self.accepted_ns = info.stamp.sec * 1_000_000_000 + info.stamp.nanosec
        self.done_ns: int | None = None
        self.status_bytes = b""
        """What a message of its status says of it, but for the status, once there has been one."""
        goals[goal_id] = self

    def get_status(self) -> int:
        """Return the status, a number of GoalStatus."""
        return self.status

    def is_active(self) -> bool:
        """Return whether the goal has not come to an end."""
        return self.status in (ACCEPTED, EXECUTING, CANCELING)

    def cancelable(self) -> bool:
        """Return whether a cancel request may still stop the goal."""
        return (self.status, "CANCEL_GOAL") in _TRANSITIONS

    def update_goal_state(self, event: Any) -> None:
        """Go to the state that an event leads to. Raises RCLError if it leads nowhere."""
        state = _TRANSITIONS.get((self.status, event.name))
        if state is None:
            raise self._real.RCLError(
                f"goal_handle attempted invalid transition from state {self.status} "
                f"with event {event.name}"
            )
        self.status = state
