"""What all parts of a job share: strict frozen values with checks.

A part is built in two ways. From a job file, keys are the YAML names and nothing may be null. From
Python, ``None`` means "not given" and a time may also be given in nanoseconds under its field's
name (``duration_ns=``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, Union, get_args, get_origin

from rsltrace.errors import JobError, nearest
from rsltrace.job.parts.field import FrozenFields, PartField
from rsltrace.job.parts.keys import file_fields, model_of, models_in
from rsltrace.job.values.problem import (
    JobProblem,
    JobProblems,
    Loc,
    describe,
    format_loc,
    meant_by,
    unknown_key,
)
from rsltrace.job.values.times import Nanoseconds

if TYPE_CHECKING:
    from typing_extensions import Self

_VARIABLE = re.compile(r"\$\{?([A-Za-z_][A-Za-z0-9_]*)\}?")

_Method = TypeVar("_Method", bound=Callable[..., None])


def after_fields(method: _Method) -> _Method:
    """Let a method of a part check it when each of its fields is right."""
    method.is_after_fields = True  # type: ignore[attr-defined]
    return method


def _worded(error: ValueError, value: object, loc: Loc) -> Iterator[JobProblem]:
    """Yield what a check has found, with its place in the whole."""
    items = error.items if isinstance(error, JobProblems) else [error]
    for item in items:
        inner, at_key = (item.loc, item.at_key) if isinstance(item, JobProblem) else ((), False)
        place = (*loc, *inner)
        shown = format_loc(place[:-1] if at_key else place)
        text = f"{item}{_as_variable(value)}"
        yield JobProblem(f"{shown}: {text}" if shown else text, place, at_key=at_key)


def _as_variable(value: object) -> str:
    """Say how to write an environment variable, if a shell would take a text for one."""
    found = _VARIABLE.search(value) if isinstance(value, str) else None
    return f"; an environment variable is $(env {found[1]})" if found else ""


def _as_part(value: object, part: type[JobPart]) -> str:
    """Say how to write what was meant: ``stop: 60s`` is ``{duration: 60s}``."""
    keys: tuple[str, ...] = getattr(part, "LISTED", ())
    if isinstance(value, (list, tuple)) and len(value) == len(keys):
        values = ", ".join(f"{k}: {_written(v)}" for k, v in zip(keys, value, strict=True))
        return f"; write {{{values}}}"
    key: str | None = getattr(part, "MEANT", None)
    if hasattr(part, "meant_key") and isinstance(value, str):
        key = part.meant_key(value)
    wanted = (list, tuple) if getattr(part, "MEANT_LIST", False) else (str, int, float)
    if key is not None and isinstance(value, wanted) and not isinstance(value, bool):
        return f"; write {{{key}: {_written(value)}}}"
    return ""


def _written(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_written, value))}]"
    return str(getattr(value, "text", value))


def checked(
    field: PartField, given: object, found: list[JobProblem], loc: Loc, *, in_file: bool
) -> Any:
    """Return the value of a field, or add to ``found`` what is wrong with what is given."""
    value = given
    try:
        for check in field.checks:
            value = check(value, in_file)
    except ValueError as error:
        found += _worded(error, given, loc)
        return None
    return _with_parts(field.annotation, value, found, loc, in_file)


def _with_parts(
    annotation: Any, value: Any, found: list[JobProblem], loc: Loc, in_file: bool
) -> Any:
    """Return a checked value with the parts that its mappings stand for."""
    part = model_of(annotation)
    if part is not None:
        assert issubclass(part, JobPart)
        return part.made(value, found, loc, in_file=in_file)
    inner = get_args(annotation)
    if value is None or not models_in(annotation):
        return value
    if get_origin(annotation) in (Union, UnionType):
        return _with_parts(next(filter(models_in, inner)), value, found, loc, in_file)
    if get_origin(annotation) is dict:
        return {
            key: _with_parts(inner[1], item, found, (*loc, key), in_file)
            for key, item in value.items()
        }
    return tuple(
        _with_parts(inner[0], item, found, (*loc, index), in_file)
        for index, item in enumerate(value)
    )


class JobPart(FrozenFields):
    """Base of a job and its parts. Built wrongly, it raises ``JobError``."""

    OF_TIMES: ClassVar[tuple[str, ...]] = ()
    """Other fields that hold times, in tuples."""

    _after: ClassVar[tuple[Callable[[Any], None], ...]] = ()

    def __init_subclass__(cls) -> None:
        own = (value for value in vars(cls).values() if hasattr(value, "is_after_fields"))
        cls._after = (*cls._after, *own)

    def __init__(self, **data: Any) -> None:
        found: list[JobProblem] = []
        self._fill(data, found, (), in_file=False)
        if found:
            text = "\n".join(problem.message for problem in found)
            raise JobError(text, where=type(self).__name__)

    @classmethod
    def made(
        cls, value: object, found: list[JobProblem], loc: Loc = (), *, in_file: bool
    ) -> Self | None:
        """Return the part that a mapping describes, or a part itself; None if problems with it, at
        ``loc`` of the whole, are added to ``found``."""
        if isinstance(value, cls):
            return value
        part = cls.__new__(cls)
        before = len(found)
        if isinstance(value, dict):
            part._fill(value, found, loc, in_file=in_file)
        else:
            text = f"expected a mapping, got {describe(value)}{_as_variable(value)}"
            if isinstance(value, (str, int, float, list, tuple)):
                text += f"; its keys are {', '.join(key for key, _ in file_fields(cls))}"
                text += _as_part(value, cls)
            found += _worded(ValueError(text), None, loc)
        return part if len(found) == before else None

    def _fill(
        self, data: dict[Any, Any], found: list[JobProblem], loc: Loc, *, in_file: bool
    ) -> None:
        """Take the fields' values from a mapping, or add to ``found`` what is wrong with it."""
        before = len(found)
        try:
            given = data if in_file else self._with_keys_of_times(data)
        except JobProblem as problem:
            found += _worded(problem, data, loc)
            return
        fields = {field.alias or name: (name, field) for name, field in self.fields.items()}
        unknown = [key for key in given if key not in fields]
        names = [key for key, _ in file_fields(type(self))] if unknown else []
        # A misspelt key is one mistake, not two: the key that it was meant to be is not missing.
        meant = {near(str(key), names) for key in unknown for near in (meant_by, nearest)}
        values: dict[str, Any] = {}
        for key, (name, field) in fields.items():
            if key in given:
                values[name] = checked(field, given[key], found, (*loc, key), in_file=in_file)
            elif not field.is_required():
                values[name] = field.get_default()
            elif key not in meant:
                inside = f"{format_loc(loc)}: " if loc else ""
                found.append(JobProblem(f"{inside}the key '{key}' is missing", (*loc, key)))
        found += [unknown_key(key, names, loc) for key in unknown]
        if len(found) > before:
            return
        taken = frozenset(name for key, (name, _) in fields.items() if key in given)
        vars(self).update(values, _given=taken)
        try:
            for check_part in self._after:
                check_part(self)
        except ValueError as error:
            found += _worded(error, data, loc)

    @classmethod
    def _with_keys_of_times(cls, data: dict[Any, Any]) -> dict[Any, Any]:
        for name, field in cls.fields.items():
            key = field.alias
            if key is not None and name.endswith("_ns") and name in data:
                if key in data:
                    raise JobProblem(f"give either {key} or {name}, not both", (name,))
                data = {**data, key: _counted(data[name])}
                del data[name]
        return data

    def _only(self, keys: Sequence[str], at: tuple[str, ...] = ()) -> str:
        """Return which of ``keys`` is given; it is a problem (``at``) if that is not one."""
        given = [key for key in keys if getattr(self, key) is not None]
        if len(given) != 1:
            what = f"{' and '.join(given)} are given" if given else "none is given"
            raise JobProblem(f"give one of {', '.join(keys)}: {what}", at)
        return given[0]

    def replace(self, **changes: object) -> Self:
        """Return a copy with ``changes`` (keys as in the constructor), validated again."""
        values: dict[str, object] = {}
        for name, field in type(self).fields.items():
            key = field.alias or name
            if key not in changes and name not in changes and name in self._given:
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
