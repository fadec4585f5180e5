"""Components of a job: loaded by a request to their container, as ``ros2 launch`` does it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.adapters.rclpy.messages.interfaces import get_service_class
from rsltrace.errors import JobError, RunError, SetupError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.participant import full_name

_TYPE = "composition_interfaces/srv/LoadNode"
_RULES = ("-r", "--remap")


@dataclass(frozen=True, slots=True)
class Component:
    """A component to load. ``arguments`` are those of ``ros2 run``; ``name`` and ``namespace`` are
    empty if the component names itself."""

    package: str
    plugin: str
    container: str
    name: str
    namespace: str
    arguments: Sequence[RosArguments]
    extra: Mapping[str, Any]
    log_failure: bool = False

    @property
    def service(self) -> str:
        return load_service(self.container)

    def load(self) -> list[Any]:
        """Load it and wait for the response; return no nodes.

        :raises RunError: if the container cannot load it, unless ``log_failure``.
        """
        import rclpy

        name = "_load" + self.container.replace("/", "_")
        node = rclpy.create_node(name, start_parameter_services=False)
        client = node.create_client(_service_class(), self.service)
        client.wait_for_service()
        future = client.call_async(self._request())
        rclpy.spin_until_future_complete(node, future)
        answer: Any = future.result()
        if not answer.success:
            wrong = (
                f"{self.container} cannot load {self.package}/{self.plugin}: {answer.error_message}"
            )
            if not self.log_failure:
                raise RunError(wrong)
            node.get_logger().error(wrong)
        node.destroy_node()
        return []

    def _request(self) -> Any:
        return _service_class().Request(
            package_name=self.package,
            plugin_name=self.plugin,
            node_name=self.name,
            node_namespace=self.namespace,
            remap_rules=list(dict.fromkeys(self._rules())),
            parameters=_messages(self._parameters()),
            extra_arguments=_messages(self.extra),
        )

    def _rules(self) -> Iterable[str]:
        """Return the remappings, except for the node's own name."""
        for part in self.arguments:
            for flag, rule in zip(part.arguments, part.arguments[1:], strict=False):
                if flag in _RULES and not rule.startswith(("__node:=", "__ns:=", "__name:=")):
                    yield rule

    def _parameters(self) -> dict[str, Any]:
        node = full_name(self.namespace, self.name) if self.name else ""
        values: dict[str, Any] = {}
        for part in self.arguments:
            values.update(part.parameters(node))
        return values


def load_service(container: str) -> str:
    """Return the name of the service by which a container loads components."""
    return f"{container}/_container/load_node"


def check_loadable(where: str) -> None:
    """Raise ``JobError`` if the service type for loading components is not installed."""
    try:
        _service_class()
    except SetupError as error:
        raise JobError(str(error), where=where) from error


def _service_class() -> Any:
    return get_service_class(_TYPE)


def _messages(values: Mapping[str, Any]) -> list[Any]:
    """Return parameters in the order of their names: a trace keeps no other one of its job."""
    from rclpy.parameter import Parameter

    return [Parameter(name, value=values[name]).to_parameter_msg() for name in sorted(values)]
