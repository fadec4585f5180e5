"""The handle of ``rclpy.Node``: names, arguments, parameters, graph counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.arguments import (
    InvalidArgumentsError,
    RosArguments,
    UnknownArgumentsError,
)
from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
from rsltrace.doors.rclpy.node_state import NodeState
from rsltrace.errors import NodeError
from rsltrace.middleware.census import Asker
from rsltrace.middleware.graph import action_names_and_types
from rsltrace.model.entity import EntityKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.boundary import Boundary
    from rsltrace.doors.rclpy.boundary.context import ContextHandle
    from rsltrace.doors.rclpy.boundary.pubsub import PublisherHandle
    from rsltrace.doors.rclpy.boundary.waitables import UserWaitable
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.doors.rclpy.stacks.mailbox import Mailbox


class NodeHandle(EntityHandle):
    """Stands in for ``_rclpy.Node``.

    ``wrapper`` is the ``rclpy.Node`` once an executor of this run has it; only then do its
    callbacks run. The rules for names are those of ``rcl_node_init``.
    """

    kind = EntityKind.NODE

    def __init__(
        self,
        boundary: Boundary,
        core: Core,
        node_name: str,
        namespace: str,
        context: ContextHandle,
        cli_args: Sequence[str] | None,
        use_global_arguments: bool,
        enable_rosout: bool,
        rosout_qos: Any = None,
    ) -> None:
        real = boundary.real
        if real.rclpy_get_validation_error_for_node_name(node_name) is not None:
            raise ValueError(f"invalid node name: {node_name}")
        if not namespace.startswith("/"):
            namespace = "/" + namespace
        if real.rclpy_get_validation_error_for_namespace(namespace) is not None:
            raise ValueError(f"invalid node namespace: {namespace}")
        try:
            self.arguments = RosArguments(["--ros-args", *cli_args] if cli_args else [])
        except UnknownArgumentsError as error:
            raise real.UnknownROSArgsError(str(error)) from error
        except InvalidArgumentsError as error:
            message = f"Failed to parse ROS arguments: {error}"
            raise real.RCLInvalidROSArgsError(message) from error
        # The job's arguments for this node are the process's arguments of ``ros2 run``.
        program = core.program
        is_hosted = program is core.host
        entry = core.constructing if is_hosted else program.entry
        given = entry.arguments if entry is not None else []
        own = given if is_hosted else program.parameters
        self._outer = [context.arguments, *own] if use_global_arguments else []
        self.entry_key = entry.key if entry is not None else ""
        self.program = program
        self.core = core
        self.boundary = boundary
        self._context = context
        name, namespace = self._renamed(node_name, namespace)
        self.name = name
        self.namespace = namespace
        self.fully_qualified_name = (
            namespace if namespace.endswith("/") else namespace + "/"
        ) + name
        if _is_taken(core, self.fully_qualified_name):
            raise _duplicate(core, self.fully_qualified_name)
        super().__init__(core, None)
        self.node = self
        self.policy = core.policy
        state = (self.policy or core.default_policy).state
        self.state = NodeState(core, self, keeps=state == "record") if state else None
        if self.state is not None:
            core.states[self.fully_qualified_name] = self.state
        self.mailbox: Mailbox | None = None
        self.rosout: PublisherHandle | None = None
        self.log_exceptions = entry is not None and entry.log_exceptions
        self.actions: list[Any] = []
        self.user_waitables: dict[Any, UserWaitable] = {}
        self.waitable_count = 0
        core.graph.nodes.append(self)
        core.current_node = self
        if core.on_node is not None:
            core.on_node(self, is_made=True)
        self._set_log_levels()
        said = [each.rosout() for each in [*self._outer, self.arguments]]
        if enable_rosout and next((s for s in reversed(said) if s is not None), True):
            core.logs.attach(self, rosout_qos)

    def _set_log_levels(self) -> None:
        """Do what ``--log-level`` asks for, for the loggers it names and for this node's."""
        real = self.boundary.real
        levels: dict[str, str] = {}
        for arguments in [*self._outer, self.arguments]:
            levels.update(arguments.log_levels())
        everybody = levels.pop("", None)
        if everybody is not None:  # but not for other programs of the run
            levels.setdefault(self.logger_name(), everybody)
        for logger, level in levels.items():
            number = real.rclpy_logging_severity_level_from_string(level)
            real.rclpy_logging_set_logger_level(logger, number)

    def _renamed(self, name: str, namespace: str) -> tuple[str, str]:
        outer = self._outer_names()
        name = self.arguments.remap_node_name(name, outer)
        return name, self.arguments.remap_namespace(namespace, name, outer)

    def _outer_names(self) -> RosArguments | None:
        """Return the process-wide arguments that rename things: the job's, or the context's."""
        if not self._outer:
            return None
        if self.program is not self.core.host:
            return self._outer[0]  # of a main, the job's arguments are among the context's
        return self._outer[min(1, len(self._outer) - 1)]

    def resolve(self, name: str, *, service: bool, only_expand: bool = False) -> str:
        """Return a topic or service name fully qualified and remapped.

        :raises ValueError: if the name is not valid.
        """
        real = self.boundary.real
        expanded: str = real.rclpy_expand_topic_name(name, self.name, self.namespace)
        if not only_expand:
            if (met := self.core.met) is not None:
                asker = Asker(self.entry_key, self.name, self.namespace)
                met.asked.setdefault(asker, {})[expanded, service] = None
            expanded = self.arguments.remap_topic(
                expanded, self.name, self.namespace, self._outer_names(), service=service
            )
        if real.rclpy_get_validation_error_for_full_topic_name(expanded) is not None:
            raise ValueError(f"topic name is invalid: {expanded}")
        return expanded

    # -- what rclpy calls ----------------------------------------------------------------------

    def get_node_name(self) -> str:
        """Return the node's name after remapping."""
        return self.name

    def get_namespace(self) -> str:
        """Return the node's namespace after remapping."""
        return self.namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name."""
        return self.fully_qualified_name

    def logger_name(self) -> str:
        """Return the name rcl gives the node's logger: the FQN with dots."""
        return self.fully_qualified_name.strip("/").replace("/", ".")

    def get_parameters(self, parameter_class: Any) -> dict[str, Any]:
        """Return the parameter overrides for this node as rclpy Parameters by name."""
        values: dict[str, Any] = {}
        for arguments in [*self._outer, self.arguments]:
            values.update(arguments.parameters(self.fully_qualified_name))
        return {name: parameter_class(name, value=value) for name, value in values.items()}

    def get_count_publishers(self, topic: str) -> int:
        """Count the publishers of a fully qualified topic."""
        return len(self.core.graph.publishers(topic))

    def get_count_subscribers(self, topic: str) -> int:
        """Count the subscriptions of a fully qualified topic."""
        return len(self.core.graph.subscriptions(topic))

    def get_count_clients(self, service: str) -> int:
        """Count the clients of a fully qualified service."""
        return len(self.core.graph.clients(service))

    def get_count_services(self, service: str) -> int:
        """Count the servers of a fully qualified service."""
        return len(self.core.graph.services(service))

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return every node of the graph, in creation order."""
        return [(node.name, node.namespace) for node in self.core.graph.nodes]

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        """Return every node of the graph with its enclave (always the root one)."""
        return [(node.name, node.namespace, "/") for node in self.core.graph.nodes]

    def get_action_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return every action of the graph with its type."""
        return action_names_and_types(self.core.graph.topic_names_and_types())

    def get_action_client_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        """Return the actions that a node is a client of."""
        query = self.boundary.rclpy_get_subscriber_names_and_types_by_node
        return action_names_and_types(query(self, False, name, namespace))

    def get_action_server_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        """Return the actions that a node serves."""
        query = self.boundary.rclpy_get_publisher_names_and_types_by_node
        return action_names_and_types(query(self, False, name, namespace))

    # -- the trace -----------------------------------------------------------------------------

    def settle(self) -> bool:
        return True

    def trace_name(self) -> str:
        return self.fully_qualified_name

    def trace_type(self) -> str:
        return "" if self.wrapper is None else class_name(type(self.wrapper))

    def describe(self) -> str:
        return self.fully_qualified_name

    def _destroy(self) -> None:
        self.core.graph.nodes.remove(self)
        self.core.logs.detach(self)
        if self.rosout is not None:
            self.rosout.destroy_when_not_in_use()


def class_name(cls: type) -> str:
    """Return ``module:Class`` of a node's class."""
    return f"{cls.__module__}:{cls.__qualname__}"


def _is_taken(core: Core, name: str) -> bool:
    """Return whether a node of that name is at work.

    In a program's hands a node may be left behind: its context is shut down, or nobody spins it.
    """
    return any(
        node.fully_qualified_name == name
        and node._context.ok()
        and (node.wrapper is not None or core.program is core.host)
        for node in core.graph.nodes
    )


def _duplicate(core: Core, name: str) -> NodeError:
    return NodeError(
        f"there is already a node named {name}; give one of them another name or namespace "
        "(name: or namespace: in the job)",
        node=name,
        entity=name,
        stamp_ns=core.loop.now_ns,
        traceback_text="",
    )
