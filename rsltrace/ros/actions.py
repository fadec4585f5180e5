"""Actions, through rclpy's own Python layer: servers, clients and goals on simulated time.

An action is three services and two topics under ``<name>/_action/``; each is an entity of its own
here, so that the trace shows every request, response, feedback and status as it is. What arrives
for any of them goes to rclpy's waitable, one at a time and in the order of arrival.

Rules are those of rcl_action (ROS 2 Jazzy): the state machine of goals, which goals a cancel
request means, and when results expire.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rsltrace.model.event import NO_EVENT, EventKind
from rsltrace.ros.destroyable import Destroyable
from rsltrace.ros.entity_handle import Receiver
from rsltrace.ros.groups import begin
from rsltrace.ros.mailbox import executor_of
from rsltrace.ros.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.ros.services import ClientHandle, RequestId, ServiceHandle
from rsltrace.ros.tasks import start_coroutine

if TYPE_CHECKING:
    from rsltrace.ros.boundary import Boundary
    from rsltrace.ros.core import Core
    from rsltrace.ros.node import NodeHandle

_ACTION = int(EventKind.ACTION)

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
# Return codes of action_msgs/srv/CancelGoal.
_ERROR_NONE, _ERROR_UNKNOWN_GOAL_ID, _ERROR_GOAL_TERMINATED = 0, 2, 3


class _Part(Receiver):
    """One of an action's endpoints: its arrivals are handed to the action's waitable."""

    owner: _ActionHandle

    def find_wrapper(self) -> Any:
        """Return the action's waitable once its node is being run."""
        if self.wrapper is None:
            self.wrapper = self.owner.find_waitable()
            if self.wrapper is not None:
                self.activate()
        return self.wrapper

    def dispatch(self) -> None:
        """Let rclpy take the oldest arrival and execute it, as one event."""
        if not self.may_run():
            return
        _, event, position, digest, *_ = self.queue[0]
        begin(self.wrapper.callback_group, self.wrapper)
        start_coroutine(
            self.core, self, _ACTION, self.owner.execute, (self,), event, position, digest
        )

    def trace_detail(self) -> dict[str, object]:
        return {"action": self.owner.name}


class _GoalService(_Part, ServiceHandle):
    """A server's end of one of the three services."""


class _GoalClient(_Part, ClientHandle):
    """A client's end of one of the three services."""


class _GoalSubscription(_Part, SubscriptionHandle):
    """A client's feedback or status subscription."""


class _ActionHandle(Destroyable):
    """What servers and clients have in common: their parts, and the one that is ready."""

    waitable_attribute: str

    def __init__(self, core: Core, node: NodeHandle, action_type: Any, name: str) -> None:
        super().__init__()
        self.core = core
        self.node = node
        self.name = node.resolve(name, service=False)
        self.parts: list[_Part] = []
        self.publishers: list[PublisherHandle] = []
        self.action_type = action_type
        node.actions.append(self)
        self._ready: _Part | None = None

    def _own(self, part: Any) -> Any:
        self.parts.append(part)
        return part

    def configure_introspection(self, clock: Any, qos: Any, state: Any) -> None:
        """Publish service events of its three services (ROS 2 Kilted and later)."""
        for part in self.parts:
            if isinstance(part, _GoalService | _GoalClient):
                part.configure_introspection(clock, qos, state)

    def find_waitable(self) -> Any:
        """Return the rclpy object around this handle, or None if its node is not being run."""
        if self.node.wrapper is not None:
            for waitable in self.node.wrapper.waitables:
                if getattr(waitable, self.waitable_attribute, None) is self:
                    return waitable
        return None

    def waits_for(self, future: Any) -> str:
        """Say what would complete a future, if it is a client's own."""
        waitable = self.find_waitable()
        for what in ("goal", "result", "cancel"):
            pending = getattr(waitable, f"_pending_{what}_requests", {})
            if future in pending.values():
                servers = len(self.core.graph.services(f"{self.name}/_action/send_goal"))
                answer = "the result of a goal" if what == "result" else f"the answer to a {what}"
                return f"{answer}, of action {self.name} ({servers} servers)"
        return ""

    async def execute(self, part: _Part) -> None:
        """Do what rclpy's executors do for a waitable of which ``part`` is ready."""
        waitable = part.wrapper
        self._ready = part
        waitable.is_ready(None)
        data = waitable.take_data()
        self._ready = None
        for future in waitable._futures:
            future._set_executor(executor_of(self.core, part))
        await waitable.execute(data)

    def _destroy(self) -> None:
        self.node.actions.remove(self)
        for handle in [*self.parts, *self.publishers]:
            if not handle._destroyed:
                handle.destroy_when_not_in_use()


