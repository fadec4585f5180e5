"""Python expressions over messages and nodes, checked before anything runs.

A condition only looks: what assigns, awaits or names something that is not there is refused with
its place in the text. What an expression calls runs, methods of nodes included; a replay notices
if that changes the run.
"""

from __future__ import annotations

import ast
import builtins
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from types import CodeType
from typing import Any

from rsltrace.debug.conditions.message_fields import wrong_field
from rsltrace.debug.conditions.names import Names, near_name, nodes_called, short_name
from rsltrace.debug.conditions.view import EventView, Moment
from rsltrace.errors import ConditionError, did_you_mean

_HARMLESS = (
    "abs all any bool bytes chr dict divmod enumerate float format frozenset getattr hasattr hash "
    "hex int isinstance issubclass iter len list max min next ord pow range repr reversed round "
    "set slice sorted str sum tuple type vars zip"
).split()
_BUILTINS = {name: getattr(builtins, name) for name in _HARMLESS}
_FROM_THE_RUN = ("node", "event", "now", "msg", "self", "math", "np")
_REFUSED: Mapping[type[ast.AST], str] = {
    ast.NamedExpr: "a condition cannot assign (:=)",
    ast.Await: "a condition cannot wait (await)",
    ast.Yield: "a condition cannot yield",
    ast.YieldFrom: "a condition cannot yield",
}


@dataclass(frozen=True, slots=True)
class Expression:
    """An expression that can be evaluated. ``begin`` is where it stands in the text around it."""

    text: str
    code: CodeType
    free: tuple[str, ...]
    """The names in it that are not its own."""
    begin: int = 0

    def value(
        self, moment: Moment | EventView, *, message: object = None, node: object = None
    ) -> Any:
        """Return what it is worth now.

        Names are looked for in ``message`` (its fields), in ``node`` (its attributes), then among
        the run's own (``node("ekf")``, ``event``, ``now``), nodes by their short names, and what
        Python has built in. Raises whatever the expression raises.
        """
        scope: dict[str, Any] = {"__builtins__": {}}
        for name in self.free:
            scope[name] = _look_up(name, moment, message, node)
        return eval(self.code, scope)


def parse_expression(
    text: str,
    names: Names | None = None,
    *,
    whole: str | None = None,
    begin: int = 0,
    interface: str = "",
    has_own: bool = False,
) -> Expression:
    """Read an expression; ``whole`` is the text around it, in which it begins at ``begin``.

    ``interface`` is that of the message whose fields it may use, if that is known. ``has_own``: it
    may use fields (of a message) or attributes (of a node) that nobody knows yet.

    :raises ConditionError: naming the place.
    """
    whole = text if whole is None else whole
    names = names or Names()
    begin += len(text) - len(text.lstrip())
    text = text.strip()

    def wrong(message: str, start: int = 0, end: int | None = None) -> ConditionError:
        last = len(text) if end is None else end
        return ConditionError(message, whole, begin + start, begin + last)

    if not text:
        raise wrong("an expression is missing here")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that 1 is 1 is somebody's own affair
            tree = ast.parse(text, mode="eval")
            place = _Places(text)
            for node in ast.walk(tree):
                if type(node) in _REFUSED:
                    raise wrong(_REFUSED[type(node)], *place.of(node))
            code = compile(tree, "<condition>", "eval")
    except SyntaxError as error:
        last = len(text) - 1  # also where Python has no place to name
        at = min(error.offset - 1, last) if error.lineno == 1 and error.offset else last
        raise wrong(f"not a Python expression: {error.msg}", at, at + 1) from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise wrong(f"not a Python expression: {error}") from None
    free = tuple(_free_names(tree))
    fields = names.fields(interface) if interface else None
    checks = _Checks(names, fields, has_own)
    for node in ast.walk(tree):
        what = checks.wrong(node, free)
        if what:
            raise wrong(what, *place.of(node))
    if interface and (found := wrong_field(tree, interface, names.fields)) is not None:
        raise wrong(found.message, *place.of(found.node))
    return Expression(text, code, free, begin)


class _Places:
    """Where parts of an expression stand in its text: ``ast`` counts bytes of lines."""

    def __init__(self, text: str) -> None:
        self._text = text

    def of(self, node: ast.AST) -> tuple[int, int]:
        """Return the first character of a part, and the one after its last."""
        found: Any = node
        begin = self._at(found.lineno, found.col_offset)
        return begin, self._at(found.end_lineno, found.end_col_offset)

    def _at(self, line: int, column: int) -> int:
        lines = self._text.splitlines(keepends=True)
        before = sum(map(len, lines[: line - 1]))
        return before + len(lines[line - 1].encode()[:column].decode(errors="ignore"))


