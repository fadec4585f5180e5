"""Action clients."""

from __future__ import annotations

from functools import partialmethod
from typing import Any

from rsltrace.adapters.rclpy.actions.action_handle import (
    ActionHandle,
    ActionServiceClient,
    ActionSubscriptionHandle,
)
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
        self._goal = self.own(ActionServiceClient, impl.SendGoalService, "send_goal", goal_qos)
        self._cancel = self.own(
            ActionServiceClient, impl.CancelGoalService, "cancel_goal", cancel_qos
        )
        self._result = self.own(
            ActionServiceClient, impl.GetResultService, "get_result", result_qos
        )
        self._feedback = self.own(
            ActionSubscriptionHandle, impl.FeedbackMessage, "feedback", feedback_qos
        )
        self._status = self.own(
            ActionSubscriptionHandle, impl.GoalStatusMessage, "status", status_qos
        )

    def is_action_server_available(self) -> bool:
        """Return whether a server has all of its services and topics."""
        graph = self.node.usable_graph
        services = (self._goal, self._cancel, self._result)
        topics = (self._feedback, self._status)
        return all(graph.services(part.service) for part in services) and all(
            graph.publishers(part.topic) for part in topics
        )

    def is_ready(self, wait_set: Any) -> tuple[bool, bool, bool, bool, bool]:
        """Return whether feedback, status, and the goal, cancel and result responses are ready."""
        parts = (self._feedback, self._status, self._goal, self._cancel, self._result)
        feedback, status, goal, cancel, result = (
            self.is_part_ready(wait_set, part) for part in parts
        )
        return feedback, status, goal, cancel, result

    def _send_request(self, client: str, request: Any) -> int:
        """Send a request; return its sequence number."""
        return int(getattr(self, client).send_request(request))

    send_goal_request = partialmethod(_send_request, "_goal")
    send_cancel_request = partialmethod(_send_request, "_cancel")
    send_result_request = partialmethod(_send_request, "_result")

    def get_num_entities(self) -> tuple[int, int, int, int, int]:
        """Count its subscriptions, guard conditions, timers, clients and services, as rcl does."""
        return 2, 0, 0, 3, 0

    def _take_response(self, client: str, response_type: Any) -> tuple[int, Any]:
        """Take the response that is being executed: its sequence number and content."""
        info, response = getattr(self, client).take_response(response_type)
        return info.request_id.sequence_number, response

    take_goal_response = partialmethod(_take_response, "_goal")
    take_cancel_response = partialmethod(_take_response, "_cancel")
    take_result_response = partialmethod(_take_response, "_result")

    def take_feedback(self, message_type: Any) -> Any:
        return self._feedback.take_message(message_type, False)[0]

    def take_status(self, message_type: Any) -> Any:
        return self._status.take_message(message_type, False)[0]
