"""The checks that the fields of a job are made of, each with the JSON Schema of what it accepts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any

from rsltrace.errors import nearest
from rsltrace.job.values.names import check_glob, check_target, dotted_target
from rsltrace.job.values.problem import JobProblem, ProblemCollector, as_flag, describe
from rsltrace.job.values.times import TIME_SCHEMA, parse_time

Check = Callable[[object, bool], object]
"""Returns the value of a field, or raises ``ValueError``: from what is given, and whether that is
read from a file."""


def attach(function: Any, **facts: object) -> Any:
    """Let a check tell the generators of schema and documentation what it accepts.

    ``schema`` is JSON Schema; ``shorthand`` (of a list's entries: ``entry_shorthand``, of a
    mapping's values: ``value_shorthand``) is the key that a plain value stands for. Returns
    ``function``.
    """
    for name, value in facts.items():
        setattr(function, name, value)
    return function


def check(function: Callable[[Any], object], *, optional: bool = False, **facts: object) -> Check:
    """Make the check of a field of ``function``, which returns the value or raises ``ValueError``.

    ``optional`` lets ``None`` through when the part is built in Python; ``attach`` explains
    ``facts``.
    """

    def validate(value: object, in_file: bool) -> object:
        if value is None and in_file:
            raise JobProblem("no value is given: give one, or leave the key out")
        return None if value is None and optional else function(value)

    return attach(validate, schema=getattr(function, "schema", None), **facts)  # type: ignore[no-any-return]


given = check(lambda value: value, optional=True)
"""Refuse null in a file for a field that is None where it is not given."""


def is_plain(value: object) -> bool:
    """Say whether a value may stand for a part: a bag's path, a topic's name, a plain time."""
    return isinstance(value, (str, int, float)) and not isinstance(value, bool)


def part(shorthand: str) -> Check:
    """Prepare one optional part; a plain value stands for ``{shorthand: value}``."""
    return check(
        lambda value: {shorthand: value} if is_plain(value) else value,
        optional=True,
        shorthand=shorthand,
    )


def parts(shorthand: str | None = None, *, optional: bool = False) -> Check:
    """Prepare a list of parts; plain text stands for ``{shorthand: text}``."""

    def entries(values: object) -> object:
        if not isinstance(values, (list, tuple)):
            hint = _as_list(values) if shorthand is not None else ""
            if isinstance(values, dict):
                hint = "; put '- ' in front of each entry"
            raise JobProblem(f"expected a list, got {describe(values)}{hint}")
        if shorthand is None:
            return tuple(values)
        return tuple({shorthand: v} if isinstance(v, str) else v for v in values)

    return check(entries, optional=optional, entry_shorthand=shorthand)


def named_parts(shorthand: str, rule: Callable[[str], None], *, what: str = "models") -> Check:
    """Prepare a mapping of names to parts; a plain value stands for
    ``{shorthand: value}``."""

    def entries(values: object) -> object:
        if not isinstance(values, dict):
            raise JobProblem(f"expected a mapping of names to {what}, got {describe(values)}")
        check_names(values, rule)
        return {
            name: {shorthand: value} if is_plain(value) else value for name, value in values.items()
        }

    names = {"pattern": rule.pattern}  # type: ignore[attr-defined]
    return check(entries, value_shorthand=shorthand, names=names)


def check_names(names: Iterable[object], rule: Callable[[str], None]) -> None:
    """Raise ``JobProblems`` with every key of a mapping that is not text that ``rule`` accepts."""
    problems = ProblemCollector()
    for name in names:
        with problems.at(str(name), at_key=True):
            text(rule)(name)
    problems.check()


def text(rule: Callable[[str], None] | None = None) -> Callable[[Any], str]:
    """Return a check for text that ``rule`` accepts."""

    def function(value: object) -> str:
        if not isinstance(value, str):
            raise JobProblem(f"expected text, got {describe(value)}")
        if rule is not None:
            rule(value)
        return str(value)

    pattern = getattr(rule, "pattern", None)
    schema = {"type": "string"} if pattern is None else {"type": "string", "pattern": pattern}
    attach(function, schema=schema)
    return function


def whole(least: int, most: int = 2**63 - 1) -> Callable[[Any], int]:
    """Return a check for an integer from ``least`` to ``most``."""

    def function(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise JobProblem(f"expected an integer, got {describe(value)}{_as_integer(value)}")
        if not least <= value <= most:
            bound = f"at least {least}" if value < least else f"at most {most}"
            raise JobProblem(f"must be {bound}, got {value}")
        return int(value)

    attach(function, schema={"type": "integer", "minimum": least, "maximum": most})
    return function


def _as_integer(value: object) -> str:
    """Say how to write what is an integer in all but form: ``1e5``, ``"7"``."""
    if isinstance(value, str):
        return "; take the quotes away" if value.strip().lstrip("+-").isdecimal() else ""
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**63:
        return f"; write {int(value)}"
    return ""


def one_of(*choices: str) -> Callable[[Any], str]:
    """Return a check for one of some words."""

    def function(value: object) -> str:
        if not isinstance(value, str) or value not in choices:
            near = nearest(str(value).lower(), choices) if len(choices) > 2 else None
            hint = f"; did you mean {near}?" if near else ""
            raise JobProblem(f"expected {' or '.join(choices)}, got {describe(value)}{hint}")
        return str(value)

    attach(function, schema={"enum": list(choices)})
    return function


def flag(value: object) -> bool:
    """Check true or false."""
    if not isinstance(value, bool):
        raise JobProblem(f"expected true or false, got {describe(value)}{as_flag(value)}")
    return value


attach(flag, schema={"type": "boolean"})


def number(least: float, most: float | None = None, *, open_below: bool = False) -> Any:
    """Return a check for a number within bounds (``open_below``: greater than ``least``)."""

    def function(value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise JobProblem(f"expected a number, got {describe(value)}{_as_number(value)}")
        low = value > least if open_below else value >= least
        if not low or (most is not None and not value <= most) or value in (float("inf"),):
            above = f"greater than {least:g}" if open_below else f"at least {least:g}"
            below = f" and at most {most:g}" if most is not None else ""
            raise JobProblem(f"must be {above}{below}, got {getattr(value, 'text', value)}")
        return float(value)

    schema: dict[str, object] = {"type": "number"}
    schema["exclusiveMinimum" if open_below else "minimum"] = least
    if most is not None:
        schema["maximum"] = most
    return attach(function, schema=schema)


def _as_number(value: object) -> str:
    """Say how to write a number that was written in another way: ``10%``, ``"0.1"``."""
    if not isinstance(value, str):
        return ""
    try:
        number = Decimal(value.strip().removesuffix("%"))
    except InvalidOperation:
        return ""
    percent = value.strip().endswith("%") and number.is_finite()
    return f"; write {number / 100:f}" if percent else "; take the quotes away"


def positive_time(value: object) -> int:
    """Check a time that must be more than nothing."""
    time_ns = parse_time(value)
    if time_ns == 0:
        raise JobProblem("must be more than 0")
    return time_ns


attach(parse_time, schema=TIME_SCHEMA)
attach(positive_time, schema=TIME_SCHEMA)


def items(function: Callable[[Any], object]) -> Callable[[Any], tuple[object, ...]]:
    """Return a check for a list whose elements ``function`` accepts; gives a tuple."""

    def check_items(values: object) -> tuple[object, ...]:
        if not isinstance(values, (list, tuple)):
            raise JobProblem(f"expected a list, got {describe(values)}{_as_list(values)}")
        checked: list[object] = []
        problems = ProblemCollector()
        for index, value in enumerate(values):
            with problems.at(index):
                checked.append(function(value))
        problems.check()
        return tuple(checked)

    schema = getattr(function, "schema", None) or {}
    return attach(check_items, schema={"type": "array", "items": schema})  # type: ignore[no-any-return]


def _as_list(value: object) -> str:
    return f"; write [{value}]" if isinstance(value, str) and value.strip() else ""


Globs = Annotated[tuple[str, ...], check(items(text(check_glob)))]


Target = str | Callable[..., object]
"""``module:attribute`` as text, or (in Python) the class or function itself."""


def target_text(target: Target) -> str:
    """Return ``module:qualname`` of a target."""
    if isinstance(target, str):
        return target
    kind = type(target)
    module = getattr(target, "__module__", kind.__module__)
    return f"{module}:{getattr(target, '__qualname__', kind.__qualname__)}"


def check_callable_target(value: object) -> Target:
    """Check a class or function, given itself, as ``module:attribute`` or as the path of a file
    in the job's folder, ``file.py:attribute``, which is read as that of its module."""
    if callable(value):
        return value
    if not isinstance(value, str):
        raise JobProblem(f"expected module:Class or module:function, got {describe(value)}")
    return text(check_target)(dotted_target(value))


attach(check_callable_target, schema={"type": "string", "pattern": check_target.pattern})  # type: ignore[attr-defined]
