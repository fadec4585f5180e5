"""The handle of ``rclpy.Node``: names, arguments, parameters, graph counts."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import Any, Protocol

from rsltrace.adapters.rclpy.arguments import (
    InvalidArgumentsError,
    RosArguments,
    UnknownArgumentsError,
)
from rsltrace.adapters.rclpy.concurrency.entry_starts import policy_of
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox
from rsltrace.adapters.rclpy.concurrency.program import SimulatedProgram
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.handles.context import ContextHandle
from rsltrace.adapters.rclpy.handles.destroyable import Destroyable
from rsltrace.adapters.rclpy.handles.node_state import NodeStates
from rsltrace.adapters.rclpy.names import namespace_fault, node_name_fault
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.entity import DomainEntity, callback_name
from rsltrace.simulation.middleware.events.event import NameRequester
from rsltrace.simulation.middleware.graph import Graph, action_names_and_types, names_and_types
from rsltrace.simulation.middleware.participant import Participant, full_name

_GROUP_KINDS = {
    "MutuallyExclusiveCallbackGroup": "mutually exclusive",
    "ReentrantCallbackGroup": "reentrant",
}
_FRAMES_MAX = 10
"""There are two or three between the boundary and the constructor of ``rclpy.Node``."""


class LogSink(Protocol):
    """Publishes the log records of nodes on /rosout."""

    def attach(self, node: Any, qos: Any = None) -> None:
        """Give a node its /rosout publisher."""

    def detach(self, node: Any) -> None:
        """Forget a node."""


_GROUPS: weakref.WeakKeyDictionary[NodeHandle, list[weakref.ref[Any]]] = weakref.WeakKeyDictionary()
"""The callback groups of nodes besides the default one, in the order of their use. Not an
attribute: objects of a class share the names of at most thirty."""


class NodeHandle(Destroyable, Participant):
    """Stands in for ``_rclpy.Node``.

    ``wrapper`` is the ``rclpy.Node`` once an executor has it; only then do its callbacks run. Names
    follow the rules of ``rcl_node_init``. ``real`` is rclpy's extension.
    """

    destroy = Participant.destroy
    process: SimulatedProgram

    def __init__(
        self,
        real: Any,
        runtime: Runtime,
        logs: LogSink,
        states: NodeStates,
        node_name: str,
        namespace: str,
        context: ContextHandle,
        cli_args: Sequence[str] | None,
        use_global_arguments: bool,
        enable_rosout: bool,
        rosout_qos: Any = None,
    ) -> None:
        if real.rclpy_get_validation_error_for_node_name(node_name) is not None:
            raise ValueError(f"invalid node name: {node_name}")
        if not namespace.startswith("/"):
            namespace = "/" + namespace
        if real.rclpy_get_validation_error_for_namespace(namespace) is not None:
            raise ValueError(f"invalid node namespace: {namespace}")
        try:
            self.arguments = RosArguments(["--ros-args", *cli_args] if cli_args else [])
        except UnknownArgumentsError as error:
            raise real.UnknownROSArgsError(str(error.unknown)) from error
        except InvalidArgumentsError as error:
            message = f"Failed to parse ROS arguments: {error}"
            raise real.RCLInvalidROSArgsError(message) from error
        # The job's arguments for this node are those that ``ros2 run`` gives to a process.
        programs = runtime.programs
        program = programs.present
        entry = programs.constructing if programs.is_hosted else program.entry
        given = entry.arguments if entry is not None else []
        own = given if programs.is_hosted else program.parameters
        self._outer = [context.arguments, *own] if use_global_arguments else []
        self._entry = entry
        self.wrapper: Any = None
        self.process = program
        self.runtime = runtime
        self.real = real
        self.context = context
        self._logs = logs
        name, namespace = self._renamed(node_name, namespace)
        domain = runtime.domain
        Participant.__init__(
            self, domain.dispatcher, name, namespace, domain.dispatcher.exception_handler
        )
        self._number_among_others()
        self.policy = policy_of(runtime.event)
        self.state = states.add(self)
        self.mailbox: Mailbox | None = None
        self.rosout: DomainEntity | None = None
        self._made = _node_being_made()
        self.user_waitables: dict[Any, Any] = {}
        self.waitable_count = 0
        domain.graph.add_node(self)
        domain.event.node = self
        for observer in domain.dispatcher.node_observers:
            observer.node_entered(self, is_made=True)
        self._set_log_levels()
        said = [each.rosout() for each in [*self._outer, self.arguments]]
        if enable_rosout and next((s for s in reversed(said) if s is not None), True):
            logs.attach(self, rosout_qos)

    @property
    def entry(self) -> JobEntry | None:
        return self._entry

    @property
    def entry_key(self) -> str:
        return self._entry.key if self._entry is not None else ""

    @property
    def log_exceptions(self) -> bool:
        """Whether exceptions of its callbacks are logged instead of ending the run."""
        return self._entry is not None and self._entry.log_exceptions

    def _number_among_others(self) -> None:
        """Number the node if others have its name: ROS allows that, but it is seldom meant."""
        others = _at_work(self.runtime, self.fully_qualified_name)
        if others:
            taken = {other.number for other in others}
            self.number = next(number for number in count(1) if number not in taken)
            note = f"several nodes are named {self.fully_qualified_name}"
            notes = self.runtime.domain.outcome.notes
            if note not in notes:
                notes.append(note)

    def _set_log_levels(self) -> None:
        """Apply ``--log-level`` to the loggers that it names and to this node's."""
        real = self.real
        levels: dict[str, str] = {}
        for arguments in [*self._outer, self.arguments]:
            levels.update(arguments.log_levels())
        everybody = levels.pop("", None)
        if everybody is not None:  # not for other programs of the run
            levels.setdefault(self.logger_name(), everybody)
        for logger, level in levels.items():
            number = real.rclpy_logging_severity_level_from_string(level)
            real.rclpy_logging_set_logger_level(logger, number)

    def _renamed(self, name: str, namespace: str) -> tuple[str, str]:
        outer = self._outer_names()
        name = self.arguments.remap_node_name(name, outer)
        return name, self.arguments.remap_namespace(namespace, name, outer)

    def _outer_names(self) -> RosArguments | None:
        """Return the process-wide remapping arguments: the job's, or the context's."""
        if not self._outer:
            return None
        if self.process is not self.runtime.programs.host:
            return self._outer[0]  # of a main, the job's arguments are among the context's
        return self._outer[min(1, len(self._outer) - 1)]

    def resolve(self, name: str, *, service: bool, only_expand: bool = False) -> str:
        """Return a topic or service name fully qualified and remapped.

        :raises ValueError: if the name is not valid.
        """
        real = self.real
        expanded: str = real.rclpy_expand_topic_name(name, self.name, self.namespace)
        if not only_expand:
            if (census := self.dispatcher.entities.census) is not None:
                asker = NameRequester(self.entry_key, self.name, self.namespace)
                census.asked.setdefault(asker, {})[expanded, service] = None
            expanded = self.arguments.remap_topic(
                expanded, self.name, self.namespace, self._outer_names(), service=service
            )
        if real.rclpy_get_validation_error_for_full_topic_name(expanded) is not None:
            raise ValueError(f"topic name is invalid: {expanded}")
        return expanded

    # -- what rclpy calls ----------------------------------------------------------------------

    def get_node_name(self) -> str:
        return self.name

    def get_namespace(self) -> str:
        return self.namespace

    def get_fully_qualified_name(self) -> str:
        return self.fully_qualified_name

    def logger_name(self) -> str:
        """Return rcl's name of the node's logger: the full name with dots."""
        return self.fully_qualified_name.strip("/").replace("/", ".")

    def get_parameters(self, parameter_class: Any) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for arguments in [*self._outer, self.arguments]:
            values.update(arguments.parameters(self.fully_qualified_name))
        return {name: parameter_class(name, value=value) for name, value in values.items()}

    def get_count_publishers(self, topic: str) -> int:
        return len(self.usable_graph("Error in rcl_count_publishers").publishers(topic))

    def get_count_subscribers(self, topic: str) -> int:
        return len(self.usable_graph("Error in rcl_count_subscribers").subscriptions(topic))

    def get_count_clients(self, service: str) -> int:
        return len(self.usable_graph("Error in rcl_count_clients").clients(service))

    def get_count_services(self, service: str) -> int:
        return len(self.usable_graph("Error in rcl_count_services").services(service))

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        graph = self.usable_graph("Failed to get node names")
        return [(node.name, node.namespace) for node in graph.nodes]

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        return [(*node, "/") for node in self.get_node_names_and_namespaces()]

    def get_action_names_and_types(self) -> list[tuple[str, list[str]]]:
        graph = self.usable_graph("Failed to get action names and type")
        return action_names_and_types(graph.topic_names_and_types())

    def get_action_client_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "Failed to get action client names and type"
        ends = self.ends_of("subscriptions", task, name, namespace)
        return action_names_and_types(topic_types(ends))

    def get_action_server_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        task = "Failed to get action server names and type"
        ends = self.ends_of("publishers", task, name, namespace)
        return action_names_and_types(topic_types(ends))

    def ends_of(self, ends: str, task: str, name: str, namespace: str) -> Iterable[Any]:
        """Return the ``publishers``, ``subscriptions``, ``services`` or ``clients`` of a node.
        Raises NodeNameNonExistentError if there is none of this name."""
        graph = self.usable_graph(task)
        fault = node_name_fault(name) or namespace_fault(namespace or "/")
        if fault is not None:
            raise self.real.RCLError(f"{task}: {fault[0]}")
        found = graph.node_named(full_name(namespace, name))
        if found is None:
            reason = f"{task.replace('failed to', 'cannot')} for nonexistent node"
            missing = full_name(namespace, name)
            raise self.real.NodeNameNonExistentError(f"{reason}: {missing}")
        listed: Iterable[Any] = getattr(graph, f"{ends}_of")(found)
        return listed

    def usable_graph(self, task: str) -> Graph:
        """Return the graph, for calls of user code. Raises RCLError if the context is shut down."""
        self.require_up(task)
        return self.runtime.domain.graph

    def require_up(self, task: str, whose: str = "rcl node") -> None:
        """Raise RCLError if the node's context is shut down, as rcl does for ``task``."""
        if not self.context.is_up:
            raise self.real.RCLError(f"{task}: {whose}'s context is invalid")

    # -- the trace -----------------------------------------------------------------------------

    def trace_type(self) -> str:
        return "" if self.made is None else class_name(type(self.made))

    def user_callback(self) -> object:
        return None if self.made is None else type(self.made)  # its constructor

    def group_name(self, group: Any) -> str:
        """Return the trace's name of a callback group (``reentrant 2``); "" for the default one."""
        if group is None or group is getattr(self.made, "default_callback_group", group):
            return ""
        groups = _GROUPS.setdefault(self, [])
        number = next((n for n, one in enumerate(groups, 1) if one() is group), 0)
        if not number:
            groups.append(weakref.ref(group))
            number = len(groups)
        kind = type(group).__name__
        return f"{_GROUP_KINDS.get(kind, kind)} {number}"

    @property
    def made(self) -> Any:
        """The ``rclpy.Node``, also while its constructor waits; None if it is gone."""
        return self._made() if self.wrapper is None else self.wrapper

    def timer_periods(self) -> Iterable[tuple[str, int]]:
        timers = () if self.wrapper is None else self.wrapper.timers
        return ((callback_name(each.callback), each.handle.state.period_ns) for each in timers)

    def shortest_period_ns(self) -> int | None:
        timers = () if self.wrapper is None else self.wrapper.timers
        return min((timer.handle.state.period_ns for timer in timers), default=None)

    def _destroy(self) -> None:
        super()._destroy()
        self._logs.detach(self)
        if self.rosout is not None:
            self.rosout.destroy()


