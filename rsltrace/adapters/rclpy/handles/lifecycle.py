"""The state machine behind rclpy's lifecycle nodes.

States, transitions and labels are those of rcl_lifecycle's default state machine. Services and the
transition event topic are ordinary entities of the node.
"""

from __future__ import annotations

from collections.abc import Callable
from traceback import walk_tb
from typing import Any

from rsltrace.adapters.rclpy.handles.destroyable import Handle
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle
from rsltrace.adapters.rclpy.handles.services import ServiceHandle
from rsltrace.guard.callers import is_user_file
from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.simulation.middleware.events.failure import as_printed, exception_text
from rsltrace.simulation.middleware.interface import imported_file
from rsltrace.trace.model.finding import SuppressedException
from rsltrace.trace.model.texts import shortened

_ERROR_MAX = 200

_STATES = {
    0: "unknown",
    1: "unconfigured",
    2: "inactive",
    3: "active",
    4: "finalized",
    10: "configuring",
    11: "cleaningup",
    12: "shuttingdown",
    13: "activating",
    14: "deactivating",
    15: "errorprocessing",
}
_TRANSITIONS = (
    (1, "configure", 1, 10),
    (10, "transition_success", 10, 2),
    (11, "transition_failure", 10, 1),
    (12, "transition_error", 10, 15),
    (2, "cleanup", 2, 11),
    (20, "transition_success", 11, 1),
    (21, "transition_failure", 11, 2),
    (22, "transition_error", 11, 15),
    (3, "activate", 2, 13),
    (30, "transition_success", 13, 3),
    (31, "transition_failure", 13, 2),
    (32, "transition_error", 13, 15),
    (4, "deactivate", 3, 14),
    (40, "transition_success", 14, 2),
    (41, "transition_failure", 14, 3),
    (42, "transition_error", 14, 15),
    (5, "shutdown", 1, 12),
    (6, "shutdown", 2, 12),
    (7, "shutdown", 3, 12),
    (50, "transition_success", 12, 4),
    (51, "transition_failure", 12, 4),
    (52, "transition_error", 12, 15),
    (60, "transition_success", 15, 1),
    (61, "transition_failure", 15, 4),
    (62, "transition_error", 15, 4),
)
"""(transition id, label, start state, goal state), in rcl_lifecycle's order."""

Description = tuple[int, str, int, str, int, str]


def transition_event(start: tuple[int, str], goal: tuple[int, str]) -> Any:
    """Return the message that rcl_lifecycle publishes for a change between two states."""
    from lifecycle_msgs.msg import State, TransitionEvent

    return TransitionEvent(
        start_state=State(id=start[0], label=start[1]),
        goal_state=State(id=goal[0], label=goal[1]),
    )


def _service_property(name: str) -> property:
    return property(lambda self: self._services.get(name))  # None without communication


class NotingCallback:
    """The callback of a transition. Its exceptions are noted: rclpy suppresses them."""

    def __init__(self, node: NodeHandle, callback: Callable[[Any], Any]) -> None:
        self._node = node
        self._callback = callback

    def __call__(self, state: Any) -> Any:
        try:
            return self._callback(state)
        except Exception as error:
            self._note(error)
            raise

    def _note(self, error: Exception) -> None:
        runtime, name = self._node.runtime, callback_name(self._callback)
        text = as_printed(type(error).__qualname__, exception_text(error))
        text = shortened(text, _ERROR_MAX)
        node, place = self._node.fully_qualified_name, _user_line(error)
        found = SuppressedException(runtime.loop.events, node, name, text, place)
        outcome = runtime.domain.outcome
        outcome.suppressed.append(found)
        outcome.notes.append(f"rclpy suppressed an exception: {name} of {node}: {text} at {place}")


def _user_line(error: Exception) -> str:
    """Return the innermost line of user code that an exception went through."""
    frames = [(frame, line) for frame, line in walk_tb(error.__traceback__)]
    of_user = [one for one in frames if is_user_file(one[0].f_code.co_filename)]
    frame, line = (of_user or frames)[-1]
    return f"{imported_file(frame.f_code, frame.f_globals)}:{line}"


