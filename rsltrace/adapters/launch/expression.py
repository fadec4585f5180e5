"""``$(eval …)``: Python expressions over plain values, without Python's reach.

ROS's launch hands the text to Python's ``eval``. Here it is parsed, and only what computes with
numbers, text and lists is done: reading a launch file must not run code of its author.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable
from typing import Any

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
