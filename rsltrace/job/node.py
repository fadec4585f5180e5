"""One entry of ``nodes:``: what to construct, and how it is named, configured and connected."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from rsltrace.job.names import (
    check_namespace,
    check_node_name,
    check_remap_from,
    check_remap_to,
    check_target,
)
from rsltrace.job.parameters import ParameterValue, flatten_parameters
from rsltrace.job.part import Part, attach, check, items, one_of, text
from rsltrace.job.problems import Problem, Problems, describe
from rsltrace.job.times import ExactFloat
from rsltrace.job.tree import FileText, from_its_folder

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
    """Check a class or function, given itself or as ``module:attribute``."""
    if callable(value):
        return value
    return text(check_target)(value)


def check_path(value: object) -> str:
    """Check a path given as text or (in Python) as a path object."""
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, str) and not value:
        raise Problem("a path cannot be empty")
    text()(value)
    return from_its_folder(value)  # type: ignore[arg-type]  # text, as just checked


attach(check_path, schema={"type": "string", "minLength": 1})
attach(check_callable_target, schema={"type": "string", "pattern": check_target.pattern})  # type: ignore[attr-defined]


def _check_remappings(value: object) -> dict[str, str]:
    if not isinstance(value, dict):
        raise Problem(f"expected a mapping of names to names (from: to), got {describe(value)}")
    problems: list[Problem] = []
    for name, to in value.items():
        for rule, side, at_key in ((check_remap_from, name, True), (check_remap_to, to, False)):
            try:
                text(rule)(side)
            except ValueError as error:
                problems.append(Problem(str(error), (str(name),), at_key=at_key))
    if problems:
        raise Problems(problems)
    return {str(name): str(to) for name, to in value.items()}


def _check_arguments(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise Problem(f"expected a mapping of argument names to values, got {describe(value)}")
    for name in value:
        if not isinstance(name, str) or not name.isidentifier():
            raise Problem(f"{name!r} cannot be the name of an argument", (str(name),), at_key=True)
    return {name: _plain_floats(item) for name, item in value.items()}


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


class NodeSpec(Part):
    """One entry of ``nodes:``.

    ``node`` is a Node subclass or a function returning a node or a list of nodes; ``parameters``
    are flat (dotted names); paths are relative to the job's folder.
    """

    node: Annotated[Target, check(check_callable_target)]
    name: Annotated[str | None, check(text(check_node_name), optional=True)] = None
    namespace: Annotated[str | None, check(text(check_namespace), optional=True)] = None
    parameters: Annotated[dict[str, ParameterValue], check(flatten_parameters)] = Field(
        default_factory=dict
    )
    parameter_files: Annotated[tuple[str, ...], check(items(check_path))] = ()
    remappings: Annotated[dict[str, str], check(_check_remappings)] = Field(default_factory=dict)
    arguments: Annotated[dict[str, Any], check(_check_arguments)] = Field(default_factory=dict)
    on_exception: Annotated[Literal["stop", "log"], check(one_of("stop", "log"))] = "stop"

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            node: Target,
            name: str | None = None,
            namespace: str | None = None,
            parameters: dict[str, Any] = ...,
            parameter_files: list[str | os.PathLike[str]] | tuple[str | os.PathLike[str], ...] = (),
            remappings: dict[str, str] = ...,
            arguments: dict[str, Any] = ...,
            on_exception: Literal["stop", "log"] = "stop",
        ) -> None: ...

    @property
    def target(self) -> str:
        """``module:attribute`` of what is constructed."""
        return target_text(self.node)