def topic_types(ends: Iterable[Any]) -> list[tuple[str, list[str]]]:
    """Return the topics of publishers or subscriptions, each with its types."""
    return names_and_types([(end.topic, end.type_name) for end in ends])


def _node_being_made() -> Callable[[], Any]:
    """Return a weak reference to the ``rclpy.Node`` whose constructor makes a handle."""
    frame = sys._getframe(2)
    for _ in range(_FRAMES_MAX):
        made = frame.f_locals.get("self")
        if frame.f_code.co_name == "__init__" and isinstance(made, sys.modules["rclpy.node"].Node):
            return weakref.ref(made)
        if frame.f_back is None:
            break
        frame = frame.f_back
    return lambda: None


def class_name(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _at_work(runtime: Runtime, name: str) -> list[Participant]:
    """Return the active nodes of a name: a main may leave a node with a context that is shut down,
    or without an executor."""
    return [
        node
        for node in runtime.domain.graph.nodes_named(name)
        if not isinstance(node, NodeHandle)
        or (node.context.ok() and (node.wrapper is not None or runtime.programs.is_hosted))
    ]


# The declared and the unused parameters of a run's nodes.


@dataclass(frozen=True, slots=True)
class Parameters:
    """The declared parameters of a node, and given ones that it did not declare (``unused``).

    ``entry_key``: the job's entry that made it, or empty. ``unconfigured``: a managed node before
    its configuration, when it declares its parameters.
    """

    entry_key: str
    declared: tuple[str, ...]
    unused: tuple[str, ...]
    unconfigured: bool = False


def parameters_of(graph: Graph) -> dict[str, Parameters]:
    """Return the parameters of the nodes, without nodes that allow undeclared ones."""
    found = {}
    for handle in graph.nodes:
        if not isinstance(handle, NodeHandle):
            continue
        node = handle.wrapper
        if node is None or node._allow_undeclared_parameters:
            continue
        declared = tuple(node._parameters)
        unused = tuple(name for name in node._parameter_overrides if name not in node._parameters)
        found[handle.key] = Parameters(handle.entry_key, declared, unused, _is_unconfigured(node))
    return found


def _is_unconfigured(node: object) -> bool:
    """Return whether a node is a managed one in its first state."""
    lifecycle = sys.modules.get("rclpy.lifecycle")
    if lifecycle is None or not isinstance(node, lifecycle.LifecycleNodeMixin):
        return False
    machine = getattr(node, "_state_machine", None)  # there unless it was made without
    return machine is not None and bool(machine.current_state[1] == "unconfigured")
