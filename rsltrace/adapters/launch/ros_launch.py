"""Launch files evaluated by ROS's own ``launch`` and ``launch_ros``, without starting anything.

The description is visited as a launch service would, so arguments, conditions, groups, includes,
opaque functions and substitutions mean what they mean there. Where a process would be started, what
it would be started with is noted instead.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.api.parameters import parameters_for
from rsltrace.adapters.launch.model import (
    ENVIRONMENT,
    LaunchArgument,
    LaunchedNode,
    LaunchResult,
    ParameterFilePath,
    Parameters,
    ProcessSettings,
    UnsupportedItem,
    argument_words,
    full_name,
    respawning,
    yaml_value,
)
from rsltrace.errors import JobError
from rsltrace.job.values.times import parse_time

_NOT_IN_A_RUN = "a run has all its nodes from the start, and ends by the job's stop: conditions"
_FRONT_ENDS = {".xml": "launch_xml", ".yaml": "launch_yaml", ".yml": "launch_yaml"}


def can_read(path: Path) -> bool:
    """Return whether ROS's launch is installed, with what this kind of launch file needs."""
    needed = ["launch", "launch_ros", _FRONT_ENDS.get(path.suffix, "launch")]
    return all(find_spec(name) is not None for name in needed)


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> LaunchResult:
    """Return what a launch file would start, given ``name:=value`` arguments.

    :raises JobError: with what launch says is wrong.
    """
    from launch import LaunchContext
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import AnyLaunchDescriptionSource

    words = argument_words(arguments)
    with _own_environment(["ros2", "launch", str(path), *words]):
        context = LaunchContext(argv=words)
        context.launch_configurations.update(arguments)
        visitor = _LaunchVisitor(context, path)
        try:
            source = AnyLaunchDescriptionSource(str(path))
            given = list(arguments.items())
            visitor.visit(IncludeLaunchDescription(source, launch_arguments=given))
            visitor.finish()
        except JobError:
            raise
        except Exception as error:
            raise JobError(f"{type(error).__name__}: {error}", where=visitor.where()) from error
        finally:
            visitor.clean()
    return visitor.launched


@contextmanager
def _own_environment(argv: list[str]) -> Iterator[None]:
    """Give Python launch files their command line; take back what they do to the environment."""
    saved, before = dict(os.environ), sys.argv
    sys.argv = argv
    try:
        yield
    finally:
        sys.argv = before
        os.environ.clear()
        os.environ.update(saved)


