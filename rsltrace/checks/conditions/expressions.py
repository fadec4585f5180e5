"""Expressions about an event: over its message and, in a session, over nodes that run.

A condition only looks: what it says is checked before anything runs, and evaluated within bounds.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rsltrace.checks.conditions.bounds import StepBudget
from rsltrace.checks.conditions.evaluation import (
    NO_FIELD,
    Evaluate,
    ExpressionContext,
    TextPositions,
    UnsupportedExpression,
    evaluation,
    field_names,
    message_field,
    parsed,
    value_of,
)
from rsltrace.checks.conditions.functions import CONSTANTS, FUNCTIONS, OF_MODULES
from rsltrace.checks.conditions.names import RunNames, wrong_field
from rsltrace.checks.conditions.view import EventView, PausedRun
from rsltrace.errors import ConditionError, did_you_mean
from rsltrace.trace.words.entities import nodes_called, short_name

FROM_THE_RUN = ("node", "event", "now", "msg")


@dataclass(frozen=True, slots=True)
class Expression:
    """An expression that can be evaluated. ``begin`` is where it stands in the text around it."""

    text: str
    evaluate: Evaluate
    budget: StepBudget
    begin: int = 0

    def value(self, moment: PausedRun | EventView, *, message: object = None) -> Any:
        """Return what it is worth now.

        Names are looked for in ``message`` (its fields), then among the run's own
        (``node("ekf")``, ``event``, ``now``, ``msg``), and nodes by their short names. Raises what
        computing it raises.
        """
        return value_of(self.evaluate, moment, message, self.budget)


@dataclass(frozen=True, slots=True)
class EventFields:
    """What an expression sees of an event as ``event``."""

    index: int
    kind: int
    entity: int
    entity_name: str
    node: str
    stamp_ns: int
    output_hash: int

    @classmethod
    def of_event(cls, view: Any) -> EventFields:
        return cls(*(getattr(view, name) for name in cls.__slots__))


def parse_expression(
    text: str,
    names: RunNames | None = None,
    *,
    whole: str | None = None,
    begin: int = 0,
    interface: str = "",
    has_own: bool = False,
) -> Expression:
    """Read an expression; ``whole`` is the text around it, in which it begins at ``begin``.

    ``interface`` is that of the message whose fields it may use, if that is known. ``has_own``: it
    may use fields of a message that nobody knows yet.

    :raises ConditionError: naming the place.
    """
    whole = text if whole is None else whole
    begin += len(text) - len(text.lstrip())
    text = text.strip()
    tree = parsed(text, whole, begin)
    place = TextPositions(text)
    try:
        check_names(tree, names or RunNames(), interface=interface, has_own=has_own)
        evaluate = evaluation(tree, _EventVocabulary())
    except UnsupportedExpression as error:
        start, end = place.of(error.node)
        raise ConditionError(error.message, whole, begin + start, begin + end) from None
    return Expression(text, evaluate, StepBudget(), begin)


def check_names(
    tree: ast.expr, names: RunNames, *, interface: str, has_own: bool, others: tuple[str, ...] = ()
) -> None:
    """See whether what an expression names is there, as far as is known; ``others`` are names that
    it may have besides.

    :raises Refused: naming the part.
    """
    free = set(free_names(tree))
    fields = names.fields(interface) if interface else None
    checks = _NameChecker(names, fields, has_own, others)
    for node in ast.walk(tree):
        what = checks.wrong(node, free)
        if what:
            raise UnsupportedExpression(node, what)
    if interface and (found := wrong_field(tree, interface, names.fields)) is not None:
        raise UnsupportedExpression(found.node, found.message)


def free_names(tree: ast.expr) -> Iterator[str]:
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


class _NameChecker:
    """Says what is wrong with names. ``anything_goes``: fields or attributes nobody knows."""

    def __init__(
        self,
        names: RunNames,
        fields: Mapping[str, str] | None,
        anything_goes: bool,
        others: tuple[str, ...],
    ) -> None:
        self._names = names
        self._others = (*FROM_THE_RUN, *CONSTANTS, *FUNCTIONS, *OF_MODULES, *others)
        self._fields = fields
        self._anything_goes = anything_goes
        self._shorts = [short_name(node) for node in names.nodes]

    def wrong(self, node: ast.AST, free: set[str]) -> str:
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
        if name in self._shorts or name in self._others:
            return ""
        if self._fields is not None:
            there = [*self._fields, *FROM_THE_RUN, *self._shorts]
            hint = did_you_mean(name, there, f"it has {', '.join(self._fields)}")
            return f"the message has no field {name!r}; {hint}"
        if self._anything_goes or not self._names.are_all:
            return ""
        return f"there is no node {name!r}" + did_you_mean(name, [*self._shorts, *self._others])

    def _asked(self, name: str) -> str:
        called = nodes_called(name, self._names.nodes)
        if len(called) > 1:
            return self._several(name)
        if called or not self._names.are_all:
            return ""
        return f"there is no node {name!r}{did_you_mean(name, self._names.nodes)}"

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


class _EventVocabulary:
    """The names that expressions about events have."""

    def name(self, name: str) -> Evaluate:
        """Return how a name is looked up: any may be that of a field, or of a node."""
        other = _other_name(name)

        def look_up(scope: ExpressionContext) -> Any:
            message = scope.message
            if message is not None:
                found = message_field(message, name)
                if found is not NO_FIELD:
                    return found
            return other(scope)

        return look_up

    def call(self, name: str, arguments: list[ast.expr]) -> Evaluate | str | None:
        """Return ``node("ekf")``."""
        if name != "node":
            return None
        if len(arguments) != 1 or not isinstance(arguments[0], ast.Constant):
            return 'node takes a name: node("ekf")'
        called = arguments[0].value
        if not isinstance(called, str):
            return 'node takes a name: node("ekf")'
        return lambda scope: node_named(scope.moment, called)

    def functions(self) -> list[str]:
        return ["node"]

    def unknown(self, name: str) -> str:
        """Return what is wrong with a name: nothing that is known before the run."""
        return f"there is no {name!r} here"


def _other_name(name: str) -> Evaluate:
    """Return how a name is looked up that is of no field."""
    run = _RUN.get(name)
    if run is not None:
        return run
    if name in CONSTANTS:
        return lambda scope: CONSTANTS[name]

    def node(scope: ExpressionContext) -> Any:
        nodes = scope.moment.nodes()
        called = nodes_called(name, nodes)
        if len(called) == 1:
            return nodes[called[0]]
        if name in FUNCTIONS or name in OF_MODULES:
            raise NameError(f"{name} is a function: {name}(...)")
        if scope.message is not None:
            raise no_such_field(scope.message, name)
        raise NameError(f"there is no node {name!r} (yet)")

    return node


def no_such_field(message: object, name: str) -> AttributeError:
    """Return the error about a field that is not there."""
    fields = field_names(message)
    hint = did_you_mean(name, fields, f"it has {', '.join(fields)}")
    return AttributeError(f"{type(message).__name__} has no field {name!r}; {hint}")


def node_named(moment: PausedRun, name: str) -> object:
    """Return a node by its full or short name.

    :raises NameError: there is none, or several.
    """
    nodes = moment.nodes()
    called = nodes_called(name, nodes)
    if len(called) == 1:
        return nodes[called[0]]
    if called:
        raise NameError(f"several nodes are called {name!r}: {', '.join(called)}")
    raise NameError(f"there is no node {name!r}{did_you_mean(name, nodes)}")


def message_of(moment: PausedRun | EventView, message: object) -> object:
    """Return the message that an expression is about, or that its event has received.

    :raises NameError: there is none.
    """
    if message is not None:
        return message
    received = getattr(moment, "received", None)
    found = received() if received is not None else None
    if found is None:
        raise NameError("msg: this event has received no message")
    return found[1]


def _node_alone(scope: ExpressionContext) -> Any:
    raise NameError('node: say which, node("name")')


_RUN: Mapping[str, Callable[[ExpressionContext], Any]] = {
    "node": _node_alone,
    "event": lambda scope: EventFields.of_event(scope.moment),
    "now": lambda scope: scope.moment.stamp_ns / 1e9,
    "msg": lambda scope: message_of(scope.moment, scope.message),
}
