"""``$(…)`` in XML and YAML launch files: the grammar, and what each stands for."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.api import substitutions as api
from rsltrace.adapters.launch.api.basics import LaunchContext, Substitution, SubstitutionFailure
from rsltrace.adapters.workspace.imports import unbuilt_prefix
from rsltrace.errors import nearest
from rsltrace.job.reading.substitute import package_prefix

# ``$(eval …)``: Python expressions over plain values, without Python's reach.
#
# ROS's launch hands the text to Python's ``eval``. Here it is parsed, and only what computes with
# numbers, text and lists is done: reading a launch file must not run code of its author.

_LENGTH_MAX = 10_000
_SIZE_MAX = 100_000

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[Any], Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
}
_COMPARE: dict[type, Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "abs": abs,
    "all": all,
    "any": any,
    "bool": bool,
    "float": float,
    "int": int,
    "len": len,
    "max": max,
    "min": min,
    "round": round,
    "sorted": sorted,
    "str": str,
    "sum": sum,
}
_UNBOUNDED = ("factorial", "comb", "perm", "prod", "lcm")
_MATH = {
    name: value
    for name, value in vars(math).items()
    if not name.startswith("_") and name not in _UNBOUNDED
}
_METHODS = frozenset(
    "startswith endswith lower upper strip lstrip rstrip split replace join capitalize title "
    "count find isdigit isalpha".split()
)


def evaluate(text: str) -> Any:
    """Return the value of a Python expression.

    :raises ValueError: if it is not an expression, or more than computing with plain values.
    """
    if len(text) > _LENGTH_MAX:
        raise ValueError(f"an expression of {len(text)} characters is too long")
    try:
        tree = ast.parse(text.strip(), mode="eval")
        return _value(tree.body)
    except SyntaxError as error:
        raise ValueError(f"{text!r} is not a Python expression: {error.msg}") from None
    except (RecursionError, MemoryError):
        raise ValueError(f"{text[:40]!r}… is nested too deeply") from None
    except _ForbiddenExpression as error:
        raise ValueError(f"{text!r}: {error}") from None
    except Exception as error:
        raise ValueError(f"{text!r} raises {type(error).__name__}: {error}") from None


class _ForbiddenExpression(Exception):
    """The expression reaches for more than plain values."""


def _value(node: ast.expr) -> Any:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, (ast.List, ast.Tuple)):
        values = [_value(item) for item in node.elts]
        return values if isinstance(node, ast.List) else tuple(values)
    if isinstance(node, ast.Name):
        if node.id in ("true", "false"):
            raise _ForbiddenExpression(
                f"{node.id} is {node.id.capitalize()} in Python; or quote it"
            )
        if node.id in _MATH:
            return _MATH[node.id]
        raise _ForbiddenExpression(f"there is no {node.id!r} here: quote it if it is text")
    if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
        return _UNARY[type(node.op)](_value(node.operand))
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        return _binary(node.op, _value(node.left), _value(node.right))
    if isinstance(node, ast.BoolOp):
        return _bool(node)
    if isinstance(node, ast.Compare):
        return _compare(node)
    if isinstance(node, ast.IfExp):
        return _value(node.body if _value(node.test) else node.orelse)
    if isinstance(node, ast.Subscript):
        return _subscript(node)
    if isinstance(node, ast.Attribute):
        if isinstance(node.value, ast.Name) and node.value.id == "math" and node.attr in _MATH:
            return _MATH[node.attr]
        raise _ForbiddenExpression(f".{node.attr} cannot be used here")
    if isinstance(node, ast.Call) and not node.keywords:
        return _call(node)
    raise _ForbiddenExpression(f"{type(node).__name__} cannot be used here, only plain computing")


def _binary(operation: ast.operator, left: Any, right: Any) -> Any:
    if isinstance(operation, ast.Pow) and (abs(right) > 1000 or abs(left) > 10**6):
        raise _ForbiddenExpression("the power is too large")
    if isinstance(operation, ast.Mult):
        for one, other in ((left, right), (right, left)):
            if isinstance(one, (str, list, tuple)) and len(one) * other > _SIZE_MAX:
                raise _ForbiddenExpression("the result is too long")
    if isinstance(operation, ast.Mod) and isinstance(left, str):
        raise _ForbiddenExpression("text cannot be formatted with %; use + and str()")
    return _BINARY[type(operation)](left, right)


def _bool(node: ast.BoolOp) -> Any:
    is_and = isinstance(node.op, ast.And)
    value: Any = is_and
    for part in node.values:
        value = _value(part)
        if bool(value) is not is_and:
            break
    return value


def _compare(node: ast.Compare) -> bool:
    left = _value(node.left)
    for operation, part in zip(node.ops, node.comparators, strict=True):
        right = _value(part)
        if not _COMPARE[type(operation)](left, right):
            return False
        left = right
    return True


def _subscript(node: ast.Subscript) -> Any:
    value = _value(node.value)
    if isinstance(node.slice, ast.Slice):
        bounds = (node.slice.lower, node.slice.upper, node.slice.step)
        return value[slice(*(None if bound is None else _value(bound) for bound in bounds))]
    return value[_value(node.slice)]


def _call(node: ast.Call) -> Any:
    arguments = [_value(argument) for argument in node.args]
    if isinstance(node.func, ast.Name):
        function = _FUNCTIONS.get(node.func.id) or _MATH.get(node.func.id)
        if not callable(function):
            raise _ForbiddenExpression(f"{node.func.id}() cannot be called here")
    elif isinstance(node.func, ast.Attribute):
        owner = node.func.value
        if isinstance(owner, ast.Name) and owner.id == "math":
            function = _MATH.get(node.func.attr)
        else:
            text = _value(owner)
            if not isinstance(text, str) or node.func.attr not in _METHODS:
                raise _ForbiddenExpression(f".{node.func.attr}() cannot be called here")
            function = getattr(text, node.func.attr)
        if not callable(function):
            raise _ForbiddenExpression(f".{node.func.attr}() cannot be called here")
    else:
        raise _ForbiddenExpression("only functions and methods of text can be called here")
    result = function(*arguments)
    if isinstance(result, (str, list)) and len(result) > _SIZE_MAX:
        raise _ForbiddenExpression("the result is too long")
    return result


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_DEPTH_MAX = 50


Template = tuple[str | Substitution, ...]
"""The pieces of a text, in order."""


def parse_template(text: str) -> Template:
    """Split a text into its parts. ``\\`` before a character takes its meaning away.

    :raises ValueError: if a substitution is not written properly.
    """
    return _TemplateParser(text).template()


class _TemplateParser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._depth = 0

    def template(self, end: str = "") -> Template:
        """Read up to the character ``end`` (a quote, which is skipped), or all there is."""
        parts: list[str | Substitution] = []
        plain = ""
        text = self._text
        while self._at < len(text):
            char = text[self._at]
            if end and char == end:
                break
            if char == "\\" and self._at + 1 < len(text):
                plain += text[self._at + 1]
                self._at += 2
            elif text.startswith("$(", self._at):
                if plain:
                    parts.append(plain)
                    plain = ""
                parts.append(self._call())
            else:
                plain += char
                self._at += 1
        if end:
            if self._at >= len(text):
                raise ValueError(f"a quote {end} is not closed in {text!r}")
            self._at += 1
        if plain:
            parts.append(plain)
        return tuple(parts)

    def _call(self) -> SubstitutionCall:
        start = self._at
        self._depth += 1
        if self._depth > _DEPTH_MAX:
            raise ValueError(f"substitutions are nested more than {_DEPTH_MAX} deep")
        self._at += 2
        name = _NAME.match(self._text, self._at)
        if name is None:
            raise ValueError(
                f"'$(' begins a substitution, such as $(var name), in {self._text!r}; write \\$( "
                "for plain text"
            )
        self._at = name.end()
        arguments = []
        while True:
            self._skip_blanks()
            if self._at >= len(self._text):
                raise ValueError(f"{self._text[start:]!r} has no closing parenthesis")
            if self._text[self._at] == ")":
                break
            arguments.append(self._argument())
        self._at += 1
        self._depth -= 1
        return SubstitutionCall(name.group(), tuple(arguments), self._text[start : self._at])

    def _argument(self) -> Template:
        text = self._text
        if text[self._at] in "'\"":
            self._at += 1
            return self.template(text[self._at - 1])
        parts: list[str | Substitution] = []
        while self._at < len(text) and text[self._at] not in " \t\r\n)":
            if text.startswith("$(", self._at):
                parts.append(self._call())
                continue
            if text[self._at] == "\\" and self._at + 1 < len(text):
                self._at += 1
            parts.append(text[self._at])
            self._at += 1
        return tuple(_joined(parts))

    def _skip_blanks(self) -> None:
        while self._at < len(self._text) and self._text[self._at] in " \t\r\n":
            self._at += 1


def _joined(parts: list[str | Substitution]) -> list[str | Substitution]:
    joined: list[str | Substitution] = []
    for part in parts:
        if isinstance(part, str) and joined and isinstance(joined[-1], str):
            joined[-1] += part
        else:
            joined.append(part)
    return joined


class SubstitutionCall(Substitution):
    """One substitution: ``$(env HOME)`` has the name ``env`` and one argument."""

    def __init__(self, name: str, arguments: tuple[Template, ...], written: str) -> None:
        self.name, self.arguments, self.written = name, arguments, written

    def describe(self) -> str:
        return self.written

    def perform(self, context: LaunchContext) -> str:
        """Return the text. Raises ``ValueError``, whose message begins with what is written."""
        if self.name in _REFUSED:
            raise ValueError(f"{self.written}: {_REFUSED[self.name]}; give the value itself")
        if self.name not in SUBSTITUTIONS:
            near = nearest(self.name, SUBSTITUTIONS)
            there = f"there are {', '.join(SUBSTITUTIONS)}"
            hint = f"did you mean $({near} …)?" if near else there
            raise ValueError(f"{self.written} is no substitution; {hint}")
        least, most, make = SUBSTITUTIONS[self.name]
        if not least <= len(self.arguments) <= most:
            number = f"{least}" if least == most else f"{least} to {most}"
            raise ValueError(
                f"{self.written}: {self.name} takes {number} values, here are "
                f"{len(self.arguments)} (quote a value with blanks in it)"
            )
        try:
            return make(*self.arguments).perform(context)
        except (ValueError, OSError, SubstitutionFailure) as error:
            said = str(error)
            raise ValueError(said if said.startswith("$(") else f"{self.written}: {said}") from None


class _TextFunction(Substitution):
    """What a function makes of texts."""

    def __init__(self, function: Callable[..., str], *arguments: Template) -> None:
        self._function, self._arguments = function, arguments

    def perform(self, context: LaunchContext) -> str:
        return self._function(*map(context.text, self._arguments))


def _prefix(package: str) -> Path:
    prefix = package_prefix(package) or unbuilt_prefix(package)
    if prefix is None:
        raise ValueError(
            f"there is no ROS package {package!r} in AMENT_PREFIX_PATH, nor among the sources "
            "here: install it, or source the workspace that has it"
        )
    return prefix


def _executable_in_package(executable: str, package: str) -> str:
    path = _prefix(package) / "lib" / package / executable
    if not path.exists():
        raise ValueError(f"package {package!r} has no executable {executable!r}")
    return str(path)


def _function(function: Callable[..., str]) -> Callable[..., Substitution]:
    return lambda *arguments: _TextFunction(function, *arguments)


def _environment(name: Template, default: Template | None = None) -> Substitution:
    return api.EnvironmentVariable(name, default_value=default)


_REFUSED = {
    "command": "reading a launch file runs no commands",
    "param": "a parameter's value is not known before the nodes run",
    "launch_log_dir": "a simulation writes no log files",
    "log_dir": "a simulation writes no log files",
}
SUBSTITUTIONS: dict[str, tuple[int, int, Callable[..., Substitution]]] = {
    "var": (1, 2, lambda name, default=None: api.LaunchConfiguration(name, default=default)),
    "env": (1, 2, _environment),
    "optenv": (1, 2, lambda name, default=(): _environment(name, default)),
    "dirname": (0, 0, api.ThisLaunchFileDir),
    "filename": (0, 0, api.ThisLaunchFile),
    "find-pkg-share": (1, 1, _function(lambda name: str(_prefix(name) / "share" / name))),
    "find-pkg-prefix": (1, 1, _function(lambda name: str(_prefix(name)))),
    "exec-in-pkg": (2, 2, _function(_executable_in_package)),
    "find-exec": (1, 1, lambda name: api.FindExecutable(name=name)),
    "file-content": (1, 1, api.FileContent),
    "anon": (1, 1, api.AnonName),
    "eval": (1, 99, _function(lambda *words: str(evaluate(" ".join(words))))),
    "not": (1, 1, api.NotSubstitution),
    "and": (2, 2, api.AndSubstitution),
    "or": (2, 2, api.OrSubstitution),
    "any": (0, 99, api.AnySubstitution),
    "all": (0, 99, api.AllSubstitution),
    "equals": (2, 2, api.EqualsSubstitution),
    "not-equals": (2, 2, api.NotEqualsSubstitution),
    "if": (2, 3, api.IfElseSubstitution),
}
"""How many values each takes, and the substitution that it is. None runs code of the file's."""
