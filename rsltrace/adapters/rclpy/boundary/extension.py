"""The enums, exceptions, structures and constants of rclpy's C extension, for where it is not
loaded: nothing in a simulation needs its code."""

from __future__ import annotations

import builtins
from enum import Enum
from types import SimpleNamespace
from typing import Any

from rsltrace.simulation.middleware.qos.policies import INFINITE_NS, Durability, Reliability

NAME = "rclpy._rclpy_pybind11"

RCL_DEFAULT_DOMAIN_ID = 2**64 - 1
RMW_DURATION_INFINITE = INFINITE_NS
RMW_QOS_DEADLINE_BEST_AVAILABLE = INFINITE_NS - 1
RMW_QOS_LIVELINESS_LEASE_DURATION_BEST_AVAILABLE = INFINITE_NS - 1

# -- enums: those of C equal their numbers, those of C++ do not ------------------------------------


class _CppEnum(Enum):
    def __int__(self) -> int:
        return int(self.value)

    __index__ = __int__

    def __hash__(self) -> int:
        return hash(self.value)


class _CEnum(_CppEnum):
    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, int) and bool(self.value == other))

    __hash__ = _CppEnum.__hash__


class TransitionCallbackReturnType(_CppEnum):
    SUCCESS, FAILURE, ERROR = 97, 98, 99

    def to_label(self) -> str:
        return f"transition_{self.name.lower()}"


class SignalHandlerOptions(_CppEnum):
    NO, SIGINT, SIGTERM, ALL = range(4)


class ClockType(_CEnum):
    UNINITIALIZED, ROS_TIME, SYSTEM_TIME, STEADY_TIME = range(4)


class ClockChange(_CEnum):
    ROS_TIME_NO_CHANGE, ROS_TIME_ACTIVATED, ROS_TIME_DEACTIVATED, SYSTEM_TIME_NO_CHANGE = range(
        1, 5
    )


class GoalEvent(_CEnum):
    EXECUTE, CANCEL_GOAL, SUCCEED, ABORT, CANCELED = range(5)


class QoSCompatibility(_CEnum):
    OK, WARNING, ERROR = range(3)


class RCUTILS_LOG_SEVERITY(_CEnum):  # noqa: N801
    RCUTILS_LOG_SEVERITY_UNSET = 0
    RCUTILS_LOG_SEVERITY_DEBUG = 10
    RCUTILS_LOG_SEVERITY_INFO = 20
    RCUTILS_LOG_SEVERITY_WARN = 30
    RCUTILS_LOG_SEVERITY_ERROR = 40
    RCUTILS_LOG_SEVERITY_FATAL = 50


class rcl_publisher_event_type_t(_CEnum):  # noqa: N801
    RCL_PUBLISHER_OFFERED_DEADLINE_MISSED = 0
    RCL_PUBLISHER_LIVELINESS_LOST = 1
    RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS = 2
    RCL_PUBLISHER_INCOMPATIBLE_TYPE = 3
    RCL_PUBLISHER_MATCHED = 4


class rcl_subscription_event_type_t(_CEnum):  # noqa: N801
    RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED = 0
    RCL_SUBSCRIPTION_LIVELINESS_CHANGED = 1
    RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS = 2
    RCL_SUBSCRIPTION_MESSAGE_LOST = 3
    RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE = 4
    RCL_SUBSCRIPTION_MATCHED = 5


class rmw_qos_policy_kind_t(_CEnum):  # noqa: N801
    RMW_QOS_POLICY_INVALID = 1
    RMW_QOS_POLICY_DURABILITY = 2
    RMW_QOS_POLICY_DEADLINE = 4
    RMW_QOS_POLICY_LIVELINESS = 8
    RMW_QOS_POLICY_RELIABILITY = 16
    RMW_QOS_POLICY_HISTORY = 32
    RMW_QOS_POLICY_LIFESPAN = 64
    RMW_QOS_POLICY_DEPTH = 128
    RMW_QOS_POLICY_LIVELINESS_LEASE_DURATION = 256
    RMW_QOS_POLICY_AVOID_ROS_NAMESPACE_CONVENTIONS = 512


class ServiceIntrospectionState(_CEnum):
    OFF, METADATA, CONTENTS = range(3)


service_introspection = SimpleNamespace(ServiceIntrospectionState=ServiceIntrospectionState)

