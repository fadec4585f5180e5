"""Conditions that one event answers, whatever was before it."""

from __future__ import annotations

import builtins
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rsltrace.checks.conditions.condition import (
    ActiveCondition,
    error_text,
    is_true,
    shown,
    shown_text,
)
from rsltrace.checks.conditions.expressions import Expression
from rsltrace.checks.conditions.view import EventView, PausedRun, SentOutput
from rsltrace.job.values.times import TimeInRun
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.words.entities import is_named

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_SENDS = {
    OutputKind.MESSAGE: "published on",
    OutputKind.REQUEST: "called",
    OutputKind.RESPONSE: "answered",
}


@dataclass
class IndexCondition(ActiveCondition):
    index: int

    def before(self, view: EventView) -> str:
        return f"event {self.index}" if view.index == self.index else ""


@dataclass
class NodeCondition(ActiveCondition):
    pattern: str

    def before(self, view: EventView) -> str:
        return view.node if view.node and is_named(self.pattern, view.node) else ""


@dataclass
class EntityCondition(ActiveCondition):
    """Before an event of an entity, which goes by its name or (``#27``) its number."""

    pattern: str

    def before(self, view: EventView) -> str:
        name = view.entity_name
        if self.pattern == f"#{view.entity}" or (name and is_named(self.pattern, name)):
            return f"{view.node}: {name}" if view.node else name or self.pattern
        return ""


@dataclass
class TopicCondition(ActiveCondition):
    """Before an event that receives a message on a topic, and after one that sends one.

    With an ``expression``, one of whose fields it is true.
    """

    text: str
    pattern: str
    expression: Expression | None = None

    def before(self, view: EventView) -> str:
        """Look at the input, which a callback has when it begins, not when it goes on."""
        found = None if view.kind == EventKind.RESUME else view.received()
        if found is None or not is_named(self.pattern, found[0]):
            return ""
        return self._why(f"{view.node} receives {found[0]}", view, found[1])

    def after(self, view: EventView) -> str:
        for sent in view.sent():
            if sent.kind in _MESSAGES and is_named(self.pattern, sent.name):
                message = None
                if self.expression is not None and sent.message is not None:
                    message = sent.message()
                does = _SENDS[OutputKind(sent.kind)]
                why = self._why(f"{view.node or 'the run'} has {does} {sent.name}", view, message)
                if why:
                    return why
        return ""

    def _why(self, what: str, view: EventView, message: object) -> str:
        if self.expression is None:
            return what
        if message is None:
            return ""
        found, note = is_true(self.expression, view, self.text, message)
        self.note = note or self.note
        return f"{what}, and {self.expression.text}" if found else ""


class _OutputCondition(ActiveCondition, ABC):
    """After an event with an output for which ``_matches`` says something."""

    def after(self, view: EventView) -> str:
        """Look at the outputs, one after the other."""
        return next(filter(None, map(self._matches, view.sent())), "")

    @abstractmethod
    def _matches(self, sent: SentOutput) -> str:
        """Return what to say of an output; nothing: go on."""


@dataclass
class HashCondition(_OutputCondition):
    """After an event whose outputs (all together, or one of them) have a hash that begins so."""

    digits: str

    def after(self, view: EventView) -> str:
        """Look at the event's own hash first."""
        if f"{view.output_hash:016x}".startswith(self.digits) and view.output_hash:
            return f"output hash {view.output_hash:016x}"
        return super().after(view)

    def _matches(self, sent: SentOutput) -> str:
        text = f"{sent.hash:016x}"
        return f"output {text}" if sent.hash and text.startswith(self.digits) else ""


@dataclass
class ExceptionCondition(_OutputCondition):
    """After an event that raised an exception: of any type, or of one or its subclasses."""

    type: str = ""

    def _matches(self, sent: SentOutput) -> str:
        if sent.kind != OutputKind.EXCEPTION:
            return ""
        name = sent.text.partition(":")[0].strip()
        return shown_text(f"raised {sent.text}") if self._is_one(name) else ""

    def _is_one(self, name: str) -> bool:
        if self.type in ("", name) or name.endswith(f".{self.type}"):
            return True
        wanted = getattr(builtins, self.type, None)
        found = getattr(builtins, name, None)
        if not (isinstance(wanted, type) and isinstance(found, type)):
            return False
        return issubclass(found, wanted)


