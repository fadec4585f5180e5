"""The texts of checks as conditions: those of the debugger that speak of what others can see."""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace

from rsltrace.conditions.condition import Armed, Condition, is_true
from rsltrace.conditions.expressions import Expression, parse_expression
from rsltrace.conditions.names import Names
from rsltrace.conditions.occurrences import OnTopic
from rsltrace.conditions.text import parse_condition
from rsltrace.conditions.topic_fields import OF_MESSAGE, plain
from rsltrace.conditions.view import EventView, Moment
from rsltrace.errors import ConditionError


def condition(text: str, names: Names) -> Condition:
    """Read what happens.

    :raises ConditionError: it cannot be understood, or no trace says it.
    """
    read = parse_condition(plain(text), names)
    if not read.after or read.reads == {"nodes"}:
        raise ConditionError(
            "a check sees messages, log records, exceptions and findings: say /topic, "
            "/topic: EXPRESSION, log, exception or finding; the rest takes a function",
            text,
        )
    return read


def opposite(text: str, names: Names) -> Condition:
    """Read what has to be true of all messages, and return the condition that is met by others:
    those of which it is false, or cannot be evaluated.

    :raises ConditionError: as above, or it is not about messages.
    """
    read = condition(text, names)
    if OF_MESSAGE.match(plain(text)) is None:
        raise ConditionError(
            "always is about messages: say /topic: EXPRESSION; for what must not happen, never",
            text,
        )

    def arm(moment: Moment) -> Armed:
        armed = read.arm(moment)
        assert isinstance(armed, OnTopic)
        return _Unless(armed.text, armed.pattern, armed.expression)

    return replace(read, arm=arm)


@dataclass
class _Unless(OnTopic):
    """After an event that sends a message of which an expression is not true."""

    def _why(self, what: str, view: EventView, message: object) -> str:
        assert self.expression is not None
        found, note = is_true(self.expression, view, self.text, message)
        self.note = note or self.note
        return "" if found else f"{what}, and not {self.expression.text}"


def compared(text: str) -> Expression | None:
    """Return the left side of the first comparison in a text about messages, to show its value."""
    found = OF_MESSAGE.match(plain(text))
    if found is None:
        return None
    for part in ast.walk(ast.parse(found[2].strip(), mode="eval")):
        if isinstance(part, ast.Compare) and not isinstance(part.left, ast.Constant):
            return parse_expression(ast.unparse(part.left), has_own=True)
    return None
