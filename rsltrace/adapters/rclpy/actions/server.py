"""Action servers: three services, two topics, and the accepted goals.

The rules for cancel requests and the expiry of results are rcl_action's (ROS 2 Jazzy).
"""

from __future__ import annotations

from functools import partialmethod
from typing import Any

from rsltrace.adapters.rclpy.actions.action_handle import (
    ACTION,
    ActionHandle,
    ActionService,
    GoalHandle,
)
from rsltrace.adapters.rclpy.concurrency.tasks import start_coroutine
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle
from rsltrace.adapters.rclpy.messages.message_spec import HEADER
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.services import RequestId
from rsltrace.trace.model.event import NO_EVENT

# Return codes of action_msgs/srv/CancelGoal.
_ERROR_NONE, _ERROR_UNKNOWN_GOAL_ID, _ERROR_GOAL_TERMINATED = 0, 2, 3

# The first goal in the CDR of action_msgs/msg/GoalStatusArray has no padding between id and stamp.
_ID, _STAMP_AT = 16, 19


class ActionServerHandle(ActionHandle):
    """Stands in for ``_rclpy.ActionServer``. ``result_timeout`` is in seconds, negative: none."""

    waitable_attribute = "_handle"
    is_client = False

    def __init__(
        self,
        node: NodeHandle,
        clock: Any,
        action_type: Any,
        name: str,
        goal_qos: Any,
        result_qos: Any,
        cancel_qos: Any,
        feedback_qos: Any,
        status_qos: Any,
        result_timeout: float,
    ) -> None:
        super().__init__(node, action_type, name)
        self.real = node.real
        self.goals: dict[bytes, GoalHandle] = {}
        self._timeout_ns = int(result_timeout * 1_000_000_000) if result_timeout >= 0 else None
        self._expired = False
        impl = action_type.Impl
        self._goal = self.own(ActionService, impl.SendGoalService, "send_goal", goal_qos)
        self._cancel = self.own(ActionService, impl.CancelGoalService, "cancel_goal", cancel_qos)
        self._result = self.own(ActionService, impl.GetResultService, "get_result", result_qos)
        self._feedback = PublisherHandle(
            node, impl.FeedbackMessage, self.path("feedback"), feedback_qos
        )
        self._status = PublisherHandle(
            node, impl.GoalStatusMessage, self.path("status"), status_qos
        )
        self.publishers = [self._feedback, self._status]
        self._expiry = _Expiry(self)

    # -- requests and responses ----------------------------------------------------------------

    def is_ready(self, wait_set: Any) -> tuple[bool, bool, bool, bool]:
        """Return whether a goal, cancel or result request is ready, and whether goals expire."""
        parts = (self._goal, self._cancel, self._result)
        goal, cancel, result = (self.is_part_ready(wait_set, part) for part in parts)
        return goal, cancel, result, self._expired

    def get_num_entities(self) -> tuple[int, int, int, int, int]:
        """Count its subscriptions, guard conditions, timers, clients and services, as rcl does."""
        return 0, 0, 1, 0, 3

    def _take_request(self, service: str, request_type: Any) -> tuple[RequestId, Any]:
        """Take the request that is being executed."""
        request, info = getattr(self, service).service_take_request(request_type)
        return info.request_id, request

    take_goal_request = partialmethod(_take_request, "_goal")
    take_cancel_request = partialmethod(_take_request, "_cancel")
    take_result_request = partialmethod(_take_request, "_result")

    def _send_response(self, service: str, header: RequestId, response: Any) -> None:
        getattr(self, service).service_send_response(response, header)

    send_goal_response = partialmethod(_send_response, "_goal")
    send_cancel_response = partialmethod(_send_response, "_cancel")
    send_result_response = partialmethod(_send_response, "_result")

    def publish_feedback(self, message: Any) -> None:
        self._feedback.publish(message)

    def publish_status(self) -> None:
        """Publish the status of every known goal."""
        parts = [goal.status_cdr for goal in self.goals.values()]
        number = len(parts).to_bytes(4, "little")
        if parts:
            parts[0] = parts[0][:_ID] + parts[0][_STAMP_AT:]
        self._status.send(b"".join((HEADER, number, *parts)))

    # -- goals -----------------------------------------------------------------------------------

    def goal_exists(self, goal_info: Any) -> bool:
        return bytes(goal_info.goal_id.uuid) in self.goals

    def process_cancel_request(self, request: Any, response_type: Any) -> Any:
        """Find the goals a cancel request means (rcl_action_process_cancel_request)."""
        wanted = bytes(request.goal_info.goal_id.uuid)
        stamp = request.goal_info.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        by_id, by_time = any(wanted), stamp_ns > 0
        response = response_type(return_code=_ERROR_NONE)
        if by_id and not by_time:
            goal = self.goals.get(wanted)
            if goal is None:
                response.return_code = _ERROR_UNKNOWN_GOAL_ID
                return response
            if not goal.is_active():
                response.return_code = _ERROR_GOAL_TERMINATED
                return response
        for goal_id, goal in self.goals.items():
            earlier = by_time and goal.accepted_ns <= stamp_ns
            if (goal_id == wanted or earlier or not (by_id or by_time)) and goal.cancelable():
                response.goals_canceling.append(goal.info)
        return response

    def notify_goal_done(self) -> None:
        """Schedule the expiry of the results of finished goals."""
        now_ns = self.runtime.loop.now_ns
        for goal in self.goals.values():
            if not goal.is_active() and goal.done_ns is None:
                goal.done_ns = now_ns
                if self._timeout_ns is not None:
                    self.runtime.loop.schedule(now_ns + self._timeout_ns, self._expiry.wake)

    def expire_goals(self, most: int) -> tuple[Any, ...]:
        """Forget expired goals; return their infos."""
        timeout_ns = self._timeout_ns
        if timeout_ns is None:
            return ()
        oldest_ns = self.runtime.loop.now_ns - timeout_ns
        gone = [
            goal_id
            for goal_id, goal in self.goals.items()
            if goal.done_ns is not None and goal.done_ns <= oldest_ns
        ]
        return tuple(self.goals.pop(goal_id).info for goal_id in gone[:most])

    async def expire(self) -> None:
        """Run the waitable as rclpy's executors do when goals expire."""
        waitable = self._expiry.wrapper
        self._expired = True
        try:
            waitable.is_ready(None)
            data = waitable.take_data()
        finally:
            self._expired = False
        await waitable.execute(data)


class _Expiry:
    """Dispatches the expiry of a server's goals, as its goal service in the trace."""

    def __init__(self, server: ActionServerHandle) -> None:
        self._server = server
        self.wrapper: Any = None

    @property
    def entity_id(self) -> int:
        return self._server.parts[0].entity_id

    @property
    def node(self) -> NodeHandle:
        return self._server.node

    def wake(self) -> None:
        if not self._server.destroyed:
            self._server.runtime.loop.ready.append(self)

    def dispatch(self) -> None:
        server = self._server
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return
        self.wrapper = server.find_waitable()
        if self.wrapper is None or server.runtime.groups.must_wait(self, self.wrapper):
            return
        handle: Any = self  # has what start_coroutine needs, but no place in the trace of its own
        start_coroutine(server.runtime, handle, ACTION, server.expire, (), NO_EVENT, 0, 0)

    def runnable(self) -> Runnable:
        handed_over = self.node.mailbox is not None
        return on_no_executor(self.node, self.describe(), "waitable", handed_over=handed_over)

    def describe(self) -> str:
        return f"{self.node.fully_qualified_name}: expiry of goals of {self._server.name}"
