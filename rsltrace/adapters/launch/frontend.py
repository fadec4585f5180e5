"""Builds the actions of an XML or YAML launch file: the same that a Python launch file makes.

Attributes are those of launch and launch_ros. Nothing here runs code of the file's author.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable
from typing import Any

from rsltrace.adapters.launch.api import actions, events, nodes, settings
from rsltrace.adapters.launch.api.actions import AnyLaunchDescriptionSource
from rsltrace.adapters.launch.api.basics import (
    Action,
    Condition,
    LaunchContext,
    LaunchDescription,
    Substitution,
    SubstitutionFailure,
)
from rsltrace.adapters.launch.api.parameters import ParameterFile, ParameterValue
from rsltrace.adapters.launch.model import Attribute, Element, truth, typed
from rsltrace.adapters.launch.substitution import parse_template
from rsltrace.errors import JobError, nearest
from rsltrace.trace.model.regular_file import not_regular

_WITHOUT_MEANING = (
    "output",
    "output_format",
    "emulate_tty",
    "exec_name",
    "log_cmd",
    "sigterm_timeout",
    "sigkill_timeout",
)
"""How a process is run: nothing that a node could tell in a simulation."""
_PROCESS = (
    *("launch-prefix", "cwd", "respawn", "respawn_delay", "respawn_max_retries"),
    *("on_exit", "required", *_WITHOUT_MEANING),
)
_NODE = (
    *("pkg", "exec", "name", "node-name", "namespace", "args", "ros_args", "autostart"),
    *("shell", *_PROCESS),
)
_COMPONENT = ("pkg", "plugin", "name", "namespace")


def launch_description(root: Element) -> LaunchDescription:
    """Return the actions of a file, given its ``launch`` element."""
    root.check(["version"], None)
    return LaunchDescription(_children(root))


# Values of attributes.


class AttributeText(Substitution):
    """The text of an attribute. Mistakes are reported at its place; ``check`` raises some."""

    def __init__(self, attribute: Attribute, check: Callable[[str], object] = str) -> None:
        self._attribute, self._check = attribute, check

    def describe(self) -> str:
        value = self._attribute.value
        return str(value).lower() if isinstance(value, bool) else str(value)

    def perform(self, context: LaunchContext) -> str:
        try:
            text = self._text(context)
            self._check(text)
            return text
        except (ValueError, SubstitutionFailure) as error:
            raise self._attribute.place.error(str(error)) from None

    def _text(self, context: LaunchContext) -> str:
        return context.text(parse_template(self.describe()))


class _FilePath(AttributeText):
    """The path of a file that must exist, relative to the launch file's folder."""

    def __init__(self, attribute: Attribute, what: str = "file") -> None:
        super().__init__(attribute)
        self._what = what

    def _text(self, context: LaunchContext) -> str:
        written = super()._text(context)
        path = context.file.parent / written
        if not path.is_file():
            if path.exists():
                raise ValueError(f"{written} is {not_regular(path)}")
            raise ValueError(f"there is no {self._what} {written}")
        return str(path)


class _AttributeValue(ParameterValue):
    """The value of a parameter: typed by YAML, by ``type``, or by what it looks like."""

    def __init__(self, attribute: Attribute, kind: AttributeText | None) -> None:
        self._attribute, self._kind = attribute, kind

    def evaluate(self, context: LaunchContext) -> Any:
        kind = context.optional(self._kind)
        try:
            value = self._replaced(context, self._attribute.value)
            if kind is None and isinstance(value, list) and all(isinstance(v, str) for v in value):
                found = [typed(item, None) for item in value]
                value = found if len({type(item) for item in found}) == 1 else value
            return typed(value, kind)
        except (ValueError, SubstitutionFailure) as error:
            raise self._attribute.place.error(str(error)) from None

    def _replaced(self, context: LaunchContext, value: Any) -> Any:
        if isinstance(value, list):
            return [self._replaced(context, item) for item in value]
        return context.text(parse_template(value)) if isinstance(value, str) else value


def _text(
    element: Element, name: str, check: Callable[[str], object] = str
) -> AttributeText | None:
    attribute = element.get(name)
    return None if attribute is None else AttributeText(attribute, check)


def _need(element: Element, name: str) -> AttributeText:
    return AttributeText(element.need(name))


def _flag(element: Element, name: str, default: bool = False) -> AttributeText | bool:
    attribute = element.get(name)
    return default if attribute is None else AttributeText(attribute, truth)


def _number(element: Element, name: str, default: float) -> AttributeText | float:
    def check(written: str) -> None:
        try:
            float(written)
        except ValueError:
            raise ValueError(f"{name} is a number, not {written!r}") from None

    attribute = element.get(name)
    return default if attribute is None else AttributeText(attribute, check)


def _words(element: Element, name: str) -> Callable[[LaunchContext], Iterable[str]] | None:
    """Return what splits an attribute into the words of a command line."""
    attribute = element.get(name)
    if attribute is None:
        return None
    text = AttributeText(attribute)

    def words(context: LaunchContext) -> Iterable[str]:
        try:
            return shlex.split(context.text(text))
        except ValueError as error:
            raise attribute.place.error(f"{name}: {error}") from None

    return words


