"""Parameters of nodes as launch files write them, and the values that they stand for."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from rsltrace.adapters.launch import model as scope
from rsltrace.adapters.launch.api.basics import (
    LaunchContext,
    Substitution,
    as_substitutions,
    missing_package,
)
from rsltrace.adapters.launch.model import typed, yaml_mistake, yaml_value
from rsltrace.adapters.launch.substitution import parse_template
from rsltrace.errors import JobError
from rsltrace.trace.model.regular_file import read_regular

# ROS parameter files as far as launching needs to look into them itself.


_KEY = "ros__parameters"


def substituted_parameters(
    path: str, replaced: Callable[[str], str], full_name: str | None
) -> dict[str, Any]:
    """Return the parameters for a node in a file that has substitutions in it."""
    return matching(replaced(_read(path)), path, full_name)


def parameters_for(path: str, full_name: str | None) -> dict[str, Any]:
    """Return the parameters a file gives a node, flat; without a name, those for all nodes."""
    return matching(_read(path), path, full_name)


def _read(path: str) -> str:
    try:
        return read_regular(Path(path)).decode()
    except OSError as error:
        raise JobError(f"cannot read the parameter file: {error.strerror}", where=path) from None
    except UnicodeDecodeError:
        raise JobError("the parameter file is not UTF-8 text", where=path) from None


def matching(text: str, path: str, full_name: str | None) -> dict[str, Any]:
    """Return the parameters for a node in the text of a file, by rcl's rules for wildcards."""
    content = yaml_value(text)
    if isinstance(content, str) and (problem := yaml_mistake(text)):
        raise JobError(f"not YAML: {problem}", where=path)
    if not isinstance(content, dict):
        raise JobError("this is not a parameter file (node: {ros__parameters: …})", where=path)
    values: dict[str, Any] = {}
    for name, parameters in _sections(content, ""):
        pattern = f"/{name.lstrip('/')}".replace("/*", r"(/\w+)")
        if name == "/**" or (full_name is not None and re.fullmatch(pattern, full_name)):
            values.update(flat(parameters))
    return values


def flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters with dotted names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _sections(content: dict[str, Any], prefix: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, inner in content.items():
        if not isinstance(inner, dict):
            continue
        full = f"{prefix}/{str(name).strip('/')}" if prefix else str(name)
        if isinstance(inner.get(_KEY), dict):
            yield full, inner[_KEY]
        yield from _sections({k: v for k, v in inner.items() if k != _KEY}, full)


_SCALARS = (bool, int, float, str)
_NUMBER = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")
_STRING = "if it is meant as text: ParameterValue(…, value_type=str)"


class ParameterValue:
    """The value of a parameter, with its type."""

    def __init__(self, value: Any, *, value_type: Any = None) -> None:
        self.value, self.value_type = value, value_type

    def evaluate(self, context: LaunchContext) -> Any:
        """Return the value. Raises ``ValueError`` if it is of another type."""
        return parameter_value(context, self.value, self.value_type)


class Parameter:
    """A parameter with its name."""

    def __init__(self, name: Any, value: Any, *, value_type: Any = None) -> None:
        self.name = as_substitutions(name)
        self._value = ParameterValue(value, value_type=value_type)

    def evaluate(self, context: LaunchContext) -> tuple[str, Any]:
        """Return name and value."""
        return context.text(self.name), self._value.evaluate(context)


_TEMPORARY = re.compile(r"(tmp|launch_params_)[a-z0-9_]{8}(\..*)?")
"""Names that ``tempfile`` gives: the launch file has written such a file itself."""


class ParameterFile:
    """A file of parameters."""

    def __init__(self, param_file: Any, *, allow_substs: Any = False) -> None:
        self.param_file, self.allow_substs = as_substitutions(param_file), allow_substs

    def evaluate(self, context: LaunchContext) -> Path:
        return Path(context.text(self.param_file))

    def found(
        self, context: LaunchContext, full_name: str | None
    ) -> scope.ParameterFilePath | dict[str, Any]:
        """Return the file, or its content for a node if it stays only as long as it is read.

        :raises ValueError: if it is not there.
        """
        path = os.path.abspath(self.evaluate(context))
        package = missing_package(path)
        if package is not None:
            raise ValueError(f"there is no package {package!r}, and so no parameter file {path}")
        if not os.path.isfile(path):
            raise ValueError(f"there is no parameter file {path}")
        if context.flag(self.allow_substs):

            def replaced(text: str) -> str:
                return context.text(parse_template(text))

            return substituted_parameters(path, replaced, full_name)
        if Path(path).parent == Path(tempfile.gettempdir()) and _TEMPORARY.fullmatch(
            Path(path).name
        ):
            return parameters_for(path, full_name)
        return scope.ParameterFilePath(path)


def parameter_value(context: LaunchContext, value: Any, kind: Any) -> Any:
    """Return a value of a type (``str``, ``List[int]``, …; None: as YAML would have it).

    :raises ValueError: if it is of another type.
    """
    if _is_text(value):
        text = context.text(value)
        return _by_yaml(text, "a ParameterValue") if kind is None else typed(text, _kind(kind))
    if isinstance(value, Sequence):
        items = [context.text(item) if _is_text(item) else item for item in value]
        inner = get_args(kind)
        if inner:
            return [typed(item, _kind(inner[0])) for item in items]
        return [typed(item, None) if isinstance(item, str) else item for item in items]
    return value if kind is None else typed(value, _kind(kind))


def _kind(kind: Any) -> str:
    inner = get_args(kind)
    return f"list_of_{_kind(inner[0])}" if inner else getattr(kind, "__name__", str(kind))


def _is_text(value: Any) -> bool:
    """Whether a value stands for one text: substitutions, maybe with text between them."""
    if isinstance(value, (str, Substitution)):
        return True
    return (
        isinstance(value, Sequence)
        and any(isinstance(part, Substitution) for part in value)
        and all(isinstance(part, (str, Substitution)) for part in value)
    )


def _by_yaml(text: str, name: str) -> Any:
    found = yaml_value(text) if text else ""
    if isinstance(found, list):
        if not found or type(found[0]) not in _SCALARS or len({type(v) for v in found}) > 1:
            raise ValueError(f"{name}: expected a list of one type, got {text!r:.80}; {_STRING}")
        return found
    if not isinstance(found, (*_SCALARS, bytes)):
        raise ValueError(
            f"{name}: expected a number, text, true or false, or a list, got "
            f"{type(found).__name__} ({text!r:.60}); {_STRING}"
        )
    return found


def plain_value(context: LaunchContext, value: Any, name: str) -> Any:
    """Return what a parameter's value in a mapping stands for.

    :raises ValueError, TypeError: if it stands for none.
    """
    if isinstance(value, ParameterValue):
        return value.evaluate(context)
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)  # launch writes it without quotes, and rcl reads a number
    if isinstance(value, (*_SCALARS, bytes)):
        return value
    if _is_text(value):
        return _by_yaml(context.text(value), name)
    if isinstance(value, Sequence) and value:
        return _array(context, value, name)
    raise TypeError(
        f"parameter {name!r}: a value is a number, text, true or false, or a list with something "
        f"in it, not {value!r:.80}"
    )


def _array(context: LaunchContext, items: Sequence[Any], name: str) -> list[Any]:
    kinds = {type(item) for item in items}
    if kinds in ({int}, {bool}, {str}):
        return list(items)
    if kinds <= {int, float}:
        return [float(item) for item in items]
    found = [
        item if isinstance(item, _SCALARS) else yaml_value(context.text(item)) for item in items
    ]
    if len({type(item) for item in found}) > 1 or type(found[0]) not in _SCALARS:
        raise TypeError(f"parameter {name!r}: a list has values of one type, not {found!r:.80}")
    return found


def named_values(
    context: LaunchContext, values: Mapping[Any, Any], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield the parameters of a mapping, nested ones with dotted names."""
    for key, value in values.items():
        name = prefix + context.text(key)
        if isinstance(value, Mapping):
            yield from named_values(context, value, f"{name}.")
        else:
            yield name, plain_value(context, value, name)


def evaluated_parameters(
    context: LaunchContext, parameters: Iterable[Any], full_name: str | None
) -> Iterator[scope.ParameterFilePath | dict[str, Any]]:
    """Yield the files and values of a node's ``parameters=[…]``.

    :raises ValueError, TypeError: if one of them is none, or a file is not there.
    """
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Iterable):
        raise TypeError(f"parameters is a list, not {type(parameters).__name__}")
    for given in parameters:
        if isinstance(given, Mapping):
            yield dict(named_values(context, given))
        elif isinstance(given, Parameter):
            yield dict([given.evaluate(context)])
        else:
            file = given if isinstance(given, ParameterFile) else ParameterFile(given)
            yield file.found(context, full_name)
