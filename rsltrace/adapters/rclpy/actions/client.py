"""Action clients: the other ends of a server's services and topics."""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.actions.parts import ActionHandle, GoalClient, GoalSubscription
from rsltrace.adapters.rclpy.handles.node import NodeHandle


class ActionClientHandle(ActionHandle):
    """Stands in for ``_rclpy.ActionClient``."""

    waitable_attribute = "_client_handle"
    is_client = True

    def __init__(
        self,
        node: NodeHandle,
        action_type: Any,
        name: str,
        goal_qos: Any,
        result_qos: Any,
        cancel_qos: Any,
        feedback_qos: Any,
        status_qos: Any,
    ) -> None:
        super().__init__(node, action_type, name)
        impl = action_type.Impl
        self._goal = self.own(GoalClient, impl.SendGoalService, "send_goal", goal_qos)
        self._cancel = self.own(GoalClient, impl.CancelGoalService, "cancel_goal", cancel_qos)
        self._result = self.own(GoalClient, impl.GetResultService, "get_result", result_qos)
        self._feedback = self.own(GoalSubscription, impl.FeedbackMessage, "feedback", feedback_qos)
        self._status = self.own(GoalSubscription, impl.GoalStatusMessage, "status", status_qos)

    def is_action_server_available(self) -> bool:
        """Return whether a server has all of its services and topics."""
        graph = self.node.asked_graph
        services = (self._goal, self._cancel, self._result)
        topics = (self._feedback, self._status)
        return all(graph.services(part.service) for part in services) and all(
            graph.publishers(part.topic) for part in topics
        )

    def is_ready(self, wait_set: Any) -> tuple[bool, bool, bool, bool, bool]:
        """Say which of feedback, status and the three responses is being executed, or is ready in a
        wait set."""
        parts = (self._feedback, self._status, self._goal, self._cancel, self._result)
        feedback, status, goal, cancel, result = (
            self.is_part_ready(wait_set, part) for part in parts
        )
        return feedback, status, goal, cancel, result

    def send_goal_request(self, request: Any) -> int:
        """Send a goal; return the sequence number of the request."""
        return int(self._goal.send_request(request))

    def send_cancel_request(self, request: Any) -> int:
        """Ask for a goal to be cancelled; return the sequence number of the request."""
        return int(self._cancel.send_request(request))

    def send_result_request(self, request: Any) -> int:
        """Ask for a goal's result; return the sequence number of the request."""
        return int(self._result.send_request(request))

    def get_num_entities(self) -> tuple[int, int, int, int, int]:
        """Count its subscriptions, guard conditions, timers, clients and services, as rcl does."""
        return 2, 0, 0, 3, 0

    def _take_response(self, part: GoalClient, response_type: Any) -> tuple[int, Any]:
        info, response = part.take_response(response_type)
        return info.request_id.sequence_number, response

    def take_goal_response(self, response_type: Any) -> tuple[int, Any]:
        """Take the response that is being executed: its sequence number and content."""
        return self._take_response(self._goal, response_type)

    def take_cancel_response(self, response_type: Any) -> tuple[int, Any]:
        """Take the response that is being executed: its sequence number and content."""
        return self._take_response(self._cancel, response_type)

    def take_result_response(self, response_type: Any) -> tuple[int, Any]:
        """Take the response that is being executed: its sequence number and content."""
        return self._take_response(self._result, response_type)

    def take_feedback(self, message_type: Any) -> Any:
        """Take the feedback that is being executed."""
        return self._feedback.take_message(message_type, False)[0]

    def take_status(self, message_type: Any) -> Any:
        """Take the status array that is being executed."""
        return self._status.take_message(message_type, False)[0]