@dataclass
class LogCondition(_OutputCondition):
    """After an event with a log record of a level or worse that says something."""

    level: int
    says: Callable[[str], object]

    def _matches(self, sent: SentOutput) -> str:
        if sent.kind != OutputKind.LOG or sent.level < self.level or not self.says(sent.text):
            return ""
        return f"log {shown(sent.text)}"


@dataclass
class FindingCondition(ActiveCondition):
    """After an event in which the guard found something."""

    source: str = ""

    def after(self, view: EventView) -> str:
        for source in view.findings():
            if self.source in ("", source):
                return f"the guard found {source}"
        return ""


@dataclass
class FilteredCondition(ActiveCondition):
    """Another condition, where an expression is true as well."""

    inner: ActiveCondition
    expression: Expression
    text: str

    def before(self, view: EventView) -> str:
        return self._if(self.inner.before(view), view)

    def after(self, view: EventView) -> str:
        return self._if(self.inner.after(view), view)

    def _if(self, why: str, view: EventView) -> str:
        if not why:
            return ""
        received = view.received()
        message = None if received is None else received[1]
        found, note = is_true(self.expression, view, self.text, message)
        self.note = note or self.note or self.inner.note
        return f"{why} if {self.expression.text}" if found else ""


def says_pattern(pattern: str) -> Callable[[str], object]:
    """Return whether a text has something that a regular expression fits.

    Pydantic's engine takes time in proportion to the text, whatever the pattern. Rejected:
    Python's, which ``(a+)+$`` in somebody's job keeps busy for ever.

    :raises ValueError: it is none, or one that looks ahead, behind or back.
    """
    from pydantic_core import SchemaError, SchemaValidator, core_schema

    try:
        schema = core_schema.str_schema(pattern=pattern, regex_engine="rust-regex")
        matches = SchemaValidator(schema).isinstance_python
    except SchemaError as error:
        raise ValueError(str(error).splitlines()[-1].strip().removeprefix("error: ")) from None
    return lambda text: matches(text.encode(errors="replace").decode())


def says_words(words: str) -> Callable[[str], object]:
    """Return whether a text contains words, in capitals or not."""
    folded = words.casefold()
    return lambda text: folded in text.casefold()


# Conditions that compare an event with what was before it.


NOT_THERE = "(not there)"


class TimeCondition(ActiveCondition):
    """Before the first event at a time of the run or after it."""

    def __init__(self, time: TimeInRun, moment: PausedRun) -> None:
        self._time_ns = time.stamp_ns(moment.start_ns)
        self._is_past = moment.stamp_ns >= self._time_ns

    def before(self, view: EventView) -> str:
        """Compare with the event's time; nodes may be constructed at another."""
        if self._is_past or view.stamp_ns < self._time_ns or view.kind == EventKind.CONSTRUCT:
            return ""
        self._is_past = True
        return f"{format_seconds(view.stamp_ns - view.start_ns)} s"


class WatchCondition(ActiveCondition):
    """After an event in which the value of an expression has changed.

    A value is known by its hash: two equal lists are the same, however they were made.
    """

    def __init__(self, expression: Expression, moment: PausedRun) -> None:
        from rsltrace.guard.state.hashing import StateHasher  # which loads numpy

        self._expression = expression
        self._hasher = StateHasher()
        self._hash, self._shown = self._now(moment)

    def after(self, view: EventView) -> str:
        before_hash, before = self._hash, self._shown
        self._hash, self._shown = self._now(view)
        if self._hash == before_hash:
            return ""
        return f"{self._expression.text}: {before} -> {self._shown}"

    def _now(self, moment: PausedRun) -> tuple[int, str]:
        try:
            value = self._expression.value(moment)
        except Exception as error:
            self.note = error_text(error)
            return 0, NOT_THERE
        self.note = ""
        try:
            found = self._hasher.digest(value, self._expression.text)
        except Exception as error:  # an attribute that raises when it is looked at
            self.note = error_text(error)
            return 0, shown(value)
        return found, shown(value)


class WhenCondition(ActiveCondition):
    """After the event with which an expression becomes true."""

    def __init__(self, expression: Expression, moment: PausedRun) -> None:
        self._expression = expression
        self._is_true = self._now(moment)

    def after(self, view: EventView) -> str:
        """See whether it was not before, and is now."""
        was_true, self._is_true = self._is_true, self._now(view)
        return f"{self._expression.text} is true now" if self._is_true and not was_true else ""

    def _now(self, moment: PausedRun) -> bool:
        try:
            value: Any = self._expression.value(moment)
            found = bool(value)
        except Exception as error:
            self.note = error_text(error)
            return False
        self.note = ""
        return found