def _free_names(tree: ast.Expression) -> Iterator[str]:
    """Yield the names that an expression has from outside, each once."""
    own = {
        node.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    own.update(node.arg for node in ast.walk(tree) if isinstance(node, ast.arg))
    yield from dict.fromkeys(
        node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id not in own
    )


class _Checks:
    """Says what is wrong with names. ``anything_goes``: fields or attributes nobody knows."""

    def __init__(self, names: Names, fields: Mapping[str, str] | None, anything_goes: bool) -> None:
        self._names = names
        self._fields = fields
        self._anything_goes = anything_goes
        self._shorts = [short_name(node) for node in names.nodes]

    def wrong(self, node: ast.AST, free: Collection[str]) -> str:
        """Return what is wrong with one part of an expression, empty if nothing is."""
        if isinstance(node, ast.Name) and node.id in free:
            return self._name(node.id)
        asked = _asked_node(node)
        return "" if asked is None else self._asked(asked)

    def _name(self, name: str) -> str:
        if self._fields is not None and name in self._fields:
            return ""
        if self._shorts.count(name) > 1:
            return self._several(name)
        if name in self._shorts or name in _FROM_THE_RUN or name in _BUILTINS:
            return ""
        if self._fields is not None:
            there = [*self._fields, *_FROM_THE_RUN, *self._shorts]
            hint = did_you_mean(name, there, f"it has {', '.join(self._fields)}")
            return f"the message has no field {name!r}; {hint}"
        if self._anything_goes or not self._names.are_all:
            return ""
        return f"there is no node {name!r}" + did_you_mean(
            name, [*self._shorts, *_FROM_THE_RUN, *_BUILTINS]
        )

    def _asked(self, name: str) -> str:
        called = nodes_called(name, self._names.nodes)
        if len(called) > 1:
            return self._several(name)
        if called or not self._names.are_all:
            return ""
        near = near_name(name, self._names.nodes)
        return f"there is no node {name!r}" + (f"; did you mean {near!r}?" if near else "")

    def _several(self, name: str) -> str:
        these = ", ".join(nodes_called(name, self._names.nodes))
        return f'several nodes are called {name!r}: {these}; say node("/…") with all of the name'


def _asked_node(node: ast.AST) -> str | None:
    """Return the name in ``node("ekf")``, None of anything else."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        return None
    if node.func.id != "node" or len(node.args) != 1 or node.keywords:
        return None
    name = node.args[0]
    return name.value if isinstance(name, ast.Constant) and isinstance(name.value, str) else None


# -- evaluation ------------------------------------------------------------------------------------


def _look_up(name: str, moment: Moment | EventView, message: object, node: object) -> Any:
    if message is not None and name in _fields_of(message):
        return getattr(message, name)
    if node is not None and name != "self":
        try:
            return getattr(node, name)
        except AttributeError:
            pass
    found = _RUN.get(name)
    if found is not None:
        return found(moment, message, node)
    called = nodes_called(name, moment.nodes())
    if len(called) == 1:
        return moment.nodes()[called[0]]
    if name in _BUILTINS:
        return _BUILTINS[name]
    if message is not None:
        fields = _fields_of(message)
        hint = did_you_mean(name, fields, f"it has {', '.join(fields)}")
        raise AttributeError(f"{type(message).__name__} has no field {name!r}; {hint}")
    if node is not None:
        raise AttributeError(
            f"{type(node).__name__} has no attribute {name!r}{did_you_mean(name, vars(node))}"
        )
    raise NameError(f"there is no node {name!r} (yet)")


def _fields_of(message: object) -> list[str]:
    known = getattr(message, "get_fields_and_field_types", None)
    return list(known()) if known is not None else list(getattr(message, "__dict__", ()))


def _node_in(moment: Moment) -> Callable[[str], object]:
    def node(name: str) -> object:
        """Return a node by its full or short name."""
        nodes = moment.nodes()
        called = nodes_called(name, nodes)
        if len(called) == 1:
            return nodes[called[0]]
        if called:
            raise NameError(f"several nodes are called {name!r}: {', '.join(called)}")
        near = near_name(name, nodes)
        raise NameError(
            f"there is no node {name!r}" + (f"; did you mean {near!r}?" if near else "")
        )

    return node


def _message_of(moment: Moment | EventView, message: object) -> object:
    if message is not None:
        return message
    received = getattr(moment, "received", None)
    found = received() if received is not None else None
    if found is None:
        raise NameError("msg: this event has received no message")
    return found[1]


def _self_of(node: object) -> object:
    if node is None:
        raise NameError('self: say in which node, or node("name")')
    return node


def _numpy() -> object:
    import numpy

    return numpy


_RUN: Mapping[str, Callable[[Any, Any, Any], Any]] = {
    "node": lambda moment, message, node: _node_in(moment),
    "event": lambda moment, message, node: moment,
    "now": lambda moment, message, node: moment.stamp_ns / 1e9,
    "msg": lambda moment, message, node: _message_of(moment, message),
    "self": lambda moment, message, node: _self_of(node),
    "math": lambda moment, message, node: math,
    "np": lambda moment, message, node: _numpy(),
}
