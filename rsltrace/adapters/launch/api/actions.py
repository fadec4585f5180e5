"""Actions that bring others: includes, functions, timers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.api.basics import (
    Action,
    Condition,
    LaunchContext,
    as_substitutions,
    missing_package,
    visit_all,
)
from rsltrace.adapters.launch.api.description_sources import LaunchDescriptionSource
from rsltrace.adapters.launch.model import truth
from rsltrace.errors import JobError
from rsltrace.job.values.times import parse_time

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
