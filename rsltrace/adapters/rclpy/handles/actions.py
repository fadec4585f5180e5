"""Base classes of action servers and clients, and goals.

An action is three services and two topics under ``<name>/_action/``. Each is an entity, so the
trace shows every request, response, feedback and status. Arrivals go to rclpy's waitable one by
one, in the order of arrival.
"""

from __future__ import annotations

from functools import partialmethod
from struct import Struct
from typing import Any, TypeVar

from rsltrace.adapters.rclpy.concurrency.code_lines import FunctionRecorder
from rsltrace.adapters.rclpy.concurrency.mailbox import servers_text
from rsltrace.adapters.rclpy.concurrency.tasks import executor_of, set_executor, start_coroutine
from rsltrace.adapters.rclpy.handles.destroyable import Handle
from rsltrace.adapters.rclpy.handles.entity_handle import ReceiverHandle
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.handles.services import ClientHandle, ServiceHandle
from rsltrace.adapters.rclpy.messages.interfaces import type_name
from rsltrace.adapters.rclpy.messages.message_spec import HEADER
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.simulation.middleware.services import RequestId
from rsltrace.trace.model.event import NO_EVENT, EventKind

# Numbers of action_msgs/msg/GoalStatus. The state machine of a goal is rcl_action's (ROS 2 Jazzy).
ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 3, 4, 5, 6
_STATES = ("UNKNOWN", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED", "ABORTED")
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

_STATUS = Struct("<16s3xiIB")
"""Canonical CDR of action_msgs/msg/GoalStatus where padding precedes the stamp: anywhere in a
GoalStatusArray but at its begin."""


class GoalHandle(Handle):
    """Stands in for ``_rclpy.ActionGoalHandle``: the state machine of one accepted goal."""

    def __init__(self, real: Any, goals: dict[bytes, GoalHandle], info: Any) -> None:
        super().__init__()
        goal_id = bytes(info.goal_id.uuid)
        if goal_id in goals:
            raise real.RCLError("Failed to accept new goal: goal ID already exists")
        self._real = real
        self.info = info
        self.status = ACCEPTED
        self.accepted_ns = info.stamp.sec * 1_000_000_000 + info.stamp.nanosec
        self.done_ns: int | None = None
        self.status_cdr = _STATUS.pack(goal_id, info.stamp.sec, info.stamp.nanosec, ACCEPTED)
        """Its part of a status message, which lists every known goal."""
        goals[goal_id] = self

    def get_status(self) -> int:
        return self.status

    def is_active(self) -> bool:
        return self.status in (ACCEPTED, EXECUTING, CANCELING)

    def cancelable(self) -> bool:
        """Return whether a cancel request can stop the goal."""
        return (self.status, "CANCEL_GOAL") in _TRANSITIONS

    def update_goal_state(self, event: Any) -> None:
        """Apply an event to the state machine. Raises RCLError if it is not allowed."""
        state = _TRANSITIONS.get((self.status, event.name))
        if state is None:
            raise self._real.RCLError(
                "Failed to update goal state: goal_handle attempted invalid transition "
                f"from state {_STATES[self.status]} with event {event.name}"
            )
        self.status = state
        self.status_cdr = self.status_cdr[:-1] + state.to_bytes(1, "little")


ACTION = int(EventKind.ACTION)

PartT = TypeVar("PartT", bound="ActionEndpoint")


class ActionEndpoint(ReceiverHandle):
    """An endpoint of an action; its arrivals go to the action's waitable."""

    owner: ActionHandle
    in_waitable = True
    in_wait_sets: str
    """Its kind in a wait set: ``service``, ``client`` or ``subscription``."""
    purpose: str
    """``goal``, ``cancel``, ``result``, ``feedback`` or ``status``."""

    def find_wrapper(self) -> Any:
        """Return the action's waitable once its node is being run."""
        if self.wrapper is None:
            waitable = self.owner.find_waitable()
            if waitable is not None:
                self.begin(waitable, self.node)
        return self.wrapper

    def dispatch(self) -> None:
        """Let rclpy take the oldest arrival and execute it, as one event."""
        if not self.may_run():
            return
        origin = self.queue[0][self.origin]
        start_coroutine(self.runtime, self, ACTION, self.owner.execute, (self,), *origin)

    def trace_detail(self) -> dict[str, object]:
        return {"action": self.owner.name}

    def user_callback(self) -> object:
        """Return the server's callback for this kind of request."""
        own = getattr(self.wrapper, f"_{self.purpose}_callback", None)
        if getattr(own, "__module__", "").startswith("rclpy."):  # the default goal callback
            own = None
        return own or getattr(self.wrapper, "_execute_callback", None)


class ActionService(ActionEndpoint, ServiceHandle):
    """A server's end of one of the three services."""

    in_wait_sets = "service"


class ActionServiceClient(ActionEndpoint, ClientHandle):
    """A client's end of one of the three services."""

    in_wait_sets = "client"


class ActionSubscriptionHandle(ActionEndpoint, SubscriptionHandle):
    """A client's feedback or status subscription."""

    in_wait_sets = "subscription"


class ActionHandle(Handle):
    """Base class of action servers and clients: their endpoints (``parts``)."""

    waitable_attribute: str
    is_client: bool

    def __init__(self, node: NodeHandle, action_type: Any, name: str) -> None:
        super().__init__()
        self.runtime = node.runtime
        self._functions = FunctionRecorder(node.dispatcher)
        self.node = node
        try:
            self.name = node.resolve(name, service=False)
        except ValueError as error:
            what = "client" if self.is_client else "server"
            _, _, reason = str(error).partition(" is invalid: ")
            text = f"Failed to create action {what} due to invalid topic name '{name}' : {reason}"
            raise ValueError(text) from error
        self.parts: list[ActionEndpoint] = []
        self.publishers: list[PublisherHandle] = []
        self.action_type = action_type
        node.actions.append(self)
        self._ready: ActionEndpoint | None = None
        self._places: dict[ActionEndpoint, int] = {}

    @property
    def type_name(self) -> str:
        return type_name(self.action_type)

    def own(self, kind: type[PartT], interface: Any, name: str, qos: Any) -> PartT:
        """Make an endpoint below ``<name>/_action/``; its owner is set before its constructor."""
        part = kind.__new__(kind)
        part.owner = self
        part.purpose = name.partition("_goal")[0].replace("send", "goal")
        part.__init__(self.node, interface, self.path(name), qos)  # type: ignore[misc]
        self.parts.append(part)
        return part

    def add_to_waitset(self, wait_set: Any) -> None:
        for part in self.parts:
            self._places[part] = getattr(wait_set, f"add_{part.in_wait_sets}")(part)

    def is_part_ready(self, wait_set: Any, part: ActionEndpoint) -> bool:
        """Return whether an endpoint is being executed, or is ready in a wait set."""
        if wait_set is None:
            return part is self._ready
        return bool(wait_set.is_ready(part.in_wait_sets, self._places[part]))

    def path(self, name: str) -> str:
        return f"{self.name}/_action/{name}"

    def configure_introspection(self, clock: Any, qos: Any, state: Any) -> None:
        """Publish service events of its three services (ROS 2 Kilted and later)."""
        for part in self.parts:
            if isinstance(part, ActionService | ActionServiceClient):
                part.configure_introspection(clock, qos, state)

    def find_waitable(self) -> Any:
        """Return the rclpy object around this handle, or None if its node is not being run."""
        if self.node.wrapper is not None:
            for waitable in self.node.wrapper.waitables:
                if getattr(waitable, self.waitable_attribute, None) is self:
                    return waitable
        return None

    def waits_for(self, future: Any) -> str:
        """Describe what would complete a client's future; empty for other futures."""
        waitable = self.find_waitable()
        for what in ("goal", "result", "cancel"):
            pending = getattr(waitable, f"_pending_{what}_requests", {})
            if future in pending.values():
                graph = self.runtime.domain.graph
                servers = servers_text(len(graph.services(self.path("send_goal"))))
                answer = "the result of a goal" if what == "result" else f"the answer to a {what}"
                return f"{answer}, of action {self.name} ({servers})"
        return ""

    async def execute(self, part: ActionEndpoint) -> None:
        """Run the waitable as rclpy's executors do when ``part`` is ready."""
        waitable = part.wrapper
        self._ready = part
        try:
            waitable.is_ready(None)
            data = waitable.take_data()
        finally:
            self._ready = None
        if "feedback" in data:
            self._tell_feedback_callback(part, data["feedback"])
        set_executor(waitable, executor_of(self.runtime, part))
        await waitable.execute(data)

    def _tell_feedback_callback(self, part: ActionEndpoint, message: Any) -> None:
        callbacks = part.wrapper._feedback_callbacks
        callback = callbacks.get(bytes(message.goal_id.uuid))
        self._functions.run(part.entity_id, callback)

    def _destroy(self) -> None:
        self.node.actions.remove(self)
        for handle in [*self.parts, *self.publishers]:
            handle.destroy_when_not_in_use()


# Action clients.


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
        task = "Failed to check if action server is available"
        self._require_alive(task, "rcl node")
        graph = self.node.usable_graph(task)
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

    def _require_alive(self, task: str, whose: str) -> None:
        if self.destroyed:
            raise self.node.real.RCLError(f"{task}: {whose} pointer is invalid")

    def _send_request(self, client: str, request: Any) -> int:
        """Send a request; return its sequence number."""
        self._require_alive(f"Failed to send {client[1:]} request", "action client")
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


# Action servers: three services, two topics, and the accepted goals.
#
# The rules for cancel requests and the expiry of results are rcl_action's (ROS 2 Jazzy).

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
