"""What all parts of a job share: strict frozen models.

A part is built in two ways. From a job file, keys are the YAML names and nothing may be null. From
Python, ``None`` means "not given" and a time may also be given in nanoseconds under its field's
name (``duration_ns=``). The pydantic context tells the two apart.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, model_validator
from pydantic_core.core_schema import with_info_plain_validator_function

from rsltrace.errors import JobError, nearest
from rsltrace.job.parts.keys import field_at, file_fields, models_in
from rsltrace.job.values.checks import from_file
from rsltrace.job.values.problem import (
    JobProblem,
    JobProblems,
    Loc,
    as_flag,
    describe,
    format_loc,
    meant_by,
    unknown_key,
)
from rsltrace.job.values.times import Nanoseconds

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema
    from typing_extensions import Self

# What pydantic finds wrong with a job, in words for its author and with each mistake's place.

_VARIABLE = re.compile(r"\$\{?([A-Za-z_][A-Za-z0-9_]*)\}?")


def worded_problems(error: ValidationError, model: type[BaseModel]) -> list[JobProblem]:
    """Return the findings of a failed validation of ``model``, worded and with full locations."""
    found: list[JobProblem] = []
    entries = error.errors(include_url=False)
    # A misspelt key is one mistake, not two: the key that it was meant to be is not missing.
    meant = {
        (*entry["loc"][:-1], near)
        for entry in entries
        if entry["type"] == "extra_forbidden"
        for names in (_keys_at(model, entry["loc"][:-1]),)
        for near in (meant_by(str(entry["loc"][-1]), names), nearest(str(entry["loc"][-1]), names))
    }
    for entry in entries:
        loc: Loc = entry["loc"]
        cause = entry.get("ctx", {}).get("error")
        if isinstance(cause, (JobProblem, JobProblems)):
            items = cause.items if isinstance(cause, JobProblems) else [cause]
            hint = _as_variable(entry["input"])
            found += [
                _named(item.message + hint, loc + item.loc, at_key=item.at_key) for item in items
            ]
        elif entry["type"] == "extra_forbidden":
            found.append(unknown_key(loc[-1], _keys_at(model, loc[:-1]), loc[:-1]))
        elif entry["type"] == "missing" and loc in meant:
            continue
        elif entry["type"] == "missing":
            inside = f"{format_loc(loc[:-1])}: " if loc[:-1] else ""
            found.append(JobProblem(f"{inside}the key '{loc[-1]}' is missing", loc))
        else:
            text = _wording(entry["type"], entry["msg"], cause, entry["input"])
            text += _as_variable(entry["input"])
            is_part = entry["type"].startswith("model_") and not isinstance(cause, ValueError)
            if is_part and isinstance(entry["input"], (str, int, float, list, tuple)):
                keys = _keys_at(model, loc)
                text += f"; its keys are {', '.join(keys)}" if keys else ""
                text += _as_part(entry["input"], _models_at(model, loc))
            found.append(_named(text, loc))
    return found


def _named(message: str, loc: Loc, *, at_key: bool = False) -> JobProblem:
    place = format_loc(loc[:-1] if at_key else loc)
    return JobProblem(f"{place}: {message}" if place else message, loc, at_key=at_key)


def _wording(kind: str, message: str, cause: object, value: object) -> str:
    if isinstance(cause, ValueError):
        return str(cause)
    expected = {
        "model_type": "a mapping",
        "model_attributes_type": "a mapping",
        "dict_type": "a mapping",
        "tuple_type": "a list",
        "int_type": "an integer",
        "bool_type": "true or false",
        "string_type": "text",
    }.get(kind)
    hint = as_flag(value) if kind == "bool_type" else ""
    return f"expected {expected}, got {describe(value)}{hint}" if expected else message


def _as_variable(value: object) -> str:
    """Say how to write an environment variable, if a shell would take a text for one."""
    found = _VARIABLE.search(value) if isinstance(value, str) else None
    return f"; an environment variable is $(env {found[1]})" if found else ""


def _as_part(value: object, models: list[type[BaseModel]]) -> str:
    """Say how to write what was meant: ``stop: 60s`` is ``{duration: 60s}``."""
    for inner in models:
        keys: tuple[str, ...] = getattr(inner, "LISTED", ())
        if isinstance(value, (list, tuple)) and len(value) == len(keys):
            values = ", ".join(f"{k}: {_written(v)}" for k, v in zip(keys, value, strict=True))
            return f"; write {{{values}}}"
        key: str | None = getattr(inner, "MEANT", None)
        if hasattr(inner, "meant_key") and isinstance(value, str):
            key = inner.meant_key(value)
        wanted = (list, tuple) if getattr(inner, "MEANT_LIST", False) else (str, int, float)
        if key is not None and isinstance(value, wanted) and not isinstance(value, bool):
            return f"; write {{{key}: {_written(value)}}}"
    return ""


def _written(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_written, value))}]"
    return str(getattr(value, "text", value))


def _keys_at(model: type[BaseModel], loc: Loc) -> list[str]:
    """Return the keys a job may have at ``loc``."""
    return [key for inner in _models_at(model, loc) for key, _ in file_fields(inner)]


def _models_at(model: type[BaseModel], loc: Loc) -> list[type[BaseModel]]:
    """Return the parts that may be at ``loc``, found by walking the models' annotations."""
    if not loc:
        return [model]
    field = field_at(model, loc)
    assert field is not None, "extra keys can only be forbidden inside a model"
    return models_in(field.annotation)


_PLUGINS = "pydantic.plugin._loader"
"""What pydantic asks for plugins when it builds a model: it reads the metadata of all packages that
are installed, which takes longer than to read a job."""

_being_built: ContextVar[type[BaseModel] | None] = ContextVar("_being_built", default=None)


class JobPart(BaseModel):
    """Base of a job and its parts. Built wrongly, it raises ``JobError``, not pydantic's error."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", defer_build=True)

    OF_TIMES: ClassVar[tuple[str, ...]] = ()
    """Other fields that hold times, in tuples."""

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            problems = worded_problems(error, type(self))
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
        for key, name in cls._times():
            if name in data:
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

    @classmethod
    def _times(cls) -> Iterator[tuple[str, str]]:
        """Yield the key in a job file of each time, and the name of its field."""
        for name, field in cls.model_fields.items():
            if field.alias is not None and name.endswith("_ns"):
                yield field.alias, name

    @classmethod
    def model_rebuild(cls, **options: Any) -> bool | None:
        """Build what checks a part, when it is first used; plugins have no say in it."""
        without: Any = ModuleType(_PLUGINS)
        without.get_plugins = tuple
        hidden = sys.modules.setdefault(_PLUGINS, without) is without
        outer = _being_built.set(cls)
        try:
            return super().model_rebuild(**options)
        finally:
            _being_built.reset(outer)
            if hidden:
                del sys.modules[_PLUGINS]

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type[BaseModel], handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Let a part check the parts in it by what they have built themselves: most jobs have few
        of the parts that there may be."""
        if _being_built.get() is cls:
            return handler(source)
        return with_info_plain_validator_function(
            lambda value, info: cls.model_validate(value, context=info.context)
        )

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
