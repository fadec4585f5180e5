"""Inspect a stopped run: nodes, queues, timers, stacks, graph, messages, Python expressions."""

from __future__ import annotations

import ast
import builtins
import json
import math
import reprlib
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol

from rsltrace.adapters.processes.process import Process
from rsltrace.checks.conditions.evaluation import (
    TextPositions,
    UnsupportedExpression,
    field_names,
    parsed,
)
from rsltrace.checks.conditions.expressions import (
    check_names,
    free_names,
    message_of,
    no_such_field,
    node_named,
)
from rsltrace.checks.conditions.names import RunNames
from rsltrace.checks.conditions.view import EventView
from rsltrace.debug.current_event import CurrentEventView, source
from rsltrace.errors import ConditionError, DebugError, did_you_mean, near_or_all
from rsltrace.simulation.middleware.entity import Receiver
from rsltrace.simulation.middleware.overview import graph_overview
from rsltrace.trace.words.entities import nodes_called

if TYPE_CHECKING:
    from rsltrace.debug.event_history import EventLedger
    from rsltrace.run.session import RunSession

# ``print EXPRESSION`` and ``DebugSession.evaluate`` take Python from the user at the prompt, in a
# copy of a run whose code they trust: it may call methods of nodes. Text from files is never
# evaluated so: conditions, checks and metrics have a language (``rsltrace.checks.conditions``).

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


def python_value(
    text: str, names: RunNames, view: EventView, *, message: object, node: object
) -> Any:
    """Return the value of a Python expression.

    Names are looked up in ``message`` (its fields), ``node`` (its attributes), the run's nodes by
    short name, and Python's builtins.

    :raises ConditionError: it is not an expression, or uses an unknown name.
    :raises PythonError: it raised an exception.
    """
    text = text.strip()
    tree = parsed(text, text, 0)
    try:
        for part in ast.walk(tree):
            if type(part) in _REFUSED:
                raise UnsupportedExpression(part, _REFUSED[type(part)])
        others = ("self", "math", "np", *_BUILTINS)
        check_names(tree, names, interface="", has_own=True, others=others)
    except UnsupportedExpression as error:
        raise ConditionError(error.message, text, *TextPositions(text).of(error.node)) from None
    try:
        code = compile(ast.Expression(tree), "<expression>", "eval")
        scope: dict[str, Any] = {"__builtins__": {}}
        for name in free_names(tree):
            scope[name] = _look_up(name, view, message, node)
        return eval(code, scope)
    except Exception as error:
        raise PythonError(f"{type(error).__name__}: {error}") from error


class PythonError(Exception):
    """The exception that an expression raised, as text."""


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


_JSON_BYTES_MAX = 1 << 20
_ATTRIBUTES_MAX = 1000
_DEPTH_MAX = 3
_NO_USERS = {"rclpy", "rsltrace", *sys.stdlib_module_names} - {"__main__"}

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 2000
_short.maxlist = _short.maxtuple = _short.maxset = _short.maxdict = _short.maxdeque = 100
_short.maxlevel = 6


class StoppedRun(Protocol):
    """A run that is stopped between two events."""

    view: CurrentEventView
    session: RunSession
    ledger: EventLedger

    def names(self) -> RunNames:
        """Return the names in the run."""


def live_node(run: StoppedRun, name: str) -> Any:
    """Return a node by its full name, or its last part.

    :raises DebugError: none or several match, or it does not exist now.
    """
    full = full_name(run, name)
    node = run.view.nodes().get(full)
    if node is None:
        raise DebugError(f"{full} does not exist now: it is not made yet, or already destroyed")
    return node


def full_name(run: StoppedRun, name: str) -> str:
    """Return the full name of a node given by any unique part.

    :raises DebugError: none or several match.
    """
    nodes = dict.fromkeys((*run.view.nodes(), *run.names().nodes))
    found = nodes_called(name, nodes)
    if len(found) == 1:
        return found[0]
    if found:
        raise DebugError(f"{name!r} matches {', '.join(found)}: give the full name")
    raise DebugError(f"no node is called {name!r}{near_or_all(name, nodes)}")


def evaluate(run: StoppedRun, expression: str, node: str | None) -> dict[str, Any]:
    """Return the value of a Python expression as JSON, and its ``repr``.

    :raises ConditionError: it is not an expression, or uses an unknown name.
    :raises DebugError: it raised an exception.
    """
    owner = None if node is None else live_node(run, node)
    received = run.view.received()
    message = None if received is None else received[1]
    try:
        value = python_value(expression, run.names(), run.view, message=message, node=owner)
    except PythonError as error:
        raise DebugError(f"{expression}: {error}") from error
    answer: dict[str, Any] = {"repr": short_repr(value), "type": type(value).__qualname__}
    try:
        text = json.dumps(json_value(value), allow_nan=False)
        if len(text) <= _JSON_BYTES_MAX:
            answer["value"] = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        pass
    return answer


def short_repr(value: object) -> str:
    try:
        return _short.repr(value)
    except Exception as error:
        return f"<{type(value).__qualname__} whose repr raised {type(error).__name__}: {error}>"