def _pairs(elements: Iterable[Element], key: str, value: str) -> list[tuple[Any, Any]]:
    pairs = []
    for element in elements:
        element.check([key, value])
        pairs.append((_need(element, key), _need(element, value)))
    return pairs


# Elements.


class _BrokenElement(Action):
    """An element with a mistake, which counts only where the element is reached."""

    def __init__(self, error: JobError) -> None:
        super().__init__()
        self._error = error

    def execute(self, context: LaunchContext) -> None:
        raise self._error


def _children(element: Element) -> list[Action]:
    return [_action(child) for child in element.children if child.tag != "keep"]


def _action(element: Element) -> Action:
    condition = None
    try:
        condition = _condition(element)
        build = ACTIONS.get(element.tag)
        if build is None:
            near = nearest(element.tag, ACTIONS)
            hint = f"did you mean <{near}>?" if near else f"there are {', '.join(ACTIONS)}"
            raise element.place.error(f"unknown action <{element.tag}>; {hint}")
        action = build(element)
    except JobError as error:
        action = _BrokenElement(error)
    action._condition = condition
    action.where, action.place = _where(element), element.place
    return action


def _condition(element: Element) -> Condition | None:
    yes, no = element.get("if"), element.get("unless")
    if yes is not None and no is not None:
        raise no.place.error("give either 'if' or 'unless', not both")
    if no is not None:
        return actions.UnlessCondition(AttributeText(no, truth))
    return None if yes is None else actions.IfCondition(AttributeText(yes, truth))


def _where(element: Element) -> str:
    return element.place.source.where(element.place.mark)


def _argument(element: Element) -> Action:
    element.check(["name", "default", "description"], ["choice"])
    about = element.get("description")
    return settings.DeclareLaunchArgument(
        _need(element, "name").describe(),
        default_value=_text(element, "default"),
        description=None if about is None else str(about.value),
        choices=[_need(one, "value").describe() for one in element.named("choice")] or None,
    )


def _let(element: Element) -> Action:
    element.check(["name", "value"])
    return settings.SetLaunchConfiguration(_need(element, "name"), _need(element, "value"))


def _group(element: Element) -> Action:
    element.check(["scoped", "forwarding"], None)
    return settings.GroupAction(
        _children(element),
        scoped=_flag(element, "scoped", True),
        forwarding=_flag(element, "forwarding", True),
        launch_configurations=dict(_pairs(element.named("keep"), "name", "value")),
    )


def _include(element: Element) -> Action:
    element.check(["file"], ["arg", "let"])
    given = [*element.named("arg"), *element.named("let")]
    return actions.IncludeLaunchDescription(
        AnyLaunchDescriptionSource(_FilePath(element.need("file"), "launch file")),
        launch_arguments=_pairs(given, "name", "value"),
    )


def _timer(element: Element) -> Action:
    element.check(["period"], None)
    period = AttributeText(element.need("period"), actions.period_ns)
    return actions.TimerAction(period=period, actions=_children(element))


def _set_env(element: Element) -> Action:
    element.check(["name", "value"])
    return settings.SetEnvironmentVariable(_need(element, "name"), _need(element, "value"))


def _append_env(element: Element) -> Action:
    element.check(["name", "value", "prepend", "separator"])
    return settings.AppendEnvironmentVariable(
        _need(element, "name"),
        _need(element, "value"),
        prepend=_flag(element, "prepend"),
        separator=_text(element, "separator") or os.pathsep,
    )


def _unset_env(element: Element) -> Action:
    element.check(["name"])
    return settings.UnsetEnvironmentVariable(_need(element, "name"))


def _reset(element: Element) -> Action:
    element.check([], ["keep"])
    return settings.ResetLaunchConfigurations(dict(_pairs(element.named("keep"), "name", "value")))


def _push_namespace(element: Element) -> Action:
    element.check(["namespace"])
    return settings.PushRosNamespace(_need(element, "namespace"))


def _set_parameter(element: Element) -> Action:
    element.check(["name", "value", "type"])
    value = _AttributeValue(element.need("value"), _text(element, "type"))
    return settings.SetParameter(_need(element, "name"), value)


def _set_parameters_from_file(element: Element) -> Action:
    element.check(["filename"])
    return settings.SetParametersFromFile(_FilePath(element.need("filename"), "parameter file"))


def _set_use_sim_time(element: Element) -> Action:
    element.check(["value"])
    return settings.SetUseSimTime(None)


def _set_remap(element: Element) -> Action:
    element.check(["from", "to"])
    return settings.SetRemap(_need(element, "from"), _need(element, "to"))


def _executable(element: Element) -> Action:
    element.check(["cmd", "name", "shell", *_PROCESS], ["env"])
    command, shell = _words(element, "cmd") or (), _flag(element, "shell")
    return _process(element, nodes.ExecuteProcess, cmd=command, shell=shell)


