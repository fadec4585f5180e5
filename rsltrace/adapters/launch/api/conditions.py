"""``launch.conditions``."""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.launch.api.basics import Condition, LaunchContext, as_substitutions
from rsltrace.adapters.launch.substitution import truth


class IfCondition(Condition):
    """Holds if a text is true."""

    def __init__(self, predicate_expression: Any) -> None:
        expression = as_substitutions(predicate_expression)
        super().__init__(predicate=lambda context: truth(context.text(expression)))


class UnlessCondition(IfCondition):
    """Holds if a text is false."""

    def evaluate(self, context: LaunchContext) -> bool:
        """Return whether it is false."""
        return not super().evaluate(context)


class LaunchConfigurationEquals(Condition):
    """Holds if a launch argument has a value; None: if there is no such argument."""

    def __init__(self, launch_configuration_name: str, expected_value: Any) -> None:
        super().__init__()
        self._name, self._expected = launch_configuration_name, expected_value

    def evaluate(self, context: LaunchContext) -> bool:
        """Return whether it has."""
        value = context.launch_configurations.get(self._name)
        return value == context.optional(self._expected)


class LaunchConfigurationNotEquals(LaunchConfigurationEquals):
    """Holds if a launch argument has another value."""

    def evaluate(self, context: LaunchContext) -> bool:
        """Return whether it has."""
        return not super().evaluate(context)


__all__ = [
    "IfCondition",
    "LaunchConfigurationEquals",
    "LaunchConfigurationNotEquals",
    "UnlessCondition",
]
