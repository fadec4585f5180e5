"""What all parts of a job share: strict frozen models, and the checks their fields are made of.

A part is built in two ways. From a job file, keys are the YAML names and nothing may be null. From
Python, ``None`` means "not given" and a time may also be given in nanoseconds under its field's
name (``duration_ns=``). The pydantic context tells the two apart.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from rsltrace.errors import JobError
from rsltrace.job.parts.times import TIME_SCHEMA, Nanoseconds, parse_time
from rsltrace.job.reading.problems import Problem, Problems, as_flag, describe, problems_of

if TYPE_CHECKING:
    from typing_extensions import Self

FROM_FILE = {"from_file": True}
"""The validation context of a job that is read from a file."""


class Part(BaseModel):
    """Base of a job and its parts. Built wrongly, it raises ``JobError``, not pydantic's error."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    TIMES: ClassVar[dict[str, str]] = {}
    """YAML key of each time → name of its field, which ends in ``_ns``."""

    OF_TIMES: ClassVar[tuple[str, ...]] = ()
    """Other fields that hold times, in tuples."""

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            problems = problems_of(error, type(self))
            text = "\n".join(problem.message for problem in problems)
            raise JobError(text, where=type(self).__name__) from None

    # Without this pydantic would build nested parts through __init__ too, and an error in one of
    # them would no longer know its place in the whole.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _accept_field_names_of_times(cls, data: object, info: ValidationInfo) -> object:
        if not isinstance(data, dict) or from_file(info):
            return data
        for key, name in cls.TIMES.items():
            if name in data:
                if key in data:
                    raise Problem(f"give either {key} or {name}, not both", (name,))
                value = data[name]
                data = {k: v for k, v in data.items() if k != name}
                data[key] = value if value is None else Nanoseconds(value)
        return data

    def replace(self, **changes: object) -> Self:
        """Return a copy with ``changes`` (keys as in the constructor), validated again."""
        values: dict[str, object] = {}
        for name, field in type(self).model_fields.items():
            key = field.alias or name
            if key not in changes and name not in changes and name in self.model_fields_set:
                value = getattr(self, name)
                values[key] = _counted(value) if self.counts_ns(name) else value
        return type(self)(**values, **changes)

    @classmethod
    def counts_ns(cls, name: str) -> bool:
        """Whether a field holds times: nanoseconds, or tuples of these."""
        return name.endswith("_ns") or name in cls.OF_TIMES


def _counted(value: object) -> object:
    """Mark times as nanoseconds, so that they are not taken for seconds."""
    if isinstance(value, tuple):
        return tuple(map(_counted, value))
    return value if value is None else Nanoseconds(value)


def from_file(info: ValidationInfo) -> bool:
    """Say whether the value being validated was read from a job file."""
    return info.context is not None


def check(function: Callable[[Any], object], *, optional: bool = False) -> BeforeValidator:
    """Make a field validator of ``function``, which returns the value or raises ``ValueError``.

    ``optional`` lets ``None`` through when the part is built in Python.
    """

    def validate(value: object, info: ValidationInfo) -> object:
        if value is None and from_file(info):
            raise Problem("no value is given: give one, or leave the key out")
        return None if value is None and optional else function(value)

    attach(validate, schema=getattr(function, "schema", None))
    return BeforeValidator(validate)


def attach(function: Any, **facts: object) -> Any:
    """Let a check tell the generators of schema and documentation what it accepts.

    ``schema`` is JSON Schema; ``shorthand`` (``entry_shorthand``, of a list's entries) is the key
    that text alone stands for. Returns ``function``.
    """
    for name, value in facts.items():
        setattr(function, name, value)
    return function


def text(rule: Callable[[str], None] | None = None) -> Callable[[Any], str]:
    """Return a check for text that ``rule`` accepts."""

    def function(value: object) -> str:
        if not isinstance(value, str):
            raise Problem(f"expected text, got {describe(value)}")
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
            raise Problem(f"expected an integer, got {describe(value)}{_as_integer(value)}")
        if not least <= value <= most:
            bound = f"at least {least}" if value < least else f"at most {most}"
            raise Problem(f"must be {bound}, got {value}")
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
            close = difflib.get_close_matches(str(value).lower(), choices, n=1)
            hint = f"; did you mean {close[0]}?" if close and len(choices) > 2 else ""
            raise Problem(f"expected {' or '.join(choices)}, got {describe(value)}{hint}")
        return str(value)

    attach(function, schema={"enum": list(choices)})
    return function


def flag(value: object) -> bool:
    """Check true or false."""
    if not isinstance(value, bool):
        raise Problem(f"expected true or false, got {describe(value)}{as_flag(value)}")
    return value


attach(flag, schema={"type": "boolean"})


def positive_number(value: object) -> float:
    """Check a finite number that must be more than nothing."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise Problem(f"expected a number, got {describe(value)}")
    if not 0 < value < math.inf:
        raise Problem(f"must be a number more than 0, got {getattr(value, 'text', value)}")
    return float(value)


attach(positive_number, schema={"type": "number", "exclusiveMinimum": 0})


def positive_time(value: object) -> int:
    """Check a time that must be more than nothing."""
    time_ns = parse_time(value)
    if time_ns == 0:
        raise Problem("must be more than 0")
    return time_ns


attach(parse_time, schema=TIME_SCHEMA)
attach(positive_time, schema=TIME_SCHEMA)


def items(function: Callable[[Any], object]) -> Callable[[Any], tuple[object, ...]]:
    """Return a check for a list whose elements ``function`` accepts; gives a tuple."""

    def check_items(values: object) -> tuple[object, ...]:
        if not isinstance(values, (list, tuple)):
            raise Problem(f"expected a list, got {describe(values)}{_as_list(values)}")
        checked: list[object] = []
        problems: list[Problem] = []
        for index, value in enumerate(values):
            try:
                checked.append(function(value))
            except ValueError as error:
                problems.append(Problem(str(error), (index,)))
        if problems:
            raise Problems(problems)
        return tuple(checked)

    schema = getattr(function, "schema", None) or {}
    return attach(check_items, schema={"type": "array", "items": schema})  # type: ignore[no-any-return]


def _as_list(value: object) -> str:
    return f"; write [{value}]" if isinstance(value, str) and value.strip() else ""


def _given(value: object, info: ValidationInfo) -> object:
    if value is None and from_file(info):
        raise Problem("no value is given: give one, or leave the key out")
    return value


given = BeforeValidator(_given)
"""Refuse null in a file for a field that is None where it is not given."""


def parts(shorthand: str | None = None) -> BeforeValidator:
    """Prepare a list of parts for pydantic; plain text stands for ``{shorthand: text}``."""

    def validate(values: object) -> object:
        if not isinstance(values, (list, tuple)):
            hint = _as_list(values) if shorthand is not None else ""
            if isinstance(values, dict):
                hint = "; put '- ' in front of each entry"
            raise Problem(f"expected a list, got {describe(values)}{hint}")
        if shorthand is None:
            return tuple(values)
        return tuple({shorthand: v} if isinstance(v, str) else v for v in values)

    attach(validate, entry_shorthand=shorthand)
    return BeforeValidator(validate)


def part(shorthand: str) -> BeforeValidator:
    """Prepare one optional part for pydantic; plain text stands for ``{shorthand: text}``."""

    def validate(value: object, info: ValidationInfo) -> object:
        if value is None and from_file(info):
            raise Problem("no value is given: give one, or leave the key out")
        return {shorthand: value} if isinstance(value, str) else value

    attach(validate, shorthand=shorthand)
    return BeforeValidator(validate)
