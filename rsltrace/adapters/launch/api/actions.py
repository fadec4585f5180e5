"""Actions that bring others: includes, functions, timers."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterable, Mapping
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from rsltrace.adapters.launch.api.basics import (
    Action,
    Condition,
    LaunchContext,
    LaunchDescription,
    Substitution,
    as_substitutions,
    missing_package,
    visit_all,
)
from rsltrace.adapters.launch.model import truth
from rsltrace.errors import JobError
from rsltrace.job.values.times import parse_time

# ``launch.launch_description_sources``: where an included launch file is.


class LaunchDescriptionSource:
    """A launch description that is there, or the place of a launch file."""

    def __init__(
        self,
        launch_description: LaunchDescription | None = None,
        location: Any = "<script>",
        method: str = "unspecified mechanism from a script",
    ) -> None:
        self.description = launch_description
        self.place = location

    @property
    def location(self) -> str:
        """The place, as far as it is known before the launch file is read."""
        place = self.place
        if isinstance(place, Substitution):
            return place.describe()
        parts = [place] if isinstance(place, str) or not hasattr(place, "__iter__") else place
        return "".join(p.describe() if isinstance(p, Substitution) else str(p) for p in parts)


class AnyLaunchDescriptionSource(LaunchDescriptionSource):
    """A launch file of any kind."""

    def __init__(self, launch_file_path: Any) -> None:
        super().__init__(location=launch_file_path)


class PythonLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in Python."""


class FrontendLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in XML or YAML."""


class XMLLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in XML."""


class YAMLLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in YAML."""


def load_python_launch_file_as_module(python_launch_file_path: str) -> ModuleType:
    """Run a launch file and return it as a module."""
    loader = SourceFileLoader("python_launch_file", python_launch_file_path)
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def get_launch_description_from_python_launch_file(
    python_launch_file_path: str,
) -> LaunchDescription:
    """Return what a launch file describes.

    :raises ValueError: if it has no ``generate_launch_description``.
    """
    module = load_python_launch_file_as_module(python_launch_file_path)
    if not hasattr(module, "generate_launch_description"):
        raise ValueError("there is no function generate_launch_description() in the launch file")
    found: LaunchDescription = module.generate_launch_description()
    return found


# ``launch.conditions``.


class IfCondition(Condition):
    """Holds if a text is true."""

    def __init__(self, predicate_expression: Any) -> None:
        expression = as_substitutions(predicate_expression)
        super().__init__(predicate=lambda context: truth(context.text(expression)))


class UnlessCondition(IfCondition):
    """Holds if a text is false."""

    def evaluate(self, context: LaunchContext) -> bool:
        return not super().evaluate(context)


class LaunchConfigurationEquals(Condition):
    """Holds if a launch argument has a value; None: if there is no such argument."""

    def __init__(self, launch_configuration_name: str, expected_value: Any) -> None:
        super().__init__()
        self._name, self._expected = launch_configuration_name, expected_value

    def evaluate(self, context: LaunchContext) -> bool:
        value = context.launch_configurations.get(self._name)
        return value == context.optional(self._expected)


class LaunchConfigurationNotEquals(LaunchConfigurationEquals):
    """Holds if a launch argument has another value."""

    def evaluate(self, context: LaunchContext) -> bool:
        return not super().evaluate(context)


class IncludeLaunchDescription(Action):
    """Does what another launch file says."""

    def __init__(
        self,
        launch_description_source: Any,
        *,
        launch_arguments: Iterable[tuple[Any, Any]] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        source = launch_description_source
        if not isinstance(source, LaunchDescriptionSource):
            source = LaunchDescriptionSource(location=source)
        self.launch_description_source = source
        given = launch_arguments or ()
        self.launch_arguments = list(given.items() if isinstance(given, Mapping) else given)

    def execute(self, context: LaunchContext) -> Any:
        """Read the file, whose path does not depend on the arguments, and set these."""
        source = self.launch_description_source
        path = Path() if source.description is not None else Path(context.text(source.place))
        for name, value in self.launch_arguments:
            context.launch_configurations[context.text(name)] = context.text(value)
        if source.description is not None:
            return [source.description]
        if not path.is_absolute():
            path = Path(os.path.abspath(path))
        package = missing_package(path)
        if package is not None:
            why = f"there is no package {package!r}: it is neither installed nor among the sources"
            context.refuse(self.where, f"include of {path.name}", f"{why} here")
            return None
        if not path.is_file():
            raise JobError(f"there is no launch file {path}")
        if context.include is None:
            raise JobError("nothing can be included here")
        try:
            context.include(path)
        except MissingModuleError as error:
            context.refuse(self.where, f"include of {path.name}", str(error))
        return None


class MissingModuleError(JobError):
    """A launch file imports a Python module that is not installed."""


class OpaqueFunction(Action):
    """Does what a function returns."""

    def __init__(
        self,
        *,
        function: Callable[..., Any],
        args: Iterable[Any] | None = None,
        kwargs: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._function, self._args = function, list(args or ())
        self._kwargs = dict(kwargs or {})

    def execute(self, context: LaunchContext) -> Any:
        return self._function(context, *self._args, **self._kwargs)


class OpaqueCoroutine(Action):
    """Awaits a coroutine beside the processes."""

    def __init__(self, *, coroutine: Any = None, **options: Any) -> None:
        super().__init__(condition=options.get("condition"))

    def execute(self, context: LaunchContext) -> None:
        why = "it runs beside processes, which there are none of"
        context.refuse(self.where, "OpaqueCoroutine", why)


class TimerAction(Action):
    """Does actions some time later."""

    def __init__(self, *, period: Any, actions: Iterable[Any], **options: Any) -> None:
        options.pop("cancel_on_shutdown", None)
        super().__init__(**options)
        self._period = str(period) if isinstance(period, (int, float)) else period
        self._actions = list(actions)

    def inside(self) -> Iterable[Any]:
        return self._actions

    def execute(self, context: LaunchContext) -> None:
        """Do the actions; their nodes start that much later."""
        delay_ns = period_ns(context.text(as_substitutions(self._period)))
        context.delay_ns += delay_ns
        try:
            with context.within(scope=context.scope.copy()):
                visit_all(context, self._actions)
        finally:
            context.delay_ns -= delay_ns


def period_ns(text: str) -> int:
    """Return the period of a timer. Raises ``ValueError`` if it is none."""
    try:
        return parse_time(float(text))
    except ValueError:
        raise ValueError(f"the period of a timer is a number of seconds, not {text!r}") from None


class LogInfo(Action):
    """Says something to whoever launches; that is nobody here."""

    def __init__(self, *, msg: Any, **options: Any) -> None:
        super().__init__(condition=options.get("condition"))
        self.msg = msg

    def execute(self, context: LaunchContext) -> None:
        """Do nothing."""
