"""The object that replaces rclpy's C extension during a run (``installation`` puts it there).

Its enums, exceptions and structures are those of the extension if that is loaded, so that they are
what other code in the process has, and else those in ``extension``.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rsltrace.adapters.rclpy.arguments import (
    LEVELS,
    InvalidArgumentsError,
    LogLevels,
    RosArguments,
    UnknownArgumentsError,
)
from rsltrace.adapters.rclpy.boundary import extension
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.handles.actions import (
    ActionClientHandle,
    ActionServerHandle,
    GoalHandle,
)
from rsltrace.adapters.rclpy.handles.clock import ClockEventHandle, ClockHandle
from rsltrace.adapters.rclpy.handles.context import ContextHandle
from rsltrace.adapters.rclpy.handles.destroyable import Destroyable, set_invalid_handle
from rsltrace.adapters.rclpy.handles.lifecycle import StateMachineHandle
from rsltrace.adapters.rclpy.handles.logs import RosoutLogs
from rsltrace.adapters.rclpy.handles.node import NodeHandle, topic_types
from rsltrace.adapters.rclpy.handles.node_state import NodeStates
from rsltrace.adapters.rclpy.handles.pubsub import EventHandle, PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.handles.qos_profiles import QosResult, compatibility, profile_of
from rsltrace.adapters.rclpy.handles.services import (
    ClientHandle,
    ServiceHandle,
    TypeDescriptionServiceHandle,
)
from rsltrace.adapters.rclpy.handles.timers import GuardConditionHandle, RosTimerHandle, TimerHandle
from rsltrace.adapters.rclpy.handles.wait_set import WaitSetHandle
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.names import (
    expand,
    full_topic_fault,
    namespace_fault,
    node_name_fault,
    topic_fault,
)
from rsltrace.adapters.rclpy.node_clocks import NodeClocks
from rsltrace.errors import UnsupportedError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.graph import names_and_types
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos.policies import Durability, History
from rsltrace.simulation.middleware.qos.timing import (
    CountStatus,
    IncompatibleQosStatus,
    LivelinessChangedStatus,
    MatchedStatus,
)
from rsltrace.simulation.middleware.services import RequestId, ServiceEndpoint, ServiceInfo
from rsltrace.simulation.middleware.subscription import Subscription

# Mains whose module calls ``rclpy.init()`` at import.
#
# The modules of mains are imported before the run, so that errors in a job name its line. They
# have no simulated process then, and so no context to initialize: such a module is imported again
# by its program.


class NeedsItsProcess(BaseException):
    """A module uses rclpy's contexts at import. No ``Exception``, so that user code does not catch
    it."""


_without_process = False


@contextmanager
def before_its_process() -> Iterator[None]:
    """Import the module of a main before its program begins.

    :raises NeedsItsProcess: if the module initializes a context, or uses the default one.
    """
    global _without_process
    import rclpy.utilities

    values = vars(rclpy.utilities)
    context, values["g_default_context"] = values["g_default_context"], None
    _without_process = True
    try:
        yield
        has_asked = values["g_default_context"] is not None
    finally:
        _without_process = False
        values["g_default_context"] = context
    if has_asked:
        raise NeedsItsProcess


def check_process() -> None:
    """Raise ``NeedsItsProcess`` if there is no simulated process to initialize yet."""
    if _without_process:
        raise NeedsItsProcess


_TYPES = (
    # enums and structures
    "ClockChange ClockType GoalEvent QoSCompatibility "
    "RCUTILS_LOG_SEVERITY SignalHandlerOptions TransitionCallbackReturnType rcl_duration_t "
    "rcl_publisher_event_type_t rcl_subscription_event_type_t rcl_time_point_t "
    "rmw_incompatible_type_status_t rmw_qos_policy_kind_t rmw_qos_profile_t service_introspection "
    "RCL_DEFAULT_DOMAIN_ID RMW_DURATION_INFINITE RMW_QOS_DEADLINE_BEST_AVAILABLE "
    "RMW_QOS_LIVELINESS_LEASE_DURATION_BEST_AVAILABLE "
    # exceptions
    "InvalidHandle NodeNameNonExistentError NotImplementedError RCLError RCLInvalidROSArgsError "
    "RCUtilsError RMWError UnknownROSArgsError UnsupportedEventTypeError TimerCancelledError"
).split()


@dataclass(slots=True)
class BoundaryContext:
    """What the boundary needs from a world; ``clocks`` is None if all show simulated time."""

    runtime: Runtime
    logs: RosoutLogs
    states: NodeStates
    clocks: NodeClocks | None = None


class RclpyBoundary:
    """Stands in for the module ``rclpy._rclpy_pybind11``."""

    RCLError: type[Exception]
    RCLInvalidROSArgsError: type[Exception]
    RMWError: type[Exception]
    UnknownROSArgsError: type[Exception]
    QoSCompatibility: Any
    InvalidHandle: type[Exception]
    SignalHandlerOptions: Any
    rmw_qos_policy_kind_t: Any
    rmw_qos_profile_t: Any

    def __init__(self, real: Any | None) -> None:
        self.real = real
        """rclpy's C extension; None if it is not loaded."""
        self._world: BoundaryContext | None = None
        self._last_now_ns = 0
        self._levels = LogLevels()
        self.ros_clocks: list[weakref.ref[ClockHandle]] = []
        for name in _TYPES:
            if hasattr(real or extension, name):
                setattr(self, name, getattr(real or extension, name))
        set_invalid_handle(self.InvalidHandle)
        self.Destroyable = Destroyable
        self.Clock = type("Clock", (ClockHandle,), {"boundary": self})
        self.ClockEvent = type("ClockEvent", (ClockEventHandle,), {"boundary": self})
        self.rmw_request_id_t = RequestId
        self.rmw_service_info_t = ServiceInfo
        self.rmw_matched_status_t = MatchedStatus
        self.rmw_requested_qos_incompatible_event_status_t = IncompatibleQosStatus
        self.rmw_liveliness_changed_status_t = LivelinessChangedStatus
        for name in ("liveliness_lost", "message_lost", "offered_deadline_missed"):
            setattr(self, f"rmw_{name}_status_t", CountStatus)
        self.rmw_requested_deadline_missed_status_t = CountStatus

    # -- the current world -----------------------------------------------------------------------

    @property
    def world(self) -> BoundaryContext:
        """The world that new entities join. Raises UnsupportedError between runs."""
        if self._world is None:
            raise UnsupportedError("no simulation is running in this process")
        return self._world

    @property
    def runtime(self) -> Runtime:
        return self.world.runtime

    @property
    def is_free(self) -> bool:
        """Whether no simulation is running in this process."""
        return self._world is None

    def now_ns(self) -> int:
        """Return simulated time, or the last one between runs."""
        return self._last_now_ns if self._world is None else self._world.runtime.loop.now_ns

    def shown_ns(self, owner: str | None) -> int:
        """Return what the clock of a node shows (None: of the node that runs)."""
        world = self._world
        if world is None or world.clocks is None:
            return self.now_ns()
        return world.clocks.shows(owner or self.current_node_name(), world.runtime.loop.now_ns)

    def follows(self, owner: str | None) -> bool:
        """Return whether /clock drives the ROS time of a node."""
        world = self._world
        return world is not None and world.clocks is not None and world.clocks.follows(owner)

    def note_ignored_time(self) -> None:
        """Note that nobody follows the /clock of a node, if the job does not say who does. (If bags
        play, their times are the run's own.)"""
        world = self._world
        if world is None or world.clocks is not None or self.runtime.programs.fed:
            return
        notes, graph = self.runtime.domain.outcome.notes, self.runtime.domain.graph
        if graph.publishers("/clock") and _IGNORED_TIME not in notes:
            notes.append(_IGNORED_TIME)

    def look_ns(self, owner: str | None) -> int:
        """Return what a node's ROS clock shows to user code; reading may advance it."""
        world = self._world
        if world is None or world.clocks is None:
            return self.now_ns()
        return world.clocks.look(owner or self.current_node_name(), world.runtime.loop.now_ns)

    def current_node_name(self) -> str | None:
        """Return the name of the node whose callback or constructor runs."""
        node = self._world.runtime.event.node if self._world is not None else None
        return None if node is None else str(node.fully_qualified_name)

    def enter(self, world: BoundaryContext) -> None:
        if self._world is not None:
            raise UnsupportedError("another simulation is running in this process")
        self._world = world

    def leave(self) -> None:
        self._last_now_ns = self.now_ns()
        self._world = None

    def jump_clocks(self, delta_ns: int) -> None:
        """Run the jump callbacks of ROS clocks."""
        for reference in list(self.ros_clocks):
            clock = reference()
            if clock is None:
                self.ros_clocks.remove(reference)
            else:
                clock.jumped(delta_ns)

    # -- entities --------------------------------------------------------------------------------

    def Context(self, arguments: list[str], domain_id: int) -> ContextHandle:  # noqa: N802
        check_process()
        with self._argument_errors("failed to initialize rcl: ", self.RCLError):
            context = ContextHandle(self, self.runtime, arguments, domain_id)
        programs = self.runtime.programs
        if programs.main_context is None:
            programs.main_context = context
        context.note_domains()
        return context

    def Node(  # noqa: N802
        self,
        name: str,
        namespace: str,
        context: ContextHandle,
        cli_args: list[str] | None,
        use_global: bool,
        rosout: bool,
        rosout_qos: Any = None,  # from ROS 2 Kilted on
    ) -> NodeHandle:
        world = self.world
        return NodeHandle(
            self,
            world.runtime,
            world.logs,
            world.states,
            name,
            namespace,
            context,
            cli_args,
            use_global,
            rosout,
            rosout_qos,
        )

    def Publisher(self, node: NodeHandle, *arguments: Any) -> PublisherHandle:  # noqa: N802
        node.require_up("Failed to create publisher")
        return PublisherHandle(node, *arguments)

    def Subscription(self, node: NodeHandle, *arguments: Any) -> SubscriptionHandle:  # noqa: N802
        node.require_up("Failed to create subscription")
        return SubscriptionHandle(node, *arguments)

    def Client(self, node: NodeHandle, *arguments: Any) -> ClientHandle:  # noqa: N802
        node.require_up("failed to create client")
        return ClientHandle(node, *arguments)

    def Service(self, node: NodeHandle, *arguments: Any) -> ServiceHandle:  # noqa: N802
        node.require_up("failed to create service")
        return ServiceHandle(node, *arguments)

    def TypeDescriptionService(self, node: NodeHandle) -> TypeDescriptionServiceHandle:  # noqa: N802
        return TypeDescriptionServiceHandle(node)

    def Timer(  # noqa: N802
        self, clock: Any, context: ContextHandle, period_ns: int, autostart: bool = True
    ) -> TimerHandle:
        context.require("failed to create timer")
        if clock.follows:
            return RosTimerHandle(self, context.runtime, clock, period_ns, autostart)
        return TimerHandle(self, context.runtime, period_ns, autostart)

    def GuardCondition(self, context: ContextHandle) -> GuardConditionHandle:  # noqa: N802
        context.require("failed to create guard_condition")
        return GuardConditionHandle(context.runtime)

    def EventHandle(self, parent: Any, event_type: Any) -> EventHandle:  # noqa: N802
        return EventHandle(parent, event_type, self.rmw_qos_policy_kind_t)

    QoSEvent = EventHandle  # its name up to Humble

    def ActionServer(self, node: NodeHandle, *arguments: Any) -> ActionServerHandle:  # noqa: N802
        node.require_up("failed to create action server")
        return ActionServerHandle(node, *arguments)

    def ActionGoalHandle(self, server: ActionServerHandle, info: Any) -> GoalHandle:  # noqa: N802
        return GoalHandle(self, server.goals, info)

    def ActionClient(self, node: NodeHandle, *arguments: Any) -> ActionClientHandle:  # noqa: N802
        node.require_up("failed to create action client")
        return ActionClientHandle(node, *arguments)

    def LifecycleStateMachine(  # noqa: N802
        self, node: NodeHandle, communicate: bool
    ) -> StateMachineHandle:
        return StateMachineHandle(node, communicate)

    def WaitSet(self, *arguments: Any) -> Any:  # noqa: N802
        return WaitSetHandle(*arguments)

    def EventsExecutor(self, context: Any) -> Any:  # noqa: N802
        """Return an ordinary executor: in a run, all of them run on events."""
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)

    # -- names and graph -------------------------------------------------------------------------

    def rclpy_resolve_name(
        self, node: NodeHandle, name: str, only_expand: bool, is_service: bool
    ) -> str:
        try:
            return node.resolve(name, service=is_service, only_expand=only_expand)
        except ValueError as error:
            reason = str(error).partition(" is invalid: ")[2] or str(error)
            raise self.RCLError(f"failed to resolve name: {reason}") from error

    def rclpy_remap_topic_name(self, node: NodeHandle, topic: str) -> str:
        return node.resolve(topic, service=False)

    def rclpy_get_publisher_names_and_types_by_node(
        self, node: NodeHandle, no_demangle: bool, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "failed to get publisher names and types"
        return topic_types(node.ends_of("publishers", task, name, namespace))

    def rclpy_get_subscriber_names_and_types_by_node(
        self, node: NodeHandle, no_demangle: bool, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "failed to get subscriber names and types"
        return topic_types(node.ends_of("subscriptions", task, name, namespace))

    def rclpy_get_service_names_and_types_by_node(
        self, node: NodeHandle, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "failed to get service names and types"
        return _service_types(node.ends_of("services", task, name, namespace))

    def rclpy_get_client_names_and_types_by_node(
        self, node: NodeHandle, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "failed to get client names and types"
        return _service_types(node.ends_of("clients", task, name, namespace))

    def rclpy_get_topic_names_and_types(
        self, node: NodeHandle, no_demangle: bool
    ) -> list[tuple[str, list[str]]]:
        return node.usable_graph("failed to get topic names and types").topic_names_and_types()

    def rclpy_get_service_names_and_types(self, node: NodeHandle) -> list[tuple[str, list[str]]]:
        task = "failed to get service names and types"
        return node.usable_graph(task).service_names_and_types()

    def rclpy_get_publishers_info_by_topic(
        self, node: NodeHandle, topic: str, no_mangle: bool
    ) -> list[dict[str, Any]]:
        graph = node.usable_graph("Failed to get information by topic for publishers")
        return [_endpoint_info(p, _PUBLISHER) for p in graph.publishers(topic)]

    def rclpy_get_subscriptions_info_by_topic(
        self, node: NodeHandle, topic: str, no_mangle: bool
    ) -> list[dict[str, Any]]:
        graph = node.usable_graph("Failed to get information by topic for subscriptions")
        return [_endpoint_info(s, _SUBSCRIPTION) for s in graph.subscriptions(topic)]

    rclpy_expand_topic_name = staticmethod(expand)
    rclpy_get_validation_error_for_full_topic_name = staticmethod(full_topic_fault)
    rclpy_get_validation_error_for_namespace = staticmethod(namespace_fault)
    rclpy_get_validation_error_for_node_name = staticmethod(node_name_fault)
    rclpy_get_validation_error_for_topic_name = staticmethod(topic_fault)

    def rclpy_remove_ros_args(self, arguments: list[str] | None) -> list[str]:
        with self._argument_errors("Failed to parse ROS arguments: ", self.RCLInvalidROSArgsError):
            return RosArguments(arguments or []).others

    @contextmanager
    def _argument_errors(self, prefix: str, kind: type[Exception]) -> Iterator[None]:
        """Raise rclpy's exceptions for arguments that rcl would refuse."""
        try:
            yield
        except UnknownArgumentsError as error:
            raise self.UnknownROSArgsError(str(error.unknown)) from error
        except InvalidArgumentsError as error:
            raise kind(f"{prefix}{error}") from error

    # -- QoS ---------------------------------------------------------------------------------------

    def rclpy_qos_check_compatible(self, publisher: Any, subscription: Any) -> QosResult:
        number, reason = compatibility(publisher.to_dict(), subscription.to_dict())
        return QosResult(self.QoSCompatibility(number), reason)

    def rclpy_action_get_rmw_qos_profile(self, name: str) -> dict[str, Any]:
        if name != "rcl_action_qos_profile_status_default":
            raise RuntimeError(f"Requested unknown rmw_qos_profile: {name}")
        profile: dict[str, Any] = self.rmw_qos_profile_t.predefined("qos_profile_default").to_dict()
        return profile | {"depth": 1, "durability": int(Durability.TRANSIENT_LOCAL)}

    # -- messages ----------------------------------------------------------------------------------

    def rclpy_serialize(self, message: Any, message_type: Any) -> bytes:
        return codec_for(message_type).serialize(message)

    def rclpy_deserialize(self, data: bytes, message_type: Any) -> Any:
        if not isinstance(data, bytes):
            raise TypeError(f"a serialized message is bytes, not {type(data).__name__}")
        try:
            return codec_for(message_type).deserialize(data)
        except ValueError as error:
            raise self.RMWError(f"failed to deserialize ROS message: {error}") from None

    def rclpy_assert_liveliness(self, publisher: Any) -> None:
        task = "Failed to assert liveliness on the Publisher"
        publisher.node.require_up(task, "publisher")
        publisher.assert_liveliness()

    def rclpy_get_rmw_implementation_identifier(self) -> str:
        return "rmw_rsltrace"

    # -- logging -----------------------------------------------------------------------------------

    def rclpy_logging_configure(self, context: Any) -> None:
        """Do nothing: rcl's function would open a log file below the home folder."""

    def rclpy_logging_fini(self) -> None:
        pass

    def rclpy_logging_rosout_add_sublogger(self, name: str, child: str) -> bool:
        return self._world is not None and self._world.logs.add_sublogger(name, child)

    def rclpy_logging_rosout_remove_sublogger(self, name: str, child: str) -> None:
        pass

    def rclpy_logging_initialize(self) -> None:
        pass

    def rclpy_logging_shutdown(self) -> None:
        self._levels.reset()

    def rclpy_logging_set_logger_level(
        self, name: str, level: int, detailed_error: bool = False
    ) -> None:
        try:
            self._levels.set(name, int(level))
        except ValueError as error:
            reason = f"Failed reason: {error}"
            text = reason if detailed_error else "Failed to set level for logger"
            raise RuntimeError(text) from error

    def rclpy_logging_get_logger_level(self, name: str) -> int:
        return self._levels.get(name)

    def rclpy_logging_get_logger_effective_level(self, name: str) -> int:
        return self._levels.effective(name)

    def rclpy_logging_logger_is_enabled_for(self, name: str, severity: int) -> bool:
        return int(severity) >= self._levels.effective(name)

    def rclpy_logging_severity_level_from_string(self, level: str) -> int:
        try:
            return LEVELS[level.upper()]
        except KeyError:
            raise RuntimeError("Failed to get severity name") from None

    def rclpy_logging_get_separator_string(self) -> str:
        return "."

    def rclpy_logging_get_logging_directory(self) -> str:
        home = os.environ.get("ROS_HOME") or os.path.join("~", ".ros")
        folder = os.environ.get("ROS_LOG_DIR") or os.path.join(home, "log")
        return os.path.expanduser(folder)

    def rclpy_logging_rcutils_log(
        self, severity: int, name: str, message: str, function: str, file: str, line: int
    ) -> None:
        if self._world is not None:
            self._world.logs.log(severity, name, message, function, file, line)

    # -- signals: rsltrace's own handlers act for those that a process has installed ---------------

    def install_signal_handlers(self, options: Any) -> None:
        if self.get_current_signal_handlers_options() == self.SignalHandlerOptions.NO:
            self.runtime.programs.present.signals = options

    def uninstall_signal_handlers(self) -> None:
        if self._world is not None:
            self.runtime.programs.present.signals = None

    def get_current_signal_handlers_options(self) -> Any:
        signals = None if self._world is None else self.runtime.programs.present.signals
        return signals or self.SignalHandlerOptions.NO

    def register_sigint_guard_condition(self, guard: Any) -> None:
        pass

    def unregister_sigint_guard_condition(self, guard: Any) -> None:
        pass


HANDLES: dict[str, type] = {
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

_PUBLISHER, _SUBSCRIPTION = 1, 2  # rmw_endpoint_type_t
_IGNORED_TIME = (
    "a node publishes /clock, but nodes with use_sim_time show the run's own time: write clocks: "
    "{source: topic} into the job to make them follow"
)


def _service_types(ends: Iterable[ServiceEndpoint]) -> list[tuple[str, list[str]]]:
    return names_and_types([(end.service, end.type_name) for end in ends])


def _endpoint_info(endpoint: Publisher | Subscription, endpoint_type: int) -> dict[str, Any]:
    """Describe an endpoint as DDS discovers it, without the length of its queue."""
    from rclpy.topic_endpoint_info import TopicEndpointInfo

    _, text = endpoint.type.describe()
    value = bytes.fromhex(text.removeprefix("RIHS01_")) if text.startswith("RIHS01_") else b""
    type_hash = {"version": 1 if value else 0, "value": value or bytes(32)}
    has_hash = hasattr(TopicEndpointInfo, "topic_type_hash")  # from Iron on
    return {
        "node_name": endpoint.node.name,
        "node_namespace": endpoint.node.namespace,
        "topic_type": endpoint.type_name,
        **({"topic_type_hash": type_hash} if has_hash else {}),
        "endpoint_type": endpoint_type,
        "endpoint_gid": list(endpoint.entity_id.to_bytes(16, "big")),
        "qos_profile": profile_of(endpoint.qos) | {"history": int(History.UNKNOWN), "depth": 0},
    }
