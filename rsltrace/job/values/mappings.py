"""What an entry of ``nodes:`` maps to what: remappings, arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rsltrace.job.values.checks import attach, text
from rsltrace.job.values.names import check_remap_from, check_remap_to
from rsltrace.job.values.paths import FileText
from rsltrace.job.values.problem import Collected, Problem, Problems, describe
from rsltrace.job.values.times import ExactFloat


def names_to_names(
    value: object, rule_from: Callable[[str], None], rule_to: Callable[[str], None]
) -> dict[str, str]:
    """Check a mapping of names to names, each side by a rule of its own."""
    if not isinstance(value, dict):
        raise Problem(f"expected a mapping of names to names (from: to), got {describe(value)}")
    problems = Collected()
    for name, to in value.items():
        with problems.at(str(name), at_key=True):
            text(rule_from)(name)
        with problems.at(str(name)):
            text(rule_to)(to)
    problems.check()
    return {str(name): str(to) for name, to in value.items()}


def check_remappings(value: object) -> dict[str, str]:
    """Check remappings: what is written in code, and what it stands for."""
    return names_to_names(value, check_remap_from, check_remap_to)


_NAME = {"pattern": check_remap_from.pattern}  # type: ignore[attr-defined]
attach(
    check_remappings,
    schema={
        "type": "object",
        "propertyNames": _NAME,
        "additionalProperties": {"type": "string", "pattern": check_remap_to.pattern},  # type: ignore[attr-defined]
    },
)


def check_arguments(value: object) -> dict[str, Any] | tuple[str, ...]:
    """Check what an entry is given: keyword arguments, or words of a command line."""
    if isinstance(value, (list, tuple)):
        return _check_words(value)
    if not isinstance(value, dict):
        raise Problem(
            "expected a mapping of argument names to values (node:) or a list of command-line "
            f"words (main:, executable:, script:, module:), got {describe(value)}"
        )
    for name in value:
        if not isinstance(name, str) or not name.isidentifier():
            raise Problem(f"{name!r} cannot be the name of an argument", (str(name),), at_key=True)
    return {name: _plain_floats(item) for name, item in value.items()}


def _check_words(values: list[object] | tuple[object, ...]) -> tuple[str, ...]:
    """Check command-line words; a number stands for its digits, as on a command line."""
    problems = [
        Problem(f"expected a word of a command line, got {describe(value)}", (index,))
        for index, value in enumerate(values)
        if isinstance(value, bool) or not isinstance(value, (str, int, float))
    ]
    if problems:
        raise Problems(problems)
    return tuple(str(getattr(value, "text", value)) for value in values)


attach(
    check_arguments,
    schema={
        "anyOf": [
            {"type": "object"},
            {"type": "array", "items": {"type": ["string", "number"]}},
        ]
    },
)


def _plain_floats(value: object) -> object:
    # What user code gets must not carry types of ours.
    if isinstance(value, ExactFloat):
        return float(value)
    if isinstance(value, FileText):
        return str(value)
    if type(value) is dict:
        return {key: _plain_floats(item) for key, item in value.items()}
    if type(value) is list:
        return [_plain_floats(item) for item in value]
    return value
