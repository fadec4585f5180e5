"""The actions of launch files that start nodes: node, node_container, load_composable_node."""

from __future__ import annotations

import shlex
from functools import partial
from typing import Any

from rsltrace.adapters.launch.evaluation import Evaluation
from rsltrace.adapters.launch.model import (
    Element,
    LaunchedNode,
    ParameterFilePath,
    Parameters,
    ProcessSettings,
    absolute_namespace,
    full_name,
    respawning,
)
from rsltrace.adapters.launch.parameter_files import substituted_parameters

_WITHOUT_MEANING = (
    "output",
    "output_format",
    "emulate_tty",
    "exec_name",
    "log_cmd",
    "sigterm_timeout",
    "sigkill_timeout",
    "shell",
)
"""How a process is run: nothing that a node could tell in a simulation."""

_OF_PROCESSES = ("launch-prefix", "cwd", "respawn", "respawn_delay", "respawn_max_retries")
_ENDS = ("on_exit", "required")

_NODE = ("pkg", "exec", "name", "node-name", "namespace", "args", "ros_args", "autostart")
_COMPONENT = ("pkg", "plugin", "name", "namespace")


class Nodes:
    """Makes ``LaunchedNode`` values of elements, with the defaults of the groups around them."""

    def __init__(self, evaluation: Evaluation) -> None:
        self._evaluation = evaluation

    def node(self, element: Element) -> None:
        """Do ``<node>`` and ``<lifecycle_node>``."""
        self._check_process(element, ["param", "remap"])
        self._process(element)

    def _process(self, element: Element, *, is_container: bool = False) -> None:
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
        number = 0
        if self._ends_everything(element):
            evaluation.kept.append(element)  # so that no other gets its id
            number = id(element)
            evaluation.launched.required.add(number)
        evaluation.launched.nodes.append(
            LaunchedNode(
                where=_where(element),
                package=package,
                executable=executable,
                arguments=self._words(element, "args"),
                ros_arguments=self._words(element, "ros_args"),
                number=number,
                surroundings=self._surroundings(element),
                is_container=is_container,
                **self._common(element),
            )
        )

    def container(self, element: Element) -> None:
        """Do ``<node_container>`` and its components."""
        self._check_process(element, ["composable_node", "param", "remap"])
        self._process(element, is_container=True)
        namespace, name = self._names(element)
        self._components(element, full_name(namespace, name or ""))

    def load(self, element: Element) -> None:
        """Do ``<load_composable_node>``."""
        element.check(["target"], ["composable_node"])
        self._components(element, full_name(None, self._evaluation.needed(element, "target")))

    def _components(self, element: Element, container: str) -> None:
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
                    container=container,
                    extra_arguments=(self._mapping(child.named("extra_arg")),),
                    **self._common(child),
                )
            )

    def _check_process(self, element: Element, children: list[str]) -> None:
        element.check([*_NODE, *_WITHOUT_MEANING, *_OF_PROCESSES, *_ENDS], [*children, "env"])

    def _surroundings(self, element: Element) -> ProcessSettings:
        """Return what is said of the process of a node."""
        evaluation = self._evaluation
        own = {
            evaluation.needed(e, "name"): evaluation.needed(e, "value")
            for e in element.named("env")
        }
        respawn: tuple[int, int | None] | None = None
        if evaluation.flag(element.get("respawn"), False):
            times = int(self._number(element, "respawn_max_retries", -1))
            delay_s = self._number(element, "respawn_delay", 0.0)
            respawn = respawning(delay_s, times)
        return ProcessSettings(
            tuple({**evaluation.changed_environment(), **own}.items()),
            folder=evaluation.optional(element, "cwd") or "",
            respawn=respawn,
            own=(*(f"env {name}" for name in own), *_given(element, "cwd")),
            without=_given(element, "launch-prefix"),
        )

    def _number(self, element: Element, name: str, default: float) -> float:
        attribute = element.get(name)
        if attribute is None:
            return default
        written = self._evaluation.text(attribute)
        try:
            return float(written)
        except ValueError:
            raise attribute.place.error(f"{name} is a number, not {written!r}") from None

    def _ends_everything(self, element: Element) -> bool:
        """Return whether everything ends when the process of an element does."""
        evaluation, on_exit = self._evaluation, element.get("on_exit")
        if on_exit is not None and evaluation.text(on_exit) != "shutdown":
            raise on_exit.place.error("what a process can do at its end is 'shutdown'")
        return on_exit is not None or evaluation.flag(element.get("required"), False)

    def _names(self, element: Element) -> tuple[str | None, str | None]:
        """Return namespace and name of a node, as far as they are said."""
        evaluation = self._evaluation
        own = evaluation.optional(element, "namespace")
        name = evaluation.optional(element, "name") or evaluation.optional(element, "node-name")
        return absolute_namespace(evaluation.scope.namespace, own), name

    def _common(self, element: Element) -> dict[str, Any]:
        evaluation = self._evaluation
        scope = evaluation.scope
        namespace, name = self._names(element)
        remappings = []
        for remap in element.named("remap"):
            remap.check(["from", "to"])
            remappings.append((evaluation.needed(remap, "from"), evaluation.needed(remap, "to")))
        whole = None if name is None else full_name(namespace, name)
        return {
            "name": name,
            "namespace": namespace,
            "parameters": scope.parameters + self._parameters(element, whole),
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
        found: list[ParameterFilePath | dict[str, Any]] = []
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
                found.append(ParameterFilePath(path))
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


def _given(element: Element, *names: str) -> tuple[str, ...]:
    return tuple(name for name in names if element.get(name) is not None)


def _where(element: Element) -> str:
    return element.place.source.where(element.place.mark)