# Nodes and components.


def _node(element: Element) -> Action:
    element.check(_NODE, ["param", "remap", "env"])
    kind = nodes.Node if element.get("autostart") is None else nodes.LifecycleNode
    extra = {} if kind is nodes.Node else {"autostart": _flag(element, "autostart")}
    return _node_process(element, kind, **extra)


def _container(element: Element) -> Action:
    element.check(_NODE, ["param", "remap", "env", "composable_node"])
    return _node_process(
        element, nodes.ComposableNodeContainer, composable_node_descriptions=_components(element)
    )


def _load(element: Element) -> Action:
    element.check(["target"], ["composable_node"])
    return nodes.LoadComposableNodes(
        composable_node_descriptions=_components(element),
        target_container=_need(element, "target"),
    )


def _node_process(element: Element, kind: Callable[..., nodes.Node], **more: Any) -> Action:
    return _process(
        element,
        kind,
        executable=_need(element, "exec"),
        package=_text(element, "pkg"),
        name=_text(element, "name") or _text(element, "node-name"),
        **_node_settings(element),
        arguments=_words(element, "args"),
        ros_arguments=_words(element, "ros_args"),
        **more,
    )


def _process(element: Element, kind: Callable[..., nodes.ExecuteLocal], **more: Any) -> Action:
    process = kind(
        prefix=_text(element, "launch-prefix"),
        cwd=_text(element, "cwd"),
        env=dict(_pairs(element.named("env"), "name", "value")),
        respawn=_flag(element, "respawn"),
        respawn_delay=_number(element, "respawn_delay", 0.0),
        respawn_max_retries=_number(element, "respawn_max_retries", -1),
        **more,
    )
    if element.get("on_exit") is not None or element.get("required") is not None:
        process.ends_run = _ends_run(element)
    return process


def _ends_run(element: Element) -> Callable[[LaunchContext], bool]:
    def check(text: str) -> None:
        if text != "shutdown":
            raise ValueError("what a process can do at its end is 'shutdown'")

    on_exit, required = _text(element, "on_exit", check), _flag(element, "required")
    return lambda context: context.optional(on_exit) is not None or context.flag(required)


def _node_settings(element: Element) -> dict[str, Any]:
    """Return what nodes and components have in common."""
    return {
        "namespace": _text(element, "namespace"),
        "parameters": _parameters(element),
        "remappings": _pairs(element.named("remap"), "from", "to"),
    }


def _components(element: Element) -> list[nodes.ComposableNode]:
    components = []
    for child in element.named("composable_node"):
        child.check(_COMPONENT, ["param", "remap", "extra_arg"])
        component = nodes.ComposableNode(
            package=_need(child, "pkg"),
            plugin=_need(child, "plugin"),
            name=_text(child, "name"),
            **_node_settings(child),
            extra_arguments=[_values(child.named("extra_arg"))],
            condition=_condition(child),
        )
        component.where = _where(child)
        components.append(component)
    return components


def _parameters(element: Element) -> list[Any]:
    found: list[Any] = []
    for param in element.named("param"):
        if param.get("from") is None:
            found.append(_values([param]))
            continue
        param.check(["from", "allow_substs"])
        replaces = _flag(param, "allow_substs")
        found.append(
            ParameterFile(_FilePath(param.need("from"), "parameter file"), allow_substs=replaces)
        )
    return found


def _values(params: Iterable[Element]) -> dict[Any, Any]:
    values: dict[Any, Any] = {}
    for param in params:
        param.check(["name", "value", "type", "value-sep"], ["param"])
        name, value = _need(param, "name"), param.get("value")
        nested = param.named("param")
        if (value is None) == (not nested):
            raise param.place.error("a parameter has either a value or parameters within it")
        if value is None:
            values[name] = _values(nested)
        else:
            values[name] = _AttributeValue(value, _text(param, "type"))
    return values


ACTIONS: dict[str, Callable[[Element], Action]] = {
    "arg": _argument,
    "let": _let,
    "group": _group,
    "include": _include,
    "set_env": _set_env,
    "append_env": _append_env,
    "unset_env": _unset_env,
    "reset_env": lambda element: settings.ResetEnvironment(),
    "reset": _reset,
    "push_ros_namespace": _push_namespace,
    "push-ros-namespace": _push_namespace,
    "set_parameter": _set_parameter,
    "set_parameters_from_file": _set_parameters_from_file,
    "set_use_sim_time": _set_use_sim_time,
    "set_remap": _set_remap,
    "set_ros_log_dir": lambda element: settings.SetROSLogDir(None),
    "log": lambda element: actions.LogInfo(msg=None),
    "log_info": lambda element: actions.LogInfo(msg=None),
    "node": _node,
    "lifecycle_node": _node,
    "node_container": _container,
    "load_composable_node": _load,
    "executable": _executable,
    "timer": _timer,
    "ros_timer": _timer,
    "shutdown": lambda element: events.ShutdownAction(),
}
"""What builds the action of each tag."""
