"""Python at the prompt of a session: ``print EXPRESSION``, and ``DebugSession.evaluate``.

That is meant to be Python, of whoever sits there, in a copy of a run whose code they have agreed to
run: methods of nodes may be called. Nothing that a file says is evaluated so: conditions, checks
and metrics have a language of their own (``rsltrace.conditions``).
"""

from __future__ import annotations

import ast
import builtins
import math
from collections.abc import Callable, Mapping
from typing import Any

from rsltrace.conditions.evaluation import (
    Places,
    Refused,
    field_names,
    parsed,
)
from rsltrace.conditions.expressions import (
    check_names,
    free_names,
    message_of,
    no_such_field,
    node_named,
)
from rsltrace.conditions.names import Names, nodes_called
from rsltrace.conditions.view import EventView
from rsltrace.errors import ConditionError, did_you_mean

_HARMLESS = (
    "abs all any bool bytes chr dict divmod enumerate float format frozenset getattr hasattr hash "
    "hex int isinstance issubclass iter len list max min next ord pow range repr reversed round "
    "set slice sorted str sum tuple type vars zip"
).split()
_BUILTINS = {name: getattr(builtins, name) for name in _HARMLESS}
_REFUSED: Mapping[type[ast.AST], str] = {
    ast.NamedExpr: "an expression cannot assign (:=)",
    ast.Await: "an expression cannot wait (await)",
    ast.Yield: "an expression cannot yield",
    ast.YieldFrom: "an expression cannot yield",
}


def python_value(text: str, names: Names, view: EventView, *, message: object, node: object) -> Any:
    """Return what a Python expression is worth.

    Names are looked for in ``message`` (its fields), in ``node`` (its attributes), then among the
    run's own, nodes by their short names, and what Python has built in.

    :raises ConditionError: it is none, or names what is not there.
    :raises PythonError: it raised.
    """
    text = text.strip()
    tree = parsed(text, text, 0)
    try:
        for part in ast.walk(tree):
            if type(part) in _REFUSED:
                raise Refused(part, _REFUSED[type(part)])
        others = ("self", "math", "np", *_BUILTINS)
        check_names(tree, names, interface="", has_own=True, others=others)
    except Refused as error:
        raise ConditionError(error.message, text, *Places(text).of(error.node)) from None
    try:
        code = compile(ast.Expression(tree), "<expression>", "eval")
        scope: dict[str, Any] = {"__builtins__": {}}
        for name in free_names(tree):
            scope[name] = _look_up(name, view, message, node)
        return eval(code, scope)
    except Exception as error:
        raise PythonError(f"{type(error).__name__}: {error}") from error


class PythonError(Exception):
    """What an expression has raised, in words."""


def _look_up(name: str, view: EventView, message: object, node: object) -> Any:
    if message is not None and name in field_names(message):
        return getattr(message, name)
    if node is not None and name != "self":
        try:
            return getattr(node, name)
        except AttributeError:
            pass
    found = _RUN.get(name)
    if found is not None:
        return found(view, message, node)
    called = nodes_called(name, view.nodes())
    if len(called) == 1:
        return view.nodes()[called[0]]
    if name in _BUILTINS:
        return _BUILTINS[name]
    if message is not None:
        raise no_such_field(message, name)
    if node is not None:
        raise AttributeError(
            f"{type(node).__name__} has no attribute {name!r}{did_you_mean(name, vars(node))}"
        )
    raise NameError(f"there is no node {name!r} (yet)")


def _self_of(node: object) -> object:
    if node is None:
        raise NameError('self: say in which node, or node("name")')
    return node


def _numpy() -> object:
    import numpy

    return numpy


_RUN: Mapping[str, Callable[[Any, Any, Any], Any]] = {
    "node": lambda view, message, node: lambda name: node_named(view, name),
    "event": lambda view, message, node: view,
    "now": lambda view, message, node: view.stamp_ns / 1e9,
    "msg": lambda view, message, node: message_of(view, message),
    "self": lambda view, message, node: _self_of(node),
    "math": lambda view, message, node: math,
    "np": lambda view, message, node: _numpy(),
}
