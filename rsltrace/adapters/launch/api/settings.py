"""Actions that change what the rest of a launch file sees: arguments, environment, ROS defaults."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from rsltrace.adapters.launch.api.basics import Action, LaunchContext, as_substitutions, visit_all
from rsltrace.adapters.launch.api.parameters import ParameterFile, plain_value
from rsltrace.adapters.launch.model import (
    ENVIRONMENT,
    LaunchArgument,
    LaunchScope,
    joined_namespace,
)
from rsltrace.errors import JobError, nearest


class DeclareLaunchArgument(Action):
    """Declares a launch argument."""

    def __init__(
        self,
        name: str,
        *,
        default_value: Any = None,
        description: str | None = None,
        choices: Iterable[str] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.name = name
        self.default_value = None if default_value is None else as_substitutions(default_value)
        self.description = description or "no description given"
        self.choices = None if choices is None else list(choices)
        text = default_value and "".join(part.describe() for part in self.default_value or ())
        default = None if default_value is None else text or ""
        self.argument = LaunchArgument(name, default, (description or "").strip())

    def execute(self, context: LaunchContext) -> None:
        """Give it its default if it has no value, and check the value."""
        context.launched.arguments.setdefault(self.name, self.argument)
        configurations = context.launch_configurations
        if self.name not in configurations:
            if self.default_value is None:
                about = self.argument.description
                raise JobError(
                    f"the launch argument {self.name!r}{f' ({about})' if about else ''} is "
                    f"required: give {self.name}:=…{_similar(context, self.name)}"
                )
            configurations[self.name] = context.text(self.default_value)
        if self.choices is not None and configurations[self.name] not in self.choices:
            raise JobError(
                f"the launch argument {self.name!r} is {configurations[self.name]!r}, which is "
                f"none of {', '.join(map(repr, self.choices))}"
            )


def _similar(context: LaunchContext, name: str) -> str:
    """Return the hint that an argument may be misspelt: one like it is given, but not declared."""
    declared = context.launched.arguments
    near = nearest(name, [one for one in context.launch_configurations if one not in declared])
    return f" (there is a {near!r})" if near else ""


class SetLaunchConfiguration(Action):
    """Gives a launch argument a value."""

    def __init__(self, name: Any, value: Any, **options: Any) -> None:
        super().__init__(**options)
        self._name, self._value = as_substitutions(name), as_substitutions(value)

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations[context.text(self._name)] = context.text(self._value)


class UnsetLaunchConfiguration(Action):
    """Takes away a launch argument."""

    def __init__(self, name: Any, **options: Any) -> None:
        super().__init__(**options)
        self._name = as_substitutions(name)

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations.pop(context.text(self._name), None)


class ResetLaunchConfigurations(Action):
    """Takes away all launch arguments but those that are given here."""

    def __init__(self, launch_configurations: dict[Any, Any] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self._kept = dict(launch_configurations or {})

    def execute(self, context: LaunchContext) -> None:
        """Set what is given, and nothing else."""
        kept = {context.text(name): context.text(value) for name, value in self._kept.items()}
        context.launch_configurations.clear()
        context.launch_configurations.update(kept)


class _EnvironmentAction(Action):
    """Changes the environment that the launch file sees."""

    def __init__(self, name: Any, **options: Any) -> None:
        super().__init__(**options)
        self.name = as_substitutions(name)

    def _note(self, context: LaunchContext) -> str:
        name = context.text(self.name)
        context.launched.ignored.append(ENVIRONMENT.format(where=self.where, name=name))
        return name


class SetEnvironmentVariable(_EnvironmentAction):
    """Sets an environment variable."""

    def __init__(self, name: Any, value: Any, **options: Any) -> None:
        super().__init__(name, **options)
        self.value = as_substitutions(value)

    def execute(self, context: LaunchContext) -> None:
        context.environment[self._note(context)] = context.text(self.value)


class AppendEnvironmentVariable(_EnvironmentAction):
    """Makes an environment variable longer."""

    def __init__(
        self,
        name: Any,
        value: Any,
        *,
        prepend: Any = False,
        separator: Any = os.pathsep,
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self.value, self.prepend, self.separator = as_substitutions(value), prepend, separator

    def execute(self, context: LaunchContext) -> None:
        name = self._note(context)
        parts = [context.text(self.value)]
        if name in context.environment:
            parts.insert(0, context.environment[name])
        if context.flag(self.prepend):
            parts.reverse()
        context.environment[name] = context.text(self.separator).join(parts)


class UnsetEnvironmentVariable(_EnvironmentAction):
    """Takes away an environment variable."""

    def execute(self, context: LaunchContext) -> None:
        context.environment.pop(self._note(context), None)


class ResetEnvironment(Action):
    """Restores the environment that the launch file found."""

    def execute(self, context: LaunchContext) -> None:
        context.environment.clear()
        context.environment.update(context.first_environment)


class GroupAction(Action):
    """Actions in a scope of their own."""

    def __init__(
        self,
        actions: Iterable[Any],
        *,
        scoped: Any = True,
        forwarding: Any = True,
        launch_configurations: dict[Any, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._actions = list(actions)
        self._scoped, self._forwarding = scoped, forwarding
        self._kept = dict(launch_configurations or {})

    def inside(self) -> Iterable[Any]:
        return self._actions

    def execute(self, context: LaunchContext) -> Any:
        """Do the actions; what they set ends with them if it is ``scoped``."""
        kept = {context.text(name): context.text(value) for name, value in self._kept.items()}
        if not context.flag(self._scoped):
            context.launch_configurations.update(kept)
            return self._actions
        scope = context.scope.copy()
        if not context.flag(self._forwarding):
            scope = LaunchScope(environment=dict(context.first_environment))
        scope.configurations.update(kept)
        with context.within(scope=scope):
            visit_all(context, self._actions)
        return None


class PushRosNamespace(Action):
    """Puts the nodes after it into a namespace."""

    def __init__(self, namespace: Any, **options: Any) -> None:
        super().__init__(**options)
        self._namespace = as_substitutions(namespace)

    def execute(self, context: LaunchContext) -> None:
        scope = context.scope
        scope.namespace = joined_namespace(scope.namespace, context.text(self._namespace)) or "/"


class SetParameter(Action):
    """Gives all nodes after it a parameter."""

    def __init__(self, name: Any, value: Any, **options: Any) -> None:
        super().__init__(**options)
        self._name, self._value = as_substitutions(name), value

    def execute(self, context: LaunchContext) -> None:
        value = plain_value(context, self._value, "SetParameter")
        context.scope.parameters += ({context.text(self._name): value},)


class SetUseSimTime(Action):
    """Has no meaning here: a run has no clock but the simulated one."""

    def __init__(self, value: Any, **options: Any) -> None:
        super().__init__(**options)

    def execute(self, context: LaunchContext) -> None:
        """Do nothing."""


class SetParametersFromFile(Action):
    """Gives all nodes after it the parameters of a file."""

    def __init__(
        self, filename: Any, *, node_name: Any = None, allow_substs: Any = False, **options: Any
    ) -> None:
        super().__init__(**options)
        self._file = ParameterFile(filename, allow_substs=allow_substs)

    def execute(self, context: LaunchContext) -> None:
        context.scope.parameters += (self._file.found(context, None),)


class SetRemap(Action):
    """Remaps a name for all nodes after it."""

    def __init__(self, src: Any, dst: Any, **options: Any) -> None:
        super().__init__(**options)
        self._src, self._dst = as_substitutions(src), as_substitutions(dst)

    def execute(self, context: LaunchContext) -> None:
        pair = (context.text(self._src), context.text(self._dst))
        context.scope.remappings += (pair,)


class SetROSLogDir(Action):
    """Has no meaning here: a simulation writes no log files."""

    def __init__(self, new_log_dir: Any, **options: Any) -> None:
        super().__init__(**options)

    def execute(self, context: LaunchContext) -> None:
        """Do nothing."""