# -- exceptions ------------------------------------------------------------------------------------


class RCLError(RuntimeError): ...


class RMWError(RuntimeError): ...


class RCUtilsError(RuntimeError): ...


class InvalidHandle(RuntimeError): ...


class UnknownROSArgsError(RuntimeError): ...


class NotImplementedError(builtins.NotImplementedError): ...


class RCLInvalidROSArgsError(RCLError): ...


class NodeNameNonExistentError(RCLError): ...


class UnsupportedEventTypeError(RCLError): ...


class TimerCancelledError(RCLError): ...


# -- structures ------------------------------------------------------------------------------------


class rcl_duration_t:  # noqa: N801
    __slots__ = ("nanoseconds",)

    def __init__(self, nanoseconds: int) -> None:
        self.nanoseconds = nanoseconds


class rcl_time_point_t:  # noqa: N801
    __slots__ = ("clock_type", "nanoseconds")

    def __init__(self, nanoseconds: int, clock_type: int) -> None:
        self.nanoseconds = nanoseconds
        self.clock_type = _CLOCK_TYPES[int(clock_type)]


_CLOCK_TYPES = tuple(ClockType)


class rmw_incompatible_type_status_t:  # noqa: N801
    total_count_change = 0


class rmw_qos_profile_t:  # noqa: N801
    __slots__ = ("_values",)

    def __init__(
        self,
        history: int,
        depth: int,
        reliability: int,
        durability: int,
        lifespan: Any,
        deadline: Any,
        liveliness: int,
        liveliness_lease_duration: Any,
        avoid_ros_namespace_conventions: bool,
    ) -> None:
        self._values = {
            "depth": int(depth),
            "history": int(history),
            "reliability": int(reliability),
            "durability": int(durability),
            "lifespan": lifespan,
            "deadline": deadline,
            "liveliness": int(liveliness),
            "liveliness_lease_duration": liveliness_lease_duration,
            "avoid_ros_namespace_conventions": bool(avoid_ros_namespace_conventions),
        }

    def to_dict(self) -> dict[str, Any]:
        from rclpy.duration import Duration

        return {
            name: Duration(nanoseconds=value.nanoseconds)
            if isinstance(value, rcl_duration_t)
            else value
            for name, value in self._values.items()
        }

    @staticmethod
    def predefined(name: str) -> rmw_qos_profile_t:
        if name not in _PROFILES:
            raise ValueError(f"Requested unknown rmw_qos_profile: {name}")
        history, depth, reliability, durability, liveliness, limit_ns = _PROFILES[name]
        limit, lifespan = rcl_duration_t(limit_ns), rcl_duration_t(_LIFESPANS_NS.get(name, 0))
        return rmw_qos_profile_t(
            *(history, depth, reliability, durability, lifespan, limit, liveliness, limit), False
        )


_RELIABLE, _VOLATILE = Reliability.RELIABLE, Durability.VOLATILE
_PROFILES = {
    "qos_profile_default": (1, 10, _RELIABLE, _VOLATILE, 0, 0),
    "qos_profile_sensor_data": (1, 5, Reliability.BEST_EFFORT, _VOLATILE, 0, 0),
    "qos_profile_services_default": (1, 10, _RELIABLE, _VOLATILE, 0, 0),
    "qos_profile_parameters": (1, 1000, _RELIABLE, _VOLATILE, 0, 0),
    "qos_profile_parameter_events": (1, 1000, _RELIABLE, _VOLATILE, 0, 0),
    "qos_profile_rosout_default": (1, 1000, _RELIABLE, Durability.TRANSIENT_LOCAL, 0, 0),
    "qos_profile_system_default": (0, 0, 0, 0, 0, 0),
    "qos_profile_unknown": (3, 0, 3, 3, 4, 0),
    "qos_profile_best_available": (1, 10, 4, 4, 5, RMW_QOS_DEADLINE_BEST_AVAILABLE),
}
"""History, depth, reliability, durability, liveliness and limit of each profile of rmw."""
_LIFESPANS_NS = {"qos_profile_rosout_default": 10 * 10**9}

for _type in [each for each in globals().values() if isinstance(each, type)]:
    if _type.__module__ == __name__:
        _type.__module__ = NAME  # as errors and hashes of states have it