def json_value(value: Any) -> Any:
    """Return a value as JSON has it: arrays are lists, messages are objects.

    :raises TypeError: JSON has no such value.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if hasattr(value, "get_fields_and_field_types"):
        return {
            name: json_value(getattr(value, name)) for name in value.get_fields_and_field_types()
        }
    if hasattr(value, "tolist"):  # of numpy, array.array
        return json_value(value.tolist())
    if isinstance(value, dict):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if isinstance(value, (bytes, bytearray)):
        return list(value)
    raise TypeError(f"{type(value).__qualname__} is not JSON")


def attributes(run: StoppedRun, name: str) -> dict[str, str]:
    """Return a node's own attributes and parameters with their ``repr``.

    An object without a ``repr`` of its own is listed by its attributes: ``_ekf.P``.
    """
    from rsltrace.adapters.rclpy.handles.node_state import own_attributes

    own = own_attributes(live_node(run, name))
    found = islice(_within(own, "", _DEPTH_MAX), _ATTRIBUTES_MAX)
    return {path: short_repr(value) for path, value in found}


def _within(values: Mapping[str, Any], prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        inner = _plain_parts(value) if depth else {}
        if inner:
            yield from _within(inner, f"{prefix}{name}.", depth - 1)
        else:
            yield f"{prefix}{name}", value


def _plain_parts(value: object) -> Mapping[str, Any]:
    """Return the attributes of a user object without a ``repr`` of its own."""
    kind = type(value)
    of = {one.__module__.partition(".")[0] for one in kind.__mro__[:-1]}
    if kind.__repr__ is not object.__repr__ or not of.isdisjoint(_NO_USERS):
        return {}
    slots = (name for one in kind.__mro__ for name in getattr(one, "__slots__", ()))
    found = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    return {**found, **getattr(value, "__dict__", {})}


def nodes(run: StoppedRun) -> list[dict[str, Any]]:
    found = [
        {"name": name, "class": f"{type(node).__module__}.{type(node).__qualname__}"}
        for name, node in run.view.nodes().items()
    ]
    for one in processes(run):
        found += [{"name": name, "class": f"in process {one['pid']}"} for name in one["nodes"]]
    return found


def queues(run: StoppedRun) -> list[dict[str, Any]]:
    graph = run.session.world.domain.graph
    found = []
    for node in graph.nodes:
        for endpoint in graph.endpoints_of(node):
            if isinstance(endpoint, Receiver):
                found.append(
                    {
                        "node": node.fully_qualified_name,
                        "kind": endpoint.kind.label,
                        "name": endpoint.trace_name(),
                        "type": endpoint.trace_type(),
                        "waiting": len(endpoint.queue),
                    }
                )
    return found


def timers(run: StoppedRun) -> list[dict[str, Any]]:
    """Return the timers, the next due first, cancelled ones last."""
    found = []
    for node in run.session.world.domain.graph.nodes:
        for timer in _timers_of(node):
            state = timer.state
            found.append(
                {
                    "node": node.fully_qualified_name,
                    "name": timer.trace_name(),
                    "period_ns": state.period_ns,
                    "due_ns": None if state.canceled else state.deadline_ns,
                }
            )
    return sorted(found, key=lambda one: (one["due_ns"] is None, one["due_ns"] or 0))


def _timers_of(node: Any) -> list[Any]:
    wrapper = getattr(node, "wrapper", None)
    return list(node.timers) if wrapper is None else [one.handle for one in wrapper.timers]


def stacks(run: StoppedRun) -> list[str]:
    runtime = run.session.world.runtime
    waits = [one.waits_for() for one in runtime.coroutines.suspended]
    return waits + [blocked.waits_for() for blocked in runtime.runners.blocked]


def graph(run: StoppedRun) -> dict[str, Any]:
    values = asdict(graph_overview(run.session.world.domain.graph, ()))
    del values["waiting"]
    return values


def processes(run: StoppedRun) -> list[dict[str, Any]]:
    """Return the programs that take part: their numbers, nodes and the lines of their callbacks."""
    found: dict[int, dict[str, Any]] = {}
    for node in run.session.world.domain.graph.nodes:
        if isinstance(node.process, Process):
            things, pid = node.process.things.values(), node.process.child.pid
            sources = [getattr(thing, "source", "") for thing in things]
            lines = list(dict.fromkeys(filter(None, sources)))
            one = found.setdefault(pid, {"pid": pid, "nodes": [], "callbacks": lines})
            one["nodes"].append(node.fully_qualified_name)
    return list(found.values())


def message(run: StoppedRun) -> dict[str, Any] | None:
    """Return the input message of the current (or next) callback."""
    received = run.view.received()
    if received is None:
        return None
    name, content = received
    return {
        "name": name,
        "type": "/".join([*type(content).__module__.split(".")[:2], type(content).__name__]),
        "content": json_value(content),
    }


INSPECTED: dict[str, Callable[[StoppedRun], Any]] = {
    "nodes": nodes,
    "queues": queues,
    "timers": timers,
    "stacks": stacks,
    "graph": graph,
    "message": message,
    "processes": processes,
    "source": lambda run: source(run.view, run.ledger),
}


def inspect_run(run: StoppedRun, what: str) -> Any:
    if what not in INSPECTED:
        there = ", ".join(INSPECTED)
        raise DebugError(f"nothing is called {what!r}; {did_you_mean(what, INSPECTED, there)}")
    return INSPECTED[what](run)
