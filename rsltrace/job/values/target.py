"""What a job names in Python: ``module:attribute``, or the class or function itself."""

from __future__ import annotations

from collections.abc import Callable

from rsltrace.job.values.checks import attach, text
from rsltrace.job.values.names import check_target, dotted_target
from rsltrace.job.values.problem import JobProblem, describe

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
