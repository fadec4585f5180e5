"""The filter language: reading it, and saying where it is wrong.

    node:/ekf kind:timer,sub time:1.5..2 -topic:/tf      all must hold; ``-`` turns one around
    (level:warn or is:raised) text:"too far"             alternatives, brackets, quotes
    where:"/odom: x > 1"      /odom: x > 1                a condition, as of a breakpoint
    plan                                                 a bare word: in names, logs, exceptions

``docs/view.md`` explains the fields; ``query_fields`` has the list of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from rsltrace.checks.conditions.names import is_about_messages
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.query.conditions import EventFilter
from rsltrace_viewer.model.query.fields import FIELDS, MessageText, bare_word
from rsltrace_viewer.model.query.tokens import QueryError, Token, tokens
from rsltrace_viewer.model.run import Run

# What a filter that is being typed could become.

Choices = Mapping[str, Callable[[], list[str]]]
"""What could follow each field."""


def completions(text: str, run: Run) -> list[str]:
    """Return what ``text`` could become by finishing its last word, most likely first."""
    return complete(text, {name: partial(field.choices, run) for name, field in FIELDS.items()})


def complete(text: str, fields: Choices) -> list[str]:
    """Return what ``text`` could become in a language with these fields."""
    head, word = _last_word(text)
    sign = "-" if word.startswith("-") else ""
    name, colon, value = word[len(sign) :].partition(":")
    if not colon:
        if not name:
            return []
        return [f"{head}{sign}{field}:" for field in fields if field.startswith(name.lower())]
    find = fields.get(name.lower())
    if find is None:
        return []
    done, comma, last = value.rpartition(",")
    choices = find()
    folded = last.casefold()
    begins = [c for c in choices if c.casefold().startswith(folded)]
    contains = [c for c in choices if folded and folded in c.casefold() and c not in begins]
    # What is completed in place must continue what was typed; the rest is offered as a list.
    return [f"{head}{sign}{name}:{done}{comma}{choice}" for choice in begins + contains]


def _last_word(text: str) -> tuple[str, str]:
    start = max(text.rfind(" "), text.rfind("(")) + 1
    return text[:start], text[start:]


T = TypeVar("T")


@dataclass(frozen=True)
class Language(Generic[T]):
    """What the terms of a filter mean: of its ``fields`` by name, of a ``bare`` word, and of terms
    taken together. All of these raise QueryError."""

    fields: Mapping[str, Callable[[Token], T]]
    bare: Callable[[Token], T]
    negated: Callable[[T], T]
    all_of: Callable[[Sequence[T]], T]
    any_of: Callable[[Sequence[T]], T]


def parse(text: str, run: Run) -> EventFilter | None:
    """Return the condition that ``text`` stands for in a trace; None if it is empty.

    Raises QueryError.
    """
    return read(
        text,
        Language[EventFilter](
            {name: partial(field.read, run) for name, field in FIELDS.items()},
            partial(bare_word, run),
            conditions.Not,
            lambda parts: conditions.All(tuple(sorted(parts, key=_cost))),
            lambda parts: conditions.Any(tuple(parts)),
        ),
    )


def read(text: str, language: Language[T]) -> T | None:
    """Return what ``text`` stands for in a language; None if it is empty. Raises QueryError."""
    where = language.fields.get("where")
    if where is not None and is_about_messages(text):
        quoted = re.sub(r'(["\\])', r"\\\1", text.strip())
        return where(Token(f'"{quoted}"', len(text) - len(text.lstrip()) - 1))
    try:
        return _Parser(text, language).whole()
    except RecursionError:
        raise QueryError("brackets and negations are nested too deeply", 0, len(text)) from None


class _Parser(Generic[T]):
    """Reads ``or`` of ``and`` of terms, by recursive descent."""

    def __init__(self, text: str, language: Language[T]) -> None:
        self._tokens = tokens(text)
        self._length = len(text)
        self._place = 0
        self._language = language

    def whole(self) -> T | None:
        if not self._tokens:
            return None
        condition = self._alternatives()
        token = self._peek()
        if token is not None:
            raise QueryError("there is no opening bracket for this", token.start, token.end)
        return condition

    def _peek(self) -> Token | None:
        return self._tokens[self._place] if self._place < len(self._tokens) else None

    def _alternatives(self) -> T:
        parts = [self._conjunction()]
        while (token := self._peek()) is not None and token.text.lower() == "or":
            self._place += 1
            parts.append(self._conjunction())
        return parts[0] if len(parts) == 1 else self._language.any_of(parts)

    def _conjunction(self) -> T:
        parts: list[T] = []
        while (token := self._peek()) is not None and token.text.lower() not in ("or", ")"):
            if token.text.lower() == "and":
                self._place += 1
                continue
            parts.append(self._term())
        if not parts:
            token = self._peek()
            start = token.start if token else self._length
            raise QueryError("something to look for is missing here", start, start + 1)
        return parts[0] if len(parts) == 1 else self._language.all_of(parts)

    def _term(self) -> T:
        token = self._peek()
        if token is None:
            raise QueryError(
                "something to look for is missing here", self._length, self._length + 1
            )
        self._place += 1
        if token.text.lower() == "not" or token.text == "-":
            return self._language.negated(self._term())
        if token.text == "(":
            inner = self._alternatives()
            closing = self._peek()
            if closing is None:
                raise QueryError("this bracket is not closed", token.start, token.end)
            self._place += 1
            return inner
        if token.text == ")":
            raise QueryError("there is no opening bracket for this", token.start, token.end)
        if token.text.startswith("-"):
            inner = self._condition(Token(token.text[1:], token.start + 1))
            return self._language.negated(inner)
        return self._condition(token)

    def _condition(self, token: Token) -> T:
        name, colon, _ = token.text.partition(":")
        if not colon or '"' in name or "/" in name:
            return self._language.bare(token)
        field = self._language.fields.get(name.lower())
        if field is None:
            known = ", ".join(self._language.fields)
            raise QueryError(
                f"there is no field {name!r}; there are {known}",
                token.start,
                token.start + len(name),
            )
        rest = Token(token.text[len(name) + 1 :], token.start + len(name) + 1)
        if not rest.text:
            raise QueryError(f"a value is missing after {name}:", rest.start, rest.start + 1)
        return field(rest)


def _cost(condition: EventFilter) -> int:
    """Numbers first, then logs, then decoded messages."""
    if isinstance(condition, (MessageText, conditions.Where)):
        return 3
    if isinstance(condition, conditions.WithOutput) and condition.accept is not None:
        return 2
    if isinstance(condition, conditions.Not):
        return _cost(condition.inner)
    if isinstance(condition, (conditions.All, conditions.Any)):
        return max(map(_cost, condition.parts))
    return 0 if isinstance(condition, conditions.Between) else 1