class _LaunchVisitor:
    def __init__(self, context: Any, path: Path) -> None:
        self.launched = LaunchResult()
        self._context = context
        self._environment = dict(os.environ)
        self._path = path
        self._delay_ns = 0
        self._after: tuple[str, int] | None = None
        self._later: list[tuple[tuple[str, int], list[Any]]] = []
        self._scratch: set[str] = set()
        self._kept: list[Any] = []  # so that no other gets an id that is somebody's number

    def clean(self) -> None:
        """Remove the files that launch has written: nodes may share one."""
        for file in self._scratch:
            Path(file).unlink(missing_ok=True)

    def finish(self) -> None:
        """Do what event handlers bring, after everything else: as they would."""
        while self._later:
            self._after, actions = self._later.pop(0)
            for action in actions:
                self.visit(action)

    def where(self) -> str:
        """Return the launch file that is being evaluated: launch keeps no lines."""
        return str(self._context.get_locals_as_dict().get("current_launch_file_path", self._path))

    def visit(self, entity: Any) -> None:
        """Do what an entity does, and its sub-entities, except for starting processes."""
        from launch import Action
        from launch.actions import (
            AppendEnvironmentVariable,
            DeclareLaunchArgument,
            SetEnvironmentVariable,
            UnsetEnvironmentVariable,
        )

        if isinstance(entity, Action):
            if entity.condition is not None and not entity.condition.evaluate(self._context):
                return
            if self._is_noted(entity):
                return
            if isinstance(entity, DeclareLaunchArgument):
                self._declare(entity)
            elif isinstance(
                entity,
                (SetEnvironmentVariable, AppendEnvironmentVariable, UnsetEnvironmentVariable),
            ):
                name = self._text(entity.name)
                self.launched.ignored.append(ENVIRONMENT.format(where=self.where(), name=name))
        for inner in entity.visit(self._context) or ():
            self.visit(inner)

    def _is_noted(self, action: Any) -> bool:
        """Note a node or what cannot be simulated; return whether it was one of these."""
        from launch import actions
        from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node, RosTimer

        if isinstance(action, ComposableNodeContainer):
            self._node(action, is_container=True)
            container = full_name(None, action.node_name)
            descriptions = getattr(action, f"_ComposableNodeContainer{_DESCRIPTIONS}")
            self._components(descriptions or (), container)
        elif isinstance(action, LoadComposableNodes):
            target = action._LoadComposableNodes__target_container
            is_action = isinstance(target, ComposableNodeContainer)
            container = full_name(None, target.node_name if is_action else self._text(target))
            descriptions = getattr(action, f"_LoadComposableNodes{_DESCRIPTIONS}")
            self._components(descriptions or (), container)
        elif isinstance(action, Node):
            self._node(action)
        elif isinstance(action, actions.ExecuteLocal):
            self._program(action)
        elif isinstance(action, (actions.TimerAction, RosTimer)):
            self._timer(action)
        elif isinstance(action, actions.RegisterEventHandler):
            self._handler(action.event_handler)
        elif isinstance(action, actions.EmitEvent):
            is_end = isinstance(action, actions.Shutdown) and self._after is not None
            if is_end and self._after[0] == "ended" and not self._delay_ns:  # type: ignore[index]
                self.launched.required.add(self._after[1])  # type: ignore[index]
            elif is_end:
                self.launched.ignored.append(f"{self.where()}: shutdown: {_NOT_IN_A_RUN}")
            else:
                self._refuse(type(action).__name__, _NOT_IN_A_RUN)
        elif isinstance(action, actions.OpaqueCoroutine):
            self._refuse("OpaqueCoroutine", "it runs beside processes, which there are none of")
        else:
            return False
        return True

    def _timer(self, timer: Any) -> None:
        from launch.utilities.type_utils import perform_typed_substitution

        seconds = perform_typed_substitution(self._context, timer.period, float)
        delay_ns = parse_time(float(seconds))
        self._delay_ns += delay_ns
        for action in timer.actions:
            self.visit(action)
        self._delay_ns -= delay_ns

    def _handler(self, handler: Any) -> None:
        from launch import Action
        from launch.event_handlers import (
            OnExecutionComplete,
            OnProcessExit,
            OnProcessStart,
            OnShutdown,
        )

        name = type(handler).__name__
        if isinstance(handler, OnShutdown):
            self.launched.ignored.append(f"{self.where()}: {name}: nothing starts after a run")
            return
        if isinstance(handler, (OnExecutionComplete, OnProcessExit, OnProcessStart)):
            target = getattr(handler, "_OnActionEventBase__action_matcher", None)
            actions = getattr(handler, "_OnActionEventBase__actions_on_event", None)
            if isinstance(target, Action) and actions:
                moment = "started" if isinstance(handler, OnProcessStart) else "ended"
                self._kept.append(target)
                self._later.append(((moment, id(target)), list(actions)))
                return
        self._refuse(name, "it is not for one process, or calls a function with the event")

    def _refuse(self, what: str, why: str) -> None:
        self.launched.unsupported.append(UnsupportedItem(self.where(), what, why))

    def _declare(self, action: Any) -> None:
        default = action.default_value
        text = None if default is None else "".join(part.describe() for part in default)
        argument = LaunchArgument(action.name, text, action.description or "")
        self.launched.arguments.setdefault(action.name, argument)

    # -- nodes -------------------------------------------------------------------------------------

    def _node(self, node: Any, *, is_container: bool = False) -> None:
        package = self._optional(node.node_package)
        executable = self._text(node.node_executable)
        if package is None:
            self._refuse(f"process {executable!r}", "it belongs to no package")
            return
        earlier = next((one for one in self.launched.nodes if one.number == id(node)), None)
        if earlier is not None:  # it is what it was when it was first made
            again = replace(earlier, delay_ns=self._delay_ns, after=self._after)
            self.launched.nodes.append(again)
            return
        node._perform_substitutions(self._context)
        name = node._Node__expanded_node_name
        own_name = None if name == node.UNSPECIFIED_NODE_NAME else name.lstrip("/")
        namespace = node.expanded_node_namespace
        own_namespace = None if namespace == node.UNSPECIFIED_NODE_NAMESPACE else namespace
        if getattr(node, "_LifecycleNode__autostart", False):
            self._refuse(
                f"autostart of {package}/{executable}",
                "nobody changes the states of lifecycle nodes here: let a node of the job do it",
            )
        self._keep(node)
        self.launched.nodes.append(
            LaunchedNode(
                surroundings=self._surroundings(node),
                is_container=is_container,
                where=self.where(),
                delay_ns=self._delay_ns,
                after=self._after,
                number=id(node),
                package=package,
                executable=executable,
                name=own_name,
                namespace=own_namespace or None,
                parameters=self._parameters(node, own_name, own_namespace),
                remappings=tuple((a, b) for a, b in node.expanded_remapping_rules or ()),
                arguments=self._words(node._Node__arguments),
                ros_arguments=self._words(node._Node__ros_arguments),
            )
        )

    def _program(self, action: Any) -> None:
        self._keep(action)
        words = self._words(getattr(action, "cmd", None))
        self.launched.nodes.append(
            LaunchedNode(
                self.where(),
                command=("/bin/sh", "-c", " ".join(words)) if action.shell else words,
                surroundings=self._surroundings(action),
                delay_ns=self._delay_ns,
                after=self._after,
                number=id(action),
            )
        )

    def _keep(self, action: Any) -> None:
        """Keep an action, and what follows when its process ends."""
        self._kept.append(action)
        on_exit = getattr(action, "_ExecuteLocal__on_exit", None)
        if on_exit and not callable(on_exit):
            listed = on_exit if isinstance(on_exit, (list, tuple)) else [on_exit]
            self._later.append((("ended", id(action)), list(listed)))

    def _surroundings(self, node: Any) -> ProcessSettings:
        process = node.process_description
        own: dict[str, str] = {}
        for pairs in (process.env, process.additional_env):
            own |= {self._text(name): self._text(value) for name, value in pairs or ()}
        now, found = self._context.environment, self._environment
        changed = {name: value for name, value in now.items() if found.get(name) != value}
        respawn = None
        if self._typed(getattr(node, "_ExecuteLocal__respawn", False), bool):
            delay_s = float(getattr(node, "_ExecuteLocal__respawn_delay", None) or 0.0)
            times = getattr(node, "_ExecuteLocal__respawn_max_retries", -1)
            respawn = respawning(delay_s, int(times))
        prefix = self._text(process.prefix) if process.prefix is not None else ""
        return ProcessSettings(
            tuple({**changed, **own}.items()),
            folder=self._optional(process.cwd) or "",
            respawn=respawn,
            own=(*(f"env {name}" for name in own), *(("cwd",) if process.cwd else ())),
            without=("launch-prefix",) if prefix else (),
        )

    def _typed(self, value: Any, kind: type) -> Any:
        from launch.utilities.type_utils import perform_typed_substitution

        return perform_typed_substitution(self._context, value, kind)

    def _words(self, words: Any) -> tuple[str, ...]:
        return tuple(self._text(word) for word in words or ())

    def _parameters(self, node: Any, name: str | None, namespace: str | None) -> Parameters:
        whole = None if name is None else full_name(namespace, name)
        found: list[ParameterFilePath | dict[str, Any]] = []
        shared = self._context.launch_configurations.get("global_params") or ()
        found += [{item[0]: item[1]} for item in shared if isinstance(item, tuple)]
        for text, is_file in node._Node__expanded_parameter_arguments or ():
            if not is_file:
                key, _, value = text.partition(":=")
                found.append({key: yaml_value(value)})
            elif Path(text).parent == Path(tempfile.gettempdir()):
                # What was given as values, launch has written to a file of its own.
                found.append(parameters_for(text, whole))
                self._scratch.add(text)
            else:
                found.append(ParameterFilePath(text))
        return tuple(found)

    def _components(self, descriptions: Any, container: str) -> None:
        for description in descriptions:
            condition = description.condition()
            if condition is None or condition.evaluate(self._context):
                self._component(description, container)

    def _component(self, description: Any, container: str) -> None:
        from launch_ros.utilities import make_namespace_absolute, prefix_namespace

        configurations = self._context.launch_configurations
        namespace = make_namespace_absolute(
            prefix_namespace(
                configurations.get("ros_namespace"), self._optional(description.node_namespace)
            )
        )
        remappings = list(configurations.get("ros_remaps") or ())
        remappings += [(self._text(a), self._text(b)) for a, b in description.remappings or ()]
        self.launched.nodes.append(
            LaunchedNode(
                where=self.where(),
                delay_ns=self._delay_ns,
                after=self._after,
                package=self._text(description.package),
                plugin=self._text(description.node_plugin),
                name=self._optional(description.node_name),
                namespace=namespace or None,
                container=container,
                parameters=self._component_parameters(description),
                extra_arguments=self._evaluated(description.extra_arguments),
                remappings=tuple(remappings),
            )
        )

    def _component_parameters(self, description: Any) -> Parameters:
        found: list[ParameterFilePath | dict[str, Any]] = []
        for item in self._context.launch_configurations.get("global_params") or ():
            if isinstance(item, tuple):
                found.append({item[0]: item[1]})
            else:
                found.append(ParameterFilePath(os.path.abspath(item)))
        return (*found, *self._evaluated(description.parameters))

    def _evaluated(self, parameters: Any) -> Parameters:
        from launch_ros.utilities import evaluate_parameters

        found: list[ParameterFilePath | dict[str, Any]] = []
        for given in evaluate_parameters(self._context, parameters or ()):
            if isinstance(given, dict):
                found.append({str(name): _plain(value) for name, value in given.items()})
            elif isinstance(given, Path):
                found.append(ParameterFilePath(str(given)))
            else:
                name, value = given.evaluate(self._context)
                found.append({name: _plain(value)})
        return tuple(found)

    def _text(self, substitutions: Any) -> str:
        from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

        listed = normalize_to_list_of_substitutions(substitutions)
        return str(perform_substitutions(self._context, listed))

    def _optional(self, substitutions: Any) -> str | None:
        return None if substitutions is None else self._text(substitutions)


_DESCRIPTIONS = "__composable_node_descriptions"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
