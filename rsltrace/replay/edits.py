"""Edits: changes to a recorded run, each at one event or time.

    812: message.pose.position.x = 3.0         what event 812 receives
    2.5s: topic("/odom").twist.linear.x += 1   the next message on /odom from then on
    812: node("/ekf").P[0][0] = 1e-3           an attribute, before event 812
    2.5s: parameters("/ekf")["rate"] = 20.0    a parameter
    812: drop()    2.5s: drop("/odom")         an event; the next message on a topic
    812: delay("5ms")                          it comes later
    812: defer()   812: defer(1)               it runs after all others (one other) due at its time

A time counts from the start of the run; @2.5s is simulated time 2.5 s. An edit is Python text that
is parsed and never run; its values are literals.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable, Sequence
from typing import Any

from rsltrace.errors import EditError, did_you_mean
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.values.times import TimeInRun, parse_stamp, parse_time_in_run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.reader import Trace

PathStep = tuple[str, Any]
"""A step into an object: ``(".", name)`` or ``("[", key)``."""

_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_FORMS = (
    'message.FIELD = VALUE, topic("/t").FIELD = VALUE, node("/n").ATTRIBUTE = VALUE, '
    'parameters("/n")["NAME"] = VALUE, drop(), drop("/t"), delay("5ms"), defer()'
)


@dataclass(frozen=True, slots=True)
class SetMessageEdit:
    """Change a message: what the event receives, or (``topic``) the next one published there."""

    topic: str | None
    path: tuple[PathStep, ...]
    operator: str
    value: Any


@dataclass(frozen=True, slots=True)
class SetAttributeEdit:
    """Change an attribute of a node, or something in it."""

    node: str
    path: tuple[PathStep, ...]
    operator: str
    value: Any


@dataclass(frozen=True, slots=True)
class SetParameterEdit:
    """Set a parameter of a node, as ``Node.set_parameters`` does."""

    node: str
    name: str
    value: Any


@dataclass(frozen=True, slots=True)
class DropEdit:
    """Leave out the event, or (``topic``) the next message published there."""

    topic: str | None


@dataclass(frozen=True, slots=True)
class DelayEdit:
    """Let the event happen later by ``delay_ns``."""

    delay_ns: int


@dataclass(frozen=True, slots=True)
class DeferEdit:
    """Let ``count`` others that are due at the event's time run before it; None: all of them."""

    count: int | None


Action = SetMessageEdit | SetAttributeEdit | SetParameterEdit | DropEdit | DelayEdit | DeferEdit


@dataclass(frozen=True, slots=True)
class Edit:
    """An edit: its text, where it takes place (an index or a time), and what it does."""

    text: str
    index: int | None
    time: TimeInRun | None
    action: Action

    @property
    def of_event(self) -> bool:
        """Whether it changes the event itself, not the state before it."""
        action = self.action
        if isinstance(action, (SetMessageEdit, DropEdit)):
            return action.topic is None
        return isinstance(action, (DelayEdit, DeferEdit))

    @property
    def topic(self) -> str | None:
        """The topic whose next message it changes, or None."""
        return self.action.topic if isinstance(self.action, (SetMessageEdit, DropEdit)) else None


def parse_edit(text: str) -> Edit:
    """Parse the text of an edit.

    :raises EditError: with the position in the text.
    """
    return _EditParser(text).edit()


def edits_metadata(edits: Iterable[Edit], trace: Trace) -> dict[str, str]:
    """Return a branch's metadata: its edits, and the digest of the trace it branches from."""
    return {**{f"{n:06}": edit.text for n, edit in enumerate(edits)}, "of": trace.digest}


def check_edits(edits: Sequence[Edit], trace: Trace) -> None:
    """Check that the trace has what the edits name.

    :raises EditError: it lacks an event, topic or node.
    """
    names: dict[EntityKind, set[str]] = {}
    for entity in trace.entities.values():
        names.setdefault(entity.kind, set()).add(entity.name)
    for edit in edits:
        if edit.index is not None and edit.index >= trace.event_count:
            last = trace.event_count - 1
            raise EditError(f"{edit.text!r}: the last event of {trace.name} is {last}")
        if (
            edit.time is not None
            and edit.time.stamp_ns(trace.start_ns, trace.end_ns) > trace.end_ns
        ):
            end_s = (trace.end_ns - trace.start_ns) / 1e9
            raise EditError(f"{edit.text!r}: {trace.name} ends at {end_s:g} s")
        node = getattr(edit.action, "node", None)
        for name, kind in ((node, EntityKind.NODE), (edit.topic, EntityKind.PUBLISHER)):
            known = names.get(kind, set())
            if name is not None and name not in known:
                is_node = kind is EntityKind.NODE
                what = "is not a node" if is_node else "has no publisher"
                near = did_you_mean(name, known)
                raise EditError(f"{edit.text!r}: {name} {what} in {trace.name}{near}")


