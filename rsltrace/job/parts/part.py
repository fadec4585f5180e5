"""What all parts of a job share: strict frozen models.

A part is built in two ways. From a job file, keys are the YAML names and nothing may be null. From
Python, ``None`` means "not given" and a time may also be given in nanoseconds under its field's
name (``duration_ns=``). The pydantic context tells the two apart.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, model_validator

from rsltrace.errors import JobError
from rsltrace.job.parts.validation import worded_problems
from rsltrace.job.values.checks import from_file
from rsltrace.job.values.problem import Problem
from rsltrace.job.values.times import Nanoseconds

if TYPE_CHECKING:
    from typing_extensions import Self


_PLUGINS = "pydantic.plugin._loader"
"""What pydantic asks for plugins when it builds a model: it reads the metadata of all packages that
are installed, which takes longer than to read a job."""


class Part(BaseModel):
    """Base of a job and its parts. Built wrongly, it raises ``JobError``, not pydantic's error."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", defer_build=True)

    TIMES: ClassVar[dict[str, str]] = {}
    """YAML key of each time → name of its field, which ends in ``_ns``."""

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
        for key, name in cls.TIMES.items():
            if name in data:
                if key in data:
                    raise Problem(f"give either {key} or {name}, not both", (name,))
                value = data[name]
                data = {k: v for k, v in data.items() if k != name}
                data[key] = value if value is None else Nanoseconds(value)
        return data

    @classmethod
    def model_rebuild(cls, **options: Any) -> bool | None:
        """Build what checks a part, when it is first used; plugins have no say in it."""
        if _PLUGINS in sys.modules:
            return super().model_rebuild(**options)
        without: Any = ModuleType(_PLUGINS)
        without.get_plugins = tuple
        sys.modules[_PLUGINS] = without
        try:
            return super().model_rebuild(**options)
        finally:
            del sys.modules[_PLUGINS]

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