class ActionServerHandle(_ActionHandle):
    """Stands in for ``_rclpy.ActionServer``. ``result_timeout`` is in seconds, negative: none."""

    waitable_attribute = "_handle"

    def __init__(
        self,
        boundary: Boundary,
        core: Core,
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
        super().__init__(core, node, action_type, name)
        self.boundary = boundary
        self.goals: dict[bytes, GoalHandle] = {}
        self._timeout_ns = int(result_timeout * 1_000_000_000) if result_timeout >= 0 else None
        self._expired = False
        impl = action_type.Impl
        base = f"{self.name}/_action"
        self._goal = self._own(_service(self, impl.SendGoalService, f"{base}/send_goal", goal_qos))
        self._cancel = self._own(
            _service(self, impl.CancelGoalService, f"{base}/cancel_goal", cancel_qos)
        )
        self._result = self._own(
            _service(self, impl.GetResultService, f"{base}/get_result", result_qos)
        )
        self._feedback = PublisherHandle(
            core, node, impl.FeedbackMessage, f"{base}/feedback", feedback_qos
        )
        self._status = PublisherHandle(
            core, node, impl.GoalStatusMessage, f"{base}/status", status_qos
        )
        self._status_type = impl.GoalStatusMessage
        self.publishers = [self._feedback, self._status]
        self._expiry = _Expiry(self)

    # -- requests and responses ----------------------------------------------------------------

    def is_ready(self, wait_set: Any) -> tuple[bool, bool, bool, bool]:
        """Say which of goal, cancel, result request and expiry is being executed."""
        ready = self._ready
        return (
            ready is self._goal,
            ready is self._cancel,
            ready is self._result,
            self._expired,
        )

    def get_num_entities(self) -> tuple[int, int, int, int, int]:
        """Count its subscriptions, guard conditions, timers, clients and services, as rcl does."""
        return 0, 0, 1, 0, 3

    def _take_request(self, part: Any, request_type: Any) -> tuple[RequestId, Any]:
        request, info = part.service_take_request(request_type)
        return info.request_id, request

    def take_goal_request(self, request_type: Any) -> tuple[RequestId, Any]:
        """Take the goal request that is being executed."""
        return self._take_request(self._goal, request_type)

    def take_cancel_request(self, request_type: Any) -> tuple[RequestId, Any]:
        """Take the cancel request that is being executed."""
        return self._take_request(self._cancel, request_type)

    def take_result_request(self, request_type: Any) -> tuple[RequestId, Any]:
        """Take the result request that is being executed."""
        return self._take_request(self._result, request_type)

    def send_goal_response(self, header: RequestId, response: Any) -> None:
        """Answer a goal request."""
        self._goal.service_send_response(response, header)

    def send_cancel_response(self, header: RequestId, response: Any) -> None:
        """Answer a cancel request."""
        self._cancel.service_send_response(response, header)

    def send_result_response(self, header: RequestId, response: Any) -> None:
        """Answer a result request."""
        self._result.service_send_response(response, header)

    def publish_feedback(self, message: Any) -> None:
        """Publish feedback on a goal."""
        self._feedback.publish(message)

    def publish_status(self) -> None:
        """Publish the status of every goal that is known."""
        from action_msgs.msg import GoalStatus

        goals = self.goals.values()
        statuses = [GoalStatus(goal_info=goal.info, status=goal.status) for goal in goals]
        self._status.publish(self._status_type(status_list=statuses))

    # -- goals -----------------------------------------------------------------------------------

    def goal_exists(self, goal_info: Any) -> bool:
        """Return whether a goal of this id is known."""
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
        """Let the results of finished goals expire after the timeout."""
        now_ns = self.core.loop.now_ns
        for goal in self.goals.values():
            if not goal.is_active() and goal.done_ns is None:
                goal.done_ns = now_ns
                if self._timeout_ns is not None:
                    self.core.loop.schedule(now_ns + self._timeout_ns, self._expiry.wake)

    def expire_goals(self, most: int) -> tuple[Any, ...]:
        """Forget goals whose results have been kept long enough; return their infos."""
        timeout_ns = self._timeout_ns
        if timeout_ns is None:
            return ()
        oldest_ns = self.core.loop.now_ns - timeout_ns
        gone = [
            goal_id
            for goal_id, goal in self.goals.items()
            if goal.done_ns is not None and goal.done_ns <= oldest_ns
        ]
        return tuple(self.goals.pop(goal_id).info for goal_id in gone[:most])

    async def expire(self) -> None:
        """Do what rclpy's executors do for a waitable whose goals expire."""
        waitable = self._expiry.wrapper
        self._expired = True
        waitable.is_ready(None)
        data = waitable.take_data()
        self._expired = False
        await waitable.execute(data)


class _Expiry:
    """Dispatches a server's expiry of goals; belongs to its goal service in the trace."""

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
        """Expire goals now."""
        if not self._server._destroyed:
            self._server.core.loop.ready.append(self)

    def dispatch(self) -> None:
        """Expire goals, as one event."""
        server = self._server
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return
        self.wrapper = server.find_waitable()
        if self.wrapper is None:
            return
        begin(self.wrapper.callback_group, self.wrapper)
        handle: Any = self  # has what start_coroutine needs, but no place in the trace of its own
        start_coroutine(server.core, handle, _ACTION, server.expire, (), NO_EVENT, 0, 0)

    def describe(self) -> str:
        return f"{self.node.fully_qualified_name}: expiry of goals of {self._server.name}"


class GoalHandle(Destroyable):
    """Stands in for ``_rclpy.ActionGoalHandle``: the state machine of one accepted goal."""

    def __init__(self, server: ActionServerHandle, info: Any) -> None:
        super().__init__()
        goal_id = bytes(info.goal_id.uuid)
        if goal_id in server.goals:
            raise server.boundary.real.RCLError("goal ID already exists")
        self.server = server
        self.info = info
        self.status = ACCEPTED
        self.accepted_ns = info.stamp.sec * 1_000_000_000 + info.stamp.nanosec
        self.done_ns: int | None = None
        server.goals[goal_id] = self

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
            raise self.server.boundary.real.RCLError(
                f"goal_handle attempted invalid transition from state {self.status} "
                f"with event {event.name}"
            )
        self.status = state


class ActionClientHandle(_ActionHandle):
    """Stands in for ``_rclpy.ActionClient``."""

    waitable_attribute = "_client_handle"

    def __init__(
        self,
        core: Core,
        node: NodeHandle,
        action_type: Any,
        name: str,
        goal_qos: Any,
        result_qos: Any,
        cancel_qos: Any,
        feedback_qos: Any,
        status_qos: Any,
    ) -> None:
        super().__init__(core, node, action_type, name)
        impl = action_type.Impl
        base = f"{self.name}/_action"
        self._goal = self._own(_client(self, impl.SendGoalService, f"{base}/send_goal", goal_qos))
        self._cancel = self._own(
            _client(self, impl.CancelGoalService, f"{base}/cancel_goal", cancel_qos)
        )
        self._result = self._own(
            _client(self, impl.GetResultService, f"{base}/get_result", result_qos)
        )
        self._feedback = self._own(
            _subscription(self, impl.FeedbackMessage, f"{base}/feedback", feedback_qos)
        )
        self._status = self._own(
            _subscription(self, impl.GoalStatusMessage, f"{base}/status", status_qos)
        )

    def is_action_server_available(self) -> bool:
        """Return whether a server has all of its services and topics."""
        graph = self.core.graph
        services = (self._goal, self._cancel, self._result)
        topics = (self._feedback, self._status)
        return all(graph.services(part.service) for part in services) and all(
            graph.publishers(part.topic) for part in topics
        )

    def is_ready(self, wait_set: Any) -> tuple[bool, bool, bool, bool, bool]:
        """Say which of feedback, status and the three responses is being executed."""
        ready = self._ready
        return (
            ready is self._feedback,
            ready is self._status,
            ready is self._goal,
            ready is self._cancel,
            ready is self._result,
        )

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

    def _take_response(self, part: Any, response_type: Any) -> tuple[int, Any]:
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


def _part(kind: Any, owner: _ActionHandle, *arguments: Any) -> Any:
    """Make a part; it needs its owner before its constructor runs."""
    part = kind.__new__(kind)
    part.owner = owner
    part.__init__(owner.core, owner.node, *arguments)
    return part


def _service(owner: _ActionHandle, *arguments: Any) -> Any:
    return _part(_GoalService, owner, *arguments)


def _client(owner: _ActionHandle, *arguments: Any) -> Any:
    return _part(_GoalClient, owner, *arguments)


def _subscription(owner: _ActionHandle, *arguments: Any) -> Any:
    return _part(_GoalSubscription, owner, *arguments)
