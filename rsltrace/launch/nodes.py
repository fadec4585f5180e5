"""The actions of launch files that start nodes: node, node_container, load_composable_node."""

from __future__ import annotations

import shlex
from functools import partial
from typing import Any

from rsltrace.launch.element import Element
from rsltrace.launch.evaluation import Evaluation
from rsltrace.launch.model import LaunchedNode
from rsltrace.launch.parameter_files import substituted_parameters
from rsltrace.launch.scope import ParameterFile, Parameters, absolute_namespace

_WITHOUT_MEANING = (
    "output",
    "output_format",
    "respawn",
    "respawn_delay",
    "respawn_max_retries",
    "emulate_tty",
    "exec_name",
    "log_cmd",
    "sigterm_timeout",
    "sigkill_timeout",
    "shell",
)
"""How a process is run: nothing that a node could tell in a simulation."""

_LOST = ("launch-prefix", "cwd", "on_exit", "required")
"""What makes a difference for a process of its own, and has none here: said, then left out."""

_NODE = ("pkg", "exec", "name", "node-name", "namespace", "args", "ros_args", "autostart")
_COMPONENT = ("pkg", "plugin", "name", "namespace")


class Nodes:
    """Makes ``LaunchedNode`` values of elements, with the defaults of the groups around them."""

    def __init__(self, evaluation: Evaluation) -> None:
        self._evaluation = evaluation

    def node(self, element: Element) -> None:
        """Do ``<node>`` and ``<lifecycle_node>``."""
        self._check_process(element, ["param", "remap"])
        evaluation = self._evaluation
        executable = evaluation.needed(element, "exec")
        package = evaluation.optional(element, "pkg")
        if package is None:
            evaluation.refuse(element, f"process {executable!r}", "it belongs to no package (pkg=)")
            return
        if element.get("autostart") is not None and evaluation.flag(
            element.get("autostart"), False
        ):
            evaluation.refuse(
                element,
                f"autostart of {package}/{executable}",
                "nobody changes the states of lifecycle nodes here: let a node of the job do it",
            )
        evaluation.launched.nodes.append(
            LaunchedNode(
                where=_where(element),
                package=package,
                executable=executable,
                arguments=self._words(element, "args"),
                ros_arguments=self._words(element, "ros_args"),
                **self._common(element),
            )
        )

    def container(self, element: Element) -> None:
        """Do ``<node_container>``: its components are nodes, it is nothing itself."""
        self._check_process(element, ["composable_node", "param", "remap"])
        self._components(element)

    def load(self, element: Element) -> None:
        """Do ``<load_composable_node>``."""
        element.check(["target"], ["composable_node"])
        self._components(element)

    def _components(self, element: Element) -> None:
        evaluation = self._evaluation
        for child in element.named("composable_node"):
            child.check(_COMPONENT, ["param", "remap", "extra_arg"])
            if not evaluation.holds(child):
                continue
            evaluation.launched.nodes.append(
                LaunchedNode(
                    where=_where(child),
                    package=evaluation.needed(child, "pkg"),
                    plugin=evaluation.needed(child, "plugin"),
                    **self._common(child),
                )
            )

    def _check_process(self, element: Element, children: list[str]) -> None:
        element.check([*_NODE, *_WITHOUT_MEANING, *_LOST], [*children, "env"])
        lost = [name for name in _LOST if element.get(name) is not None]
        lost += [f"env {self._evaluation.needed(e, 'name')}" for e in element.named("env")]
        if lost:
            self._evaluation.launched.ignored.append(
                f"{_where(element)}: {', '.join(lost)}: all nodes run in one process"
            )

    def _common(self, element: Element) -> dict[str, Any]:
        evaluation = self._evaluation
        scope = evaluation.scope
        namespace = absolute_namespace(scope.namespace, evaluation.optional(element, "namespace"))
        name = evaluation.optional(element, "name") or evaluation.optional(element, "node-name")
        remappings = []
        for remap in element.named("remap"):
            remap.check(["from", "to"])
            remappings.append((evaluation.needed(remap, "from"), evaluation.needed(remap, "to")))
        full_name = None if name is None else f"{(namespace or '').rstrip('/')}/{name}"
        return {
            "name": name,
            "namespace": namespace,
            "parameters": scope.parameters + self._parameters(element, full_name),
            "remappings": scope.remappings + tuple(remappings),
            "delay_ns": evaluation.delay_ns,
            "after": evaluation.after,
        }

    def _words(self, element: Element, name: str) -> tuple[str, ...]:
        attribute = element.get(name)
        if attribute is None:
            return ()
        try:
            return tuple(shlex.split(self._evaluation.text(attribute)))
        except ValueError as error:
            raise attribute.place.error(f"{name}: {error}") from None

    # -- parameters --------------------------------------------------------------------------------

    def _parameters(self, element: Element, full_name: str | None) -> Parameters:
        found: list[ParameterFile | dict[str, Any]] = []
        for param in element.named("param"):
            if param.get("from") is None:
                found.append(self._mapping([param]))
                continue
            param.check(["from", "allow_substs"])
            path = self._evaluation.existing_file(param.need("from"))
            if self._evaluation.flag(param.get("allow_substs"), False):
                place = param.need("from").place
                replaced = partial(self._evaluation.replaced, place=place)
                found.append(substituted_parameters(path, replaced, full_name))
            else:
                found.append(ParameterFile(path))
        return tuple(found)

    def _mapping(self, params: list[Element]) -> dict[str, Any]:
        evaluation = self._evaluation
        values: dict[str, Any] = {}
        for param in params:
            param.check(["name", "value", "type", "value-sep"], ["param"])
            name, value = evaluation.needed(param, "name"), param.get("value")
            nested = param.named("param")
            if (value is None) == (not nested):
                raise param.place.error("a parameter has either a value or parameters within it")
            if value is not None:
                values[name] = evaluation.value(value, evaluation.optional(param, "type"))
            else:
                values[name] = self._mapping(nested)
        return values


def _where(element: Element) -> str:
    return element.place.source.where(element.place.mark)