class StateMachineHandle(Handle):
    """Stands in for ``_rclpy.LifecycleStateMachine``."""

    def __init__(self, node: NodeHandle, communicate: bool) -> None:
        if not isinstance(communicate, bool):
            raise TypeError(f"enable_communication_interface must be a bool, not {communicate!r}")
        super().__init__()
        self._real = node.real
        self._node = node
        self._state = 1
        self._events: PublisherHandle | None = None
        self._services: dict[str, ServiceHandle] = {}
        if communicate:
            self._open(node)

    def _open(self, node: NodeHandle) -> None:
        from lifecycle_msgs.msg import TransitionEvent
        from lifecycle_msgs.srv import (
            ChangeState,
            GetAvailableStates,
            GetAvailableTransitions,
            GetState,
        )

        predefined = self._real.rmw_qos_profile_t.predefined
        self._events = PublisherHandle(
            node, TransitionEvent, "~/transition_event", predefined("qos_profile_default")
        )
        profile = predefined("qos_profile_services_default")
        for name, kind in (
            ("change_state", ChangeState),
            ("get_state", GetState),
            ("get_available_states", GetAvailableStates),
            ("get_available_transitions", GetAvailableTransitions),
            ("get_transition_graph", GetAvailableTransitions),
        ):
            self._services[name] = ServiceHandle(node, kind, f"~/{name}", profile)

    # -- states ------------------------------------------------------------------------------------

    @property
    def initialized(self) -> bool:
        return True

    @property
    def current_state(self) -> tuple[int, str]:
        return self._state, _STATES[self._state]

    @property
    def available_states(self) -> list[tuple[int, str]]:
        return list(_STATES.items())

    @property
    def available_transitions(self) -> list[Description]:
        return [t for t in self.transition_graph if t[2] == self._state]

    @property
    def transition_graph(self) -> list[Description]:
        return [
            (number, label, start, _STATES[start], goal, _STATES[goal])
            for number, label, start, goal in _TRANSITIONS
        ]

    def get_transition_by_label(self, label: str) -> int:
        for number, name, start, _ in _TRANSITIONS:
            if start == self._state and name == label:
                return number
        raise self._real.RCLError(f"Failed to get transition from label: {label}")

    def trigger_transition_by_id(self, transition: int, publish_update: bool) -> None:
        for number, _, start, goal in _TRANSITIONS:
            if number == transition and start == self._state:
                self._go(start, goal, publish_update)
                return
        raise self._real.RCLError(
            "Failed to trigger lifecycle state machine transition: Transition is not registered: "
            f"no transition matching {transition} found for current state {_STATES[self._state]}"
        )

    def trigger_transition_by_label(self, label: str, publish_update: bool) -> None:
        self.trigger_transition_by_id(self.get_transition_by_label(label), publish_update)

    def _go(self, start: int, goal: int, publish_update: bool) -> None:
        self._state = goal
        self._note_exceptions()
        if publish_update and self._events is not None:
            self._events.publish(transition_event((start, _STATES[start]), (goal, _STATES[goal])))

    def _note_exceptions(self) -> None:
        """Let the exceptions of the callback that rclpy calls now be noted."""
        callbacks = getattr(self._node.made, "_callbacks", {})  # of ``LifecycleNodeMixin``
        callback = callbacks.get(self._state)
        if callback is not None and not isinstance(callback, NotingCallback):
            callbacks[self._state] = NotingCallback(self._node, callback)

    # -- services ----------------------------------------------------------------------------------

    service_change_state = _service_property("change_state")
    service_get_state = _service_property("get_state")
    service_get_available_states = _service_property("get_available_states")
    service_get_available_transitions = _service_property("get_available_transitions")
    service_get_transition_graph = _service_property("get_transition_graph")

    def _destroy(self) -> None:
        for handle in [*self._services.values(), self._events]:
            if handle is not None and not handle.destroyed:
                handle.destroy_when_not_in_use()