class _EditParser:
    def __init__(self, text: str) -> None:
        self._text = text.strip()
        self._begin = 0

    def edit(self) -> Edit:
        anchor, colon, rest = self._text.partition(":")
        if not colon:
            raise self._wrong(0, "an edit begins with where it takes place: 812: …, or 2.5s: …")
        index, time = self._anchor(anchor.strip())
        self._begin = len(anchor) + 1 + len(rest) - len(rest.lstrip())
        try:
            body = ast.parse(rest.strip()).body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            at = self._begin + max((getattr(error, "offset", None) or 1) - 1, 0)
            raise self._wrong(at, getattr(error, "msg", None) or str(error)) from None
        if len(body) != 1:
            raise self._wrong(self._begin, f"an edit is one of {_FORMS}")
        return Edit(self._text, index, time, self._action(body[0]))

    def _anchor(self, text: str) -> tuple[int | None, TimeInRun | None]:
        if text.isascii() and text.isdigit():
            return int(text), None
        try:
            return None, parse_time_in_run(text.removeprefix("t="))
        except ValueError as error:
            raise self._wrong(
                0, f"{text!r} is neither the index of an event (812) nor a time (2.5s): {error}"
            ) from None

    def _action(self, statement: ast.stmt) -> Action:
        if isinstance(statement, ast.Assign) and len(statement.targets) == 1:
            return self._change(statement.targets[0], "", statement.value)
        if isinstance(statement, ast.AugAssign) and type(statement.op) in _OPERATORS:
            operator = _OPERATORS[type(statement.op)]
            return self._change(statement.target, operator, statement.value)
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call):
            return self._call(statement.value)
        raise self._at(statement, f"an edit is one of {_FORMS}")

    def _call(self, call: ast.Call) -> Action:
        name = call.func.id if isinstance(call.func, ast.Name) else ""
        values = [self._value(one) for one in call.args]
        if name not in ("drop", "delay", "defer") or len(values) > 1 or call.keywords:
            raise self._at(call, f"an edit is one of {_FORMS}")
        given = values[0] if values else None
        if name == "drop":
            if given is not None and not (isinstance(given, str) and given.startswith("/")):
                raise self._at(call, 'drop takes nothing or a topic: drop("/odom")')
            return DropEdit(given)
        if name == "delay":
            return DelayEdit(self._delay(call, given))
        if given is not None and (type(given) is not int or given < 1):
            raise self._at(call, "defer takes nothing or how many others run first: defer(1)")
        return DeferEdit(given)

    def _delay(self, call: ast.Call, given: Any) -> int:
        if isinstance(given, str):
            try:
                delay_ns = parse_stamp(given)
            except ValueError as error:
                raise self._at(call, str(error)) from None
            if delay_ns > 0:
                return delay_ns
        raise self._at(call, 'delay takes a time: delay("5ms")')

    def _change(self, target: ast.expr, operator: str, value_node: ast.expr) -> Action:
        path: list[PathStep] = []
        root: ast.expr = target
        while isinstance(root, (ast.Attribute, ast.Subscript)):
            if isinstance(root, ast.Attribute):
                path.insert(0, (".", root.attr))
            else:
                path.insert(0, ("[", self._value(root.slice)))
            root = root.value
        value = self._value(value_node)
        if operator and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise self._at(value_node, f"{operator}= takes a number")
        if isinstance(root, ast.Name) and root.id == "message" and path:
            return SetMessageEdit(None, tuple(path), operator, value)
        kind, name = self._named(root)
        if kind == "parameters" and len(path) == 1 and path[0][0] == "[" and not operator:
            if isinstance(path[0][1], str):
                return SetParameterEdit(name, path[0][1], value)
        elif kind == "topic" and path:
            return SetMessageEdit(name, tuple(path), operator, value)
        elif kind == "node" and path and path[0][0] == ".":
            return SetAttributeEdit(name, tuple(path), operator, value)
        raise self._at(target, f"an edit is one of {_FORMS}")

    def _named(self, root: ast.expr) -> tuple[str, str]:
        if (
            isinstance(root, ast.Call)
            and isinstance(root.func, ast.Name)
            and len(root.args) == 1
            and not root.keywords
        ):
            name = self._value(root.args[0])
            if isinstance(name, str) and name:
                return root.func.id, name if name.startswith("/") else f"/{name}"
        raise self._at(root, f"an edit is one of {_FORMS}")

    def _value(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Name) and node.id in ("nan", "inf"):
            return getattr(math, node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            value = self._value(node.operand)
            if isinstance(value, (int, float)):
                return -value
        try:
            return ast.literal_eval(node)
        except (ValueError, TypeError, RecursionError):
            raise self._at(node, "a value is a literal: 1.5, True, 'text', [1, 2]") from None

    def _at(self, node: ast.AST, what: str) -> EditError:
        return self._wrong(self._begin + getattr(node, "col_offset", 0), what)

    def _wrong(self, column: int, what: str) -> EditError:
        shown = next(iter(self._text.splitlines()), "")
        return EditError(f"--edit: {what}\n  {shown}\n  {' ' * column}^")


def combine(old: Any, operator: str, value: Any) -> Any:
    """Return ``value``, or ``old`` and ``value`` combined by an operator."""
    if operator == "+":
        return old + value
    if operator == "-":
        return old - value
    if operator == "*":
        return old * value
    if operator == "/":
        return old / value
    return float(value) if type(old) is float and type(value) is int else value


def set_path(root: Any, path: Sequence[PathStep], operator: str, value: Any) -> None:
    """Set what a path leads to from an object.

    :raises Exception: whatever the objects on the way raise.
    """
    for kind, key in path[:-1]:
        root = getattr(root, key) if kind == "." else root[key]
    kind, key = path[-1]
    if kind == "[":
        root[key] = combine(root[key], operator, value)
    else:
        setattr(root, key, combine(getattr(root, key), operator, value))


def path_text(path: Iterable[PathStep]) -> str:
    return "".join(f".{key}" if kind == "." else f"[{key!r}]" for kind, key in path)
