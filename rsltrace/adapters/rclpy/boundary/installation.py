"""How the simulated middleware gets behind rclpy, and away again.

The reference ``_rclpy`` is exchanged in every loaded rclpy module and in
``rclpy.impl.implementation_singleton`` (for modules that load later), and afterwards put back.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.adapters.rclpy.actions.client import ActionClientHandle
from rsltrace.adapters.rclpy.actions.goal_handle import GoalHandle
from rsltrace.adapters.rclpy.actions.server import ActionServerHandle
from rsltrace.adapters.rclpy.boundary.boundary import Boundary
from rsltrace.adapters.rclpy.boundary.log_callers import quick_log_callers
from rsltrace.adapters.rclpy.boundary.quick_id_texts import quick_id_texts
from rsltrace.adapters.rclpy.boundary.quick_publish import quick_publish
from rsltrace.adapters.rclpy.boundary.release import check_release
from rsltrace.adapters.rclpy.boundary.type_support import load_type_support
from rsltrace.adapters.rclpy.handles.clock import ClockEventHandle, ClockHandle
from rsltrace.adapters.rclpy.handles.context import ContextHandle
from rsltrace.adapters.rclpy.handles.guard_condition import GuardConditionHandle
from rsltrace.adapters.rclpy.handles.lifecycle import StateMachineHandle
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.handles.qos_events import EventHandle
from rsltrace.adapters.rclpy.handles.services import (
    ClientHandle,
    ServiceHandle,
    TypeDescriptionServiceHandle,
)
from rsltrace.adapters.rclpy.handles.timers import TimerHandle
from rsltrace.adapters.rclpy.handles.wait_set import WaitSetHandle
from rsltrace.errors import SetupError, UnsupportedError

_HANDLES: dict[str, type] = {
    "ActionClient": ActionClientHandle,
    "ActionGoalHandle": GoalHandle,
    "ActionServer": ActionServerHandle,
    "Client": ClientHandle,
    "Clock": ClockHandle,
    "ClockEvent": ClockEventHandle,
    "Context": ContextHandle,
    "EventHandle": EventHandle,
    "GuardCondition": GuardConditionHandle,
    "LifecycleStateMachine": StateMachineHandle,
    "Node": NodeHandle,
    "Publisher": PublisherHandle,
    "Service": ServiceHandle,
    "Subscription": SubscriptionHandle,
    "Timer": TimerHandle,
    "TypeDescriptionService": TypeDescriptionServiceHandle,
    "WaitSet": WaitSetHandle,
}
"""The classes of the objects that the boundary makes, by their names in rclpy's extension."""

_installed: Boundary | None = None


def boundary() -> Boundary:
    """Return the boundary, loading rclpy's extension (but no rclpy module that binds it).

    :raises SetupError: if rclpy is not installed or cannot be loaded.
    """
    global _installed
    if _installed is None:
        try:
            from rclpy.impl import implementation_singleton as singleton
        except ImportError as error:
            raise SetupError(
                "rclpy is not installed for this Python: install the ROS wheels with "
                "`pip install 'rsltrace[ros]'`, or source a ROS 2 installation "
                f"({error})"
            ) from error
        load_type_support()
        real = singleton.rclpy_implementation
        ours = Boundary(real)
        check_release(real, ours, _HANDLES, Path(singleton.__file__).parents[1])
        _installed = ours
    return _installed


def check_free() -> None:
    """Raise UnsupportedError if a simulation is under way in this process: rclpy can be only one's.

    :raises SetupError: if rclpy is not installed or cannot be loaded.
    """
    if not boundary().is_free:
        raise UnsupportedError(
            "another simulation is running in this process: end it first (leave the block of the "
            "other Simulation), or use a process of its own"
        )


@contextmanager
def installed() -> Iterator[Boundary]:
    """Have rclpy use the simulated middleware within the ``with`` block."""
    ours = boundary()
    _exchange(ours.real, ours)
    try:
        with quick_log_callers(), quick_id_texts(), quick_publish():
            yield ours
    finally:
        _exchange(ours, ours.real)


def _exchange(old: Any, new: Any) -> None:
    for module in list(sys.modules.values()):
        names = getattr(module, "__dict__", None)
        if not isinstance(names, dict) or module is sys.modules[__name__]:
            continue
        for name in ("_rclpy", "rclpy_implementation"):
            if names.get(name) is old:
                names[name] = new
    logger = sys.modules.get("rclpy.impl.rcutils_logger")
    if logger is not None:
        # The default clock of throttled logging was made when the module was loaded.
        from rclpy.clock import Clock

        logger.Throttle.params["throttle_time_source_type"] = Clock()
