"""Expressions about a finished run: over its trace, for metrics and ``bisect --check``."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.checks.conditions.bounds import StepBudget
from rsltrace.checks.conditions.evaluation import (
    Evaluate,
    ExpressionContext,
    TextPositions,
    UnsupportedExpression,
    evaluation,
    parsed,
    value_of,
)
from rsltrace.checks.conditions.functions import FUNCTIONS
from rsltrace.errors import ConditionError, did_you_mean
from rsltrace.trace.reader import Trace

_VALUES: dict[str, Callable[[Trace], Any]] = {
    "digest": lambda trace: trace.digest,
    "end": lambda trace: trace.end_ns / 1e9,
    "events": lambda trace: trace.event_count,
    "exit_code": lambda trace: int(trace.result.get("exit_code") or 0),
    "stop_reason": lambda trace: trace.result.get("stop_reason", ""),
}


class RunExpression:
    """A checked expression.

    :raises ConditionError: it is none, with the place in the text.
    """

    def __init__(self, text: str) -> None:
        self.text = text.strip()
        tree = parsed(self.text, self._first_line, 0)
        try:
            self._evaluate = evaluation(tree, _RunVocabulary())
        except UnsupportedExpression as error:
            raise ConditionError(
                error.message, self._first_line, *TextPositions(self.text).of(error.node)
            ) from None

    def value(self, trace: Trace) -> Any:
        """Return what it is worth for a trace.

        :raises ConditionError: it has no value there: no message on a topic, no such field, …
        """
        try:
            return value_of(self._evaluate, trace, None, StepBudget())
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            what = str(error.args[0]) if error.args else type(error).__name__
            raise ConditionError(f"it has no value there: {what}", self._first_line) from None

    @property
    def _first_line(self) -> str:
        return next(iter(self.text.splitlines()), "")


class _RunVocabulary:
    """The names that expressions about runs have."""

    def name(self, name: str) -> Evaluate | None:
        """Return how a value of the run is looked up."""
        read = _VALUES.get(name)
        return None if read is None else lambda scope: read(scope.moment)

    def unknown(self, name: str) -> str:
        """Return what is wrong with a name that is none."""
        near = did_you_mean(name, (*_VALUES, *FUNCTIONS, *_OF_TOPICS))
        return f"there is no {name!r} here, only {', '.join(_VALUES)}{near}"

    def call(self, name: str, arguments: list[ast.expr]) -> Evaluate | str | None:
        """Return what a function of a topic is worth: ``count("/odom")``."""
        function = _OF_TOPICS.get(name)
        if function is None:
            return None
        topic = arguments[0] if len(arguments) == 1 else None
        if not (isinstance(topic, ast.Constant) and isinstance(topic.value, str)):
            return f'{name} takes a topic: {name}("/odom")'
        named = topic.value
        key = f"{name}({named})"

        def once(scope: ExpressionContext) -> Any:
            """A topic is gone through once for an expression, however often that names it."""
            if key not in scope.own:
                scope.own[key] = function(scope, named)
            return scope.own[key]

        return once

    def functions(self) -> list[str]:
        return list(_OF_TOPICS)


def _channels(trace: Trace, topic: str) -> frozenset[int]:
    found = frozenset(one.id for one in trace.channels.values() if one.topic == topic)
    if not found:
        topics = {one.topic for one in trace.channels.values()}
        raise LookupError(f"there is no topic {topic}{did_you_mean(topic, topics)}")
    return found


def _count(scope: ExpressionContext, topic: str) -> int:
    trace: Trace = scope.moment
    wanted = {one.id for one in trace.channels.values() if one.topic == topic}
    return sum(trace.message_counts.get(channel, 0) for channel in wanted)


def _each(scope: ExpressionContext, topic: str) -> Iterator[Any]:
    trace: Trace = scope.moment
    for channel, _, _, data in trace.messages_of(_channels(trace, topic)):
        scope.budget.left += len(data) >> 3  # what goes through each message once is well paid
        yield trace.decode(channel, data)


def _messages(scope: ExpressionContext, topic: str) -> list[Any]:
    return list(_each(scope, topic))


def _first(scope: ExpressionContext, topic: str) -> Any:
    for message in _each(scope, topic):
        return message
    raise LookupError(f"there is no message on {topic}")


def _last(scope: ExpressionContext, topic: str) -> Any:
    trace: Trace = scope.moment
    latest = None
    for channel, _, _, data in trace.messages_of(_channels(trace, topic)):
        latest = channel, data
    if latest is None:
        raise LookupError(f"there is no message on {topic}")
    return trace.decode(*latest)


def _times(scope: ExpressionContext, topic: str) -> list[float]:
    trace: Trace = scope.moment
    stamps = (stamp_ns for _, stamp_ns, *_ in trace.messages_of(_channels(trace, topic)))
    return [(stamp_ns - trace.start_ns) / 1e9 for stamp_ns in stamps]


_OF_TOPICS: dict[str, Callable[[ExpressionContext, str], Any]] = {
    "count": _count,
    "first": _first,
    "last": _last,
    "messages": _messages,
    "times": _times,
}
