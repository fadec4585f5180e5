"""Actions that start nodes and other programs: ``launch_ros.actions`` and ``ExecuteProcess``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rsltrace.adapters.launch.api.basics import (
    Action,
    Condition,
    LaunchContext,
    as_job_error,
    as_substitutions,
    calling_line,
)
from rsltrace.adapters.launch.api.events import later
from rsltrace.adapters.launch.api.parameters import evaluated_parameters
from rsltrace.adapters.launch.api.substitutions import names_missing_package
from rsltrace.adapters.launch.model import (
    LaunchedNode,
    ProcessSettings,
    absolute_namespace,
    full_name,
    respawning,
)

_WITHOUT_MEANING = frozenset(
    "output output_format emulate_tty exec_name log_cmd sigterm_timeout sigkill_timeout "
    "cached_output".split()
)
"""How a process is run: nothing that a node could tell in a simulation."""

_OF_PROCESSES = ("cwd", "env", "additional_env", "respawn", "respawn_delay", "respawn_max_retries")
_WITHOUT = {"prefix": "launch-prefix", "shell": "shell"}
"""What processes are not given here, and its name in a note."""

_RENAMED = {"node_executable": "executable", "node_name": "name", "node_namespace": "namespace"}


class ExecuteLocal(Action):
    """Starts another program."""

    ends_run: Callable[[LaunchContext], bool] | None = None
    """Says whether the run ends with it (``required`` and ``on_exit`` in XML and YAML)."""

    def __init__(
        self, *, condition: Condition | None = None, on_exit: Any = None, **options: Any
    ) -> None:
        super().__init__(condition=condition)
        for name in options:
            if name not in _WITHOUT_MEANING and name not in (*_OF_PROCESSES, *_WITHOUT):
                now = f"; it is {_RENAMED[name]!r} since Galactic" if name in _RENAMED else ""
                raise TypeError(f"{type(self).__name__} has no argument {name!r}{now}")
        self._on_exit = on_exit
        self._options = {name: value for name, value in options.items() if value}

    def _surroundings(self, context: LaunchContext) -> ProcessSettings:
        """Return what is said of the process."""
        options = self._options
        own = {
            context.text(name): context.text(value)
            for key in ("env", "additional_env")
            for name, value in dict(options.get(key, {})).items()
        }
        respawn = None
        if context.flag(options.get("respawn", False)):
            times = int(_number(context, options.get("respawn_max_retries", -1)))
            respawn = respawning(_number(context, options.get("respawn_delay", 0.0)), times)
        return ProcessSettings(
            tuple({**context.changed_environment(), **own}.items()),
            folder=context.optional(options.get("cwd")) or "",
            respawn=respawn,
            own=(*(f"env {name}" for name in own), *(["cwd"] if "cwd" in options else [])),
            without=tuple(said for name, said in _WITHOUT.items() if name in options),
        )

    def _started(self, context: LaunchContext) -> None:
        """Note what follows when it ends."""
        if self.ends_run is not None and self.ends_run(context):
            context.launched.required.add(id(self))
        if self._on_exit is not None:
            later(context, self.where, "ended", self, self._on_exit)


class ExecuteProcess(ExecuteLocal):
    """Starts another program."""

    def __init__(self, *, cmd: Any, name: Any = None, shell: Any = False, **options: Any) -> None:
        super().__init__(**options)
        self._shell = shell
        self.cmd = cmd if callable(cmd) else [as_substitutions(word) for word in cmd]

    def execute(self, context: LaunchContext) -> None:
        try:
            command = _words(context, self.cmd)
            if command and context.flag(self._shell):
                command = ("/bin/sh", "-c", " ".join(command))
            surroundings = self._surroundings(context)
        except Exception as error:  # whatever a substitution of the user's own raises
            given = () if callable(self.cmd) else self.cmd
            words = " ".join("".join(part.describe() for part in word) for word in given)
            why = f"its command cannot be read: {as_job_error(error, '')}"
            context.refuse(self.where, f"process {words!r:.200}" if words else "a process", why)
        else:
            note(context, self, command=command, surroundings=surroundings)
        self._started(context)


class Node(ExecuteLocal):
    """Starts an executable of a package."""

    def __init__(
        self,
        *,
        executable: Any,
        package: Any = None,
        name: Any = None,
        namespace: Any = None,
        parameters: Iterable[Any] | None = None,
        remappings: Iterable[tuple[Any, Any]] | None = None,
        ros_arguments: Any = None,
        arguments: Any = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._executable = as_substitutions(executable)
        self._package = None if package is None else as_substitutions(package)
        self._description = _NodeDescription(name, namespace, parameters, remappings)
        self._ros_arguments = ros_arguments
        self._arguments = arguments
        self._values: dict[str, Any] = {}

    def execute(self, context: LaunchContext) -> None:
        self._note(context)

    def _note(self, context: LaunchContext, *, is_container: bool = False) -> None:
        executable = context.text(self._executable)
        package = context.optional(self._package)
        if package is None:
            context.refuse(self.where, f"process {executable!r}", "it belongs to no package")
            return
        values = self._values or self._description.values(context, self.where)
        if not self._values and not values.get("fault"):
            try:
                values["arguments"] = _words(context, self._arguments)
                values["ros_arguments"] = _words(context, self._ros_arguments)
                values["surroundings"] = self._surroundings(context)
                _check_paths([*values["arguments"], *values["ros_arguments"]])
            except Exception as error:
                values["fault"] = str(as_job_error(error, self.where))
        self._values = values  # should it be started again
        note(
            context,
            self,
            package=package,
            executable=executable,
            is_container=is_container,
            **values,
        )
        self._started(context)


class LifecycleNode(Node):
    """Starts a lifecycle node."""

    def __init__(
        self, *, name: Any, namespace: Any, autostart: Any = False, **options: Any
    ) -> None:
        super().__init__(name=name, namespace=namespace, **options)
        self._autostart = autostart

    def execute(self, context: LaunchContext) -> None:
        super().execute(context)
        if self._package is not None and context.flag(self._autostart):
            context.refuse(
                self.where,
                f"autostart of {context.optional(self._package)}/{context.text(self._executable)}",
                "nobody changes the states of lifecycle nodes here: let a node of the job do it",
            )


class _NodeDescription:
    """What nodes and components have in common."""

    def __init__(
        self,
        name: Any,
        namespace: Any,
        parameters: Iterable[Any] | None,
        remappings: Iterable[tuple[Any, Any]] | None,
    ) -> None:
        self.name, self.namespace = name, namespace
        self.parameters: Any = () if parameters is None else parameters
        self.remappings = [(src, dst) for src, dst in remappings or ()]

    def values(self, context: LaunchContext, where: str) -> dict[str, Any]:
        """Return the fields of a ``LaunchedNode``.

        What cannot be evaluated is a fault of the node only: it may be one that is left out.
        """
        scope = context.scope
        name = context.optional(self.name) or None
        namespace = absolute_namespace(scope.namespace, context.optional(self.namespace))
        whole = None if name is None else full_name(namespace, name)
        values: dict[str, Any] = {"name": name, "namespace": namespace}
        try:
            given = tuple(evaluated_parameters(context, self.parameters, whole))
            values["parameters"] = scope.parameters + given
            for item in given:
                _check_paths(item.values() if isinstance(item, dict) else ())
            pairs = tuple((context.text(src), context.text(dst)) for src, dst in self.remappings)
            values["remappings"] = scope.remappings + pairs
        except Exception as error:
            values["fault"] = str(as_job_error(error, where))
        return values


def _check_paths(values: Iterable[object]) -> None:
    """Raise ``ValueError`` if a node would be given a path in a package that is not there."""
    for value in values:
        package = names_missing_package(value)
        if package is not None:
            raise ValueError(f"there is no package {package!r}, which it needs a file of: {value}")


def note(context: LaunchContext, action: object, **values: Any) -> None:
    """Note a node that ``action`` starts."""
    values.setdefault("where", getattr(action, "where", ""))
    context.launched.nodes.append(
        LaunchedNode(**values, delay_ns=context.delay_ns, after=context.after, number=id(action))
    )
    context.kept.append(action)  # so that no other gets its id


class ComposableNode:
    """A component."""

    def __init__(
        self,
        *,
        package: Any,
        plugin: Any,
        name: Any = None,
        namespace: Any = None,
        parameters: Iterable[Any] | None = None,
        remappings: Iterable[tuple[Any, Any]] | None = None,
        extra_arguments: Iterable[Any] | None = None,
        condition: Condition | None = None,
    ) -> None:
        self.where = calling_line()
        self._package, self._plugin = as_substitutions(package), as_substitutions(plugin)
        self._condition = condition
        self._description = _NodeDescription(name, namespace, parameters, remappings)
        self._extra_arguments = list(extra_arguments or ())

    def note(self, context: LaunchContext, container: str) -> None:
        """Note it, if its condition holds; ``container`` is the full name of the one it is for."""
        if self._condition is not None and not self._condition.evaluate(context):
            return
        values = self._description.values(context, self.where)
        try:
            extra = tuple(evaluated_parameters(context, self._extra_arguments, None))
        except Exception as error:
            extra = ()
            values["fault"] = str(as_job_error(error, self.where))
        note(
            context,
            self,
            package=context.text(self._package),
            plugin=context.text(self._plugin),
            container=container,
            extra_arguments=extra,
            **values,
        )


class ComposableNodeContainer(Node):
    """Starts a container, and has it load components."""

    def __init__(
        self,
        *,
        name: Any,
        namespace: Any,
        composable_node_descriptions: Sequence[ComposableNode] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(name=name, namespace=namespace, **options)
        self._components = list(composable_node_descriptions or ())

    def execute(self, context: LaunchContext) -> None:
        self._note(context, is_container=True)
        for component in self._components:
            component.note(context, self.full_name(context))

    def full_name(self, context: LaunchContext) -> str:
        values = self._values or self._description.values(context, self.where)
        return full_name(values["namespace"], values["name"] or "")


class LoadComposableNodes(Action):
    """Has a container load components."""

    def __init__(
        self,
        *,
        composable_node_descriptions: Sequence[ComposableNode],
        target_container: Any,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._components = list(composable_node_descriptions)
        self._target = target_container

    def execute(self, context: LaunchContext) -> None:
        target = self._target
        if isinstance(target, ComposableNodeContainer):
            container = target.full_name(context)
        else:
            container = full_name(None, context.text(target))
        for component in self._components:
            component.note(context, container)


def _words(context: LaunchContext, given: Any) -> tuple[str, ...]:
    """Return the words of a command line: of a sequence, or what makes them of the context."""
    return tuple(given(context) if callable(given) else map(context.text, given or ()))


def _number(context: LaunchContext, value: Any) -> float:
    return float(value if isinstance(value, (int, float)) else context.text(value))
