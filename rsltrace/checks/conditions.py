"""The texts of checks as conditions: those of the debugger that speak of what others can see."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, replace

from rsltrace.conditions.condition import Armed, Condition, is_true
from rsltrace.conditions.expressions import Expression, parse_expression
from rsltrace.conditions.names import Names
from rsltrace.conditions.occurrences import OnTopic
from rsltrace.conditions.text import parse_condition
from rsltrace.conditions.view import EventView, Moment
from rsltrace.errors import ConditionError

_TOPIC = r"/[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*"
_BARE = re.compile(_TOPIC)
_OF_MESSAGE = re.compile(rf"({_TOPIC})\s*:(?!:)\s*(.*)", re.DOTALL)
_DOTTED = re.compile(rf"(?:(?<=[\s(\[,<>=!+*%-])|\A)({_TOPIC})(?=\.[A-Za-z_])")


def plain(text: str) -> str:
    """Return a text with ``/odom.pose.x < 3`` written as ``/odom: msg.pose.x < 3``.

    :raises ConditionError: it speaks of several topics.
    """
    text = text.strip()
    if _BARE.fullmatch(text):
        return f"topic {text}"
    if _OF_MESSAGE.match(text):
        return text
    topics = list(dict.fromkeys(_DOTTED.findall(text)))
    if len(topics) > 1:
        raise ConditionError(
            f"a condition is about messages of one topic, this one about {' and '.join(topics)}; "
            "compare them in a function",
            text,
        )
    return f"{topics[0]}: {_DOTTED.sub('msg', text)}" if topics else text


def topic_of(text: str) -> str | None:
    """Return the topic of a plain text that is about messages of one, else None."""
    found = _OF_MESSAGE.match(text) or re.fullmatch(rf"topic ({_TOPIC})", text)
    return found[1] if found else None


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
    if _OF_MESSAGE.match(plain(text)) is None:
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
    found = _OF_MESSAGE.match(plain(text))
    if found is None:
        return None
    for part in ast.walk(ast.parse(found[2].strip(), mode="eval")):
        if isinstance(part, ast.Compare) and not isinstance(part.left, ast.Constant):
            return parse_expression(ast.unparse(part.left), has_own=True)
    return None
