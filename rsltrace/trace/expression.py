"""What an expression says of a finished run: Python over its trace that can only look.

It is read wholly before anything runs: the only calls are those of the functions below, the only
attributes fields of messages.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.errors import ConditionError, did_you_mean
from rsltrace.trace.reader import Trace

_PLAIN: dict[str, Callable[..., Any]] = {
    "abs": abs,
    "all": all,
    "any": any,
    "isfinite": math.isfinite,
    "len": len,
    "max": max,
    "min": min,
    "round": round,
    "sqrt": math.sqrt,
    "sum": sum,
}
_VALUES: dict[str, Callable[[Trace], Any]] = {
    "digest": lambda trace: trace.digest,
    "end": lambda trace: trace.end_ns / 1e9,
    "events": lambda trace: trace.event_count,
    "exit_code": lambda trace: int(trace.result.get("exit_code") or 0),
    "stop_reason": lambda trace: trace.result.get("stop_reason", ""),
}
_OF_TOPICS = ("count", "first", "last", "messages", "times")
_KNOWN = (
    *(ast.Constant, ast.Name, ast.Attribute, ast.Subscript, ast.Slice, ast.List, ast.Tuple),
    *(ast.Compare, ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.IfExp, ast.Call),
    *(ast.GeneratorExp, ast.ListComp, ast.comprehension),
    *(ast.expr_context, ast.cmpop, ast.boolop, ast.operator, ast.unaryop),
)


class Expression:
    """A checked expression.

    :raises ConditionError: it is none, with the place in the text.
    """

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        try:
            tree = ast.parse(self.text, mode="eval")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            message = getattr(error, "msg", None) or str(error)
            column = (getattr(error, "offset", None) or len(self.text) + 1) - 1
            raise ConditionError(message, self._first_line, column, column + 1) from None
        own = {
            node.target.id
            for node in ast.walk(tree)
            if isinstance(node, ast.comprehension) and isinstance(node.target, ast.Name)
        }
        called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
        self._values = set()
        for node in ast.walk(tree.body):
            if not isinstance(node, _KNOWN):
                raise self._at(node, f"{type(node).__name__} has no place in an expression")
            if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
                raise self._at(node, f"{node.attr!r} is no field of a message")
            if isinstance(node, ast.Call):
                self._check_call(node)
            if isinstance(node, ast.Name) and id(node) not in called and node.id not in own:
                self._values.add(self._known_value(node))
        self._code = compile(tree, "<expression>", "eval")

    def value(self, trace: Trace) -> Any:
        """Return what it is worth for a trace.

        :raises ConditionError: it has no value there: no message on a topic, no such field, …
        """
        names: dict[str, Any] = {"__builtins__": {}, **_PLAIN, **_of_topics(trace)}
        names.update((name, _VALUES[name](trace)) for name in self._values)
        try:
            return eval(self._code, names)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            what = str(error.args[0]) if error.args else type(error).__name__
            raise ConditionError(f"it has no value there: {what}", self._first_line) from None

    def _known_value(self, node: ast.Name) -> str:
        if node.id in _VALUES:
            return node.id
        near = did_you_mean(node.id, (*_VALUES, *_PLAIN, *_OF_TOPICS))
        raise self._at(node, f"there is no {node.id!r} here, only {', '.join(_VALUES)}{near}")

    def _check_call(self, node: ast.Call) -> None:
        functions = (*_OF_TOPICS, *_PLAIN)
        if not isinstance(node.func, ast.Name) or node.func.id not in functions:
            raise self._at(node, f"the functions here are {', '.join(functions)}")
        name = node.func.id
        if node.keywords or any(isinstance(one, ast.Starred) for one in node.args):
            raise self._at(node, f"{name} takes plain arguments here")
        topic = node.args[0] if len(node.args) == 1 else None
        of_text = isinstance(topic, ast.Constant) and isinstance(topic.value, str)
        if name in _OF_TOPICS and not of_text:
            raise self._at(node, f'{name} takes a topic: {name}("/odom")')

    def _at(self, node: ast.AST, what: str) -> ConditionError:
        column = getattr(node, "col_offset", 0)
        return ConditionError(what, self._first_line, column, column + 1)

    @property
    def _first_line(self) -> str:
        return next(iter(self.text.splitlines()), "")


def _of_topics(trace: Trace) -> dict[str, Callable[[str], Any]]:
    def channels(topic: str) -> frozenset[int]:
        found = frozenset(one.id for one in trace.channels.values() if one.topic == topic)
        if not found:
            topics = {one.topic for one in trace.channels.values()}
            raise LookupError(f"there is no topic {topic}{did_you_mean(topic, topics)}")
        return found

    def count(topic: str) -> int:
        wanted = {one.id for one in trace.channels.values() if one.topic == topic}
        return sum(trace.message_counts.get(channel, 0) for channel in wanted)

    def messages(topic: str) -> Iterator[Any]:
        for channel, _, _, data in trace.messages_of(channels(topic)):
            yield trace.decode(channel, data)

    def first(topic: str) -> Any:
        for message in messages(topic):
            return message
        raise LookupError(f"there is no message on {topic}")

    def times(topic: str) -> list[float]:
        stamps = (stamp_ns for _, stamp_ns, *_ in trace.messages_of(channels(topic)))
        return [(stamp_ns - trace.start_ns) / 1e9 for stamp_ns in stamps]

    def last(topic: str) -> Any:
        latest = None
        for channel, _, _, data in trace.messages_of(channels(topic)):
            latest = channel, data
        if latest is None:
            raise LookupError(f"there is no message on {topic}")
        return trace.decode(*latest)

    return {
        "count": count,
        "first": first,
        "last": last,
        "messages": lambda topic: list(messages(topic)),
        "times": times,
    }
