"""The filter language: reading it, saying where it is wrong, completing it.

    node:/ekf kind:timer,sub time:1.5..2 -topic:/tf      all must hold; ``-`` turns one around
    (level:warn or is:raised) text:"too far"             alternatives, brackets, quotes
    plan                                                 a bare word: in names, logs, exceptions

``docs/view.md`` explains the fields; ``FIELDS`` is the list of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from rsltrace.errors import TraceError
from rsltrace.model.event import EventFlag, EventKind, OutputKind
from rsltrace_viewer.model import match
from rsltrace_viewer.model.match import Condition
from rsltrace_viewer.model.run import KIND_WORDS, WITH_TOPIC, Run
from rsltrace_viewer.model.times import parse_time

_LEVELS = {"debug": 10, "info": 20, "warn": 30, "warning": 30, "error": 40, "fatal": 50}
_LARGEST = 2**64 - 1
_TOKEN = re.compile(r'\s+|(?P<bracket>[()])|(?P<word>(?:"(?:\\.|[^"\\])*"?|[^\s()"])+)')


class QueryError(ValueError):
    """A filter that cannot be understood. ``start`` and ``end`` say which characters of it."""

    def __init__(self, message: str, start: int, end: int) -> None:
        super().__init__(message)
        self.start = start
        self.end = max(end, start + 1)


@dataclass(frozen=True, slots=True)
class _Token:
    text: str
    start: int

    @property
    def end(self) -> int:
        return self.start + len(self.text)


def parse(text: str, run: Run) -> Condition | None:
    """Return the condition that ``text`` stands for in a trace; None if it is empty.

    Raises QueryError.
    """
    return _Parser(text, run).whole()


def _tokens(text: str) -> list[_Token]:
    found = []
    position = 0
    while position < len(text):
        matched = _TOKEN.match(text, position)
        assert matched is not None  # one of the three fits any character
        if matched.lastgroup:
            found.append(_Token(matched.group(), position))
        position = matched.end()
    return found


class _Parser:
    """Reads ``or`` of ``and`` of terms, by recursive descent."""

    def __init__(self, text: str, run: Run) -> None:
        self._tokens = _tokens(text)
        self._length = len(text)
        self._place = 0
        self._run = run

    def whole(self) -> Condition | None:
        if not self._tokens:
            return None
        condition = self._alternatives()
        token = self._peek()
        if token is not None:
            raise QueryError("there is no opening bracket for this", token.start, token.end)
        return condition

    def _peek(self) -> _Token | None:
        return self._tokens[self._place] if self._place < len(self._tokens) else None

    def _alternatives(self) -> Condition:
        parts = [self._conjunction()]
        while (token := self._peek()) is not None and token.text.lower() == "or":
            self._place += 1
            parts.append(self._conjunction())
        return parts[0] if len(parts) == 1 else match.Any(tuple(parts))

    def _conjunction(self) -> Condition:
        parts: list[Condition] = []
        while (token := self._peek()) is not None and token.text.lower() not in ("or", ")"):
            if token.text.lower() == "and":
                self._place += 1
                continue
            parts.append(self._term())
        if not parts:
            token = self._peek()
            start = token.start if token else self._length
            raise QueryError("something to look for is missing here", start, start + 1)
        parts.sort(key=_cost)
        return parts[0] if len(parts) == 1 else match.All(tuple(parts))

    def _term(self) -> Condition:
        token = self._peek()
        if token is None:
            raise QueryError(
                "something to look for is missing here", self._length, self._length + 1
            )
        self._place += 1
        if token.text.lower() == "not" or token.text == "-":
            return match.Not(self._term())
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
            return match.Not(self._condition(_Token(token.text[1:], token.start + 1)))
        return self._condition(token)

    def _condition(self, token: _Token) -> Condition:
        name, colon, _ = token.text.partition(":")
        if not colon or '"' in name or "/" in name:
            return _bare_word(self._run, _value(token))
        field = FIELDS.get(name.lower())
        if field is None:
            known = ", ".join(FIELDS)
            raise QueryError(
                f"there is no field {name!r}; there are {known}",
                token.start,
                token.start + len(name),
            )
        rest = _Token(token.text[len(name) + 1 :], token.start + len(name) + 1)
        if not rest.text:
            raise QueryError(f"a value is missing after {name}:", rest.start, rest.start + 1)
        return field.read(self._run, rest)


def _cost(condition: Condition) -> int:
    """Numbers first, then logs, then decoded messages."""
    if isinstance(condition, match.EachEvent):
        return 3
    if isinstance(condition, match.WithOutput) and condition.accept is not None:
        return 2
    if isinstance(condition, match.Not):
        return _cost(condition.inner)
    if isinstance(condition, (match.All, match.Any)):
        return max(map(_cost, condition.parts))
    return 0 if isinstance(condition, match.Between) else 1


def _value(token: _Token) -> str:
    """Return the text without its quotes."""
    text = token.text
    if '"' not in text:
        return text
    if not (text.startswith('"') and text.endswith('"') and len(text) > 1):
        at = token.start + text.index('"')
        raise QueryError("this quote is not closed", at, token.end)
    return re.sub(r"\\(.)", r"\1", text[1:-1])


def _values(token: _Token) -> list[_Token]:
    """Return the alternatives of ``a,b``; a quoted value is one."""
    if token.text.startswith('"'):
        return [_Token(_value(token), token.start)]
    parts = []
    start = token.start
    for part in token.text.split(","):
        if not part:
            raise QueryError("a value is missing here", start, start + 1)
        parts.append(_Token(part, start))
        start += len(part) + 1
    return parts


def _named(pattern: str, name: str) -> bool:
    """Whether a name is meant: a glob matches it whole, ``/x`` is it, ``x`` is contained in it."""
    if any(c in pattern for c in "*?["):
        return fnmatchcase(name, pattern)
    if pattern.startswith("/"):
        return name == pattern
    return pattern.casefold() in name.casefold()


def _read_node(run: Run, token: _Token) -> Condition:
    owners = set()
    for part in _values(token):
        matching = {node.id for node in run.nodes if _named(part.text, node.name)}
        if not matching:
            names = ", ".join(node.name for node in run.nodes[:8])
            raise QueryError(f"no node matches; there are {names}", part.start, part.end)
        owners |= matching
    return match.of_nodes(run, frozenset(owners))


def _read_entity(run: Run, token: _Token) -> Condition:
    found = set()
    for part in _values(token):
        number = part.text.removeprefix("#")
        matching = {
            e.id
            for e in run.entities.values()
            if (e.name and _named(part.text, e.name)) or str(e.id) == number
        }
        if not matching:
            raise QueryError("no entity has such a name or number", part.start, part.end)
        found |= matching
    return match.OfEntities(match.ids(found))


def _read_topic(run: Run, token: _Token) -> Condition:
    found = set()
    for part in _values(token):
        matching = {
            e.id
            for e in run.entities.values()
            if e.kind in WITH_TOPIC and _named(part.text, e.name)
        }
        if not matching:
            names = ", ".join(run.topics[:8])
            raise QueryError(
                f"no topic or service matches; there are {names}", part.start, part.end
            )
        found |= matching
    return match.OfEntities(match.ids(found), outputs=True)


def _read_type(run: Run, token: _Token) -> Condition:
    parts = _values(token)
    found = {
        e.id for e in run.entities.values() if e.type and any(_named(p.text, e.type) for p in parts)
    }
    if not found:
        raise QueryError("no interface of the trace matches", token.start, token.end)
    return match.OfEntities(match.ids(found), outputs=True)


def _choose(token: _Token, choices: dict[str, int], what: str) -> list[int]:
    chosen = []
    for part in _values(token):
        if part.text.lower() not in choices:
            known = ", ".join(choices)
            raise QueryError(f"there is no such {what}; there are {known}", part.start, part.end)
        chosen.append(choices[part.text.lower()])
    return chosen


def _kind_choices() -> dict[str, int]:
    return {kind.label: int(kind) for kind in EventKind} | {
        word: int(kind) for kind, word in KIND_WORDS.items()
    }


def _read_kind(run: Run, token: _Token) -> Condition:
    return match.OfKinds(np.array(_choose(token, _kind_choices(), "kind"), dtype=np.uint8))


def _read_out(run: Run, token: _Token) -> Condition:
    choices = {kind.label: int(kind) for kind in OutputKind}
    kinds = _choose(token, choices, "kind of output")
    return match.WithOutput(frozenset(OutputKind(kind) for kind in kinds))


def _read_level(run: Run, token: _Token) -> Condition:
    return match.log_at_least(min(_choose(token, _LEVELS, "level")))


_STATES: dict[str, Condition] = {
    "raised": match.RAISED,
    "suspended": match.WithFlag(EventFlag.SUSPENDED),
    "silent": match.Silent(),
    "finding": match.GUARD_FINDING,
}


def _read_is(run: Run, token: _Token) -> Condition:
    found = []
    for part in _values(token):
        if part.text.lower() not in _STATES:
            raise QueryError(f"there are {', '.join(_STATES)}", part.start, part.end)
        found.append(_STATES[part.text.lower()])
    return found[0] if len(found) == 1 else match.Any(tuple(found))


def _range(token: _Token, number: Callable[[str], int], what: str) -> tuple[int, int]:
    """Read ``a..b``, ``a..``, ``..b``, ``>a``, ``<b`` or ``a``."""

    def read(text: str, start: int) -> int:
        try:
            return number(text)
        except ValueError as error:
            raise QueryError(f"not {what}: {error}", start, start + max(len(text), 1)) from None

    text = token.text
    if text[0] in "<>":
        skip = 2 if text[1:2] == "=" else 1
        value = read(text[skip:], token.start + skip)
        strict = skip == 1
        return (value + strict, _LARGEST) if text[0] == ">" else (0, max(value - strict, 0))
    low, dots, high = text.partition("..")
    first = read(low, token.start) if low else 0
    if not dots:
        return first, first
    last = read(high, token.start + len(low) + 2) if high else _LARGEST
    if last < first:
        raise QueryError("the end is before the start", token.start, token.end)
    return first, last


def _index(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return min(int(text), _LARGEST)


def _read_time(run: Run, token: _Token) -> Condition:
    return match.Between("stamp", *_range(token, parse_time, "a time"))


def _read_index(run: Run, token: _Token) -> Condition:
    return match.Between("index", *_range(token, _index, "an index"))


def _read_hash(run: Run, token: _Token) -> Condition:
    digits = token.text.lower()
    if not re.fullmatch(r"[0-9a-f]{1,16}", digits):
        raise QueryError("a hash has 1 to 16 digits of 0-9 and a-f", token.start, token.end)
    return match.HashBegins(digits)


def _read_text(run: Run, token: _Token) -> Condition:
    folded = _value(token).casefold()
    return match.Any(
        (match.says(folded), match.EachEvent(lambda run, i: _contains(run, i, folded)))
    )


def _contains(run: Run, index: int, folded: str) -> bool:
    """Whether the input or an output of an event has ``folded`` in its decoded text."""
    from rsltrace.trace.decode import to_plain  # its library takes as long as opening a trace

    try:
        event = run.event(index)
        found = run.input_of(event)
        messages = run.outputs(index) if event.outputs else []
        for output in [found, *messages] if found is not None else messages:
            payload = run.trace.payload(output)
            channel = run.trace.channel_of(output)
            if payload is None or channel is None:
                continue
            plain = to_plain(run.trace.decode(channel, payload[2]))
            if folded in str(plain).casefold():
                return True
    except TraceError:
        pass
    return False


def _bare_word(run: Run, word: str) -> Condition:
    if not word:
        raise QueryError("there is nothing between the quotes", 0, 2)
    named = {
        e.id
        for e in run.entities.values()
        if _named(word, e.name) or _named(word, run.node_name(e.id))
    }
    return match.Any((match.OfEntities(match.ids(named), outputs=True), match.says(word)))


@dataclass(frozen=True, slots=True)
class Field:
    """A field of the language: what it means, how it is read, what can be completed."""

    help: str
    read: Callable[[Run, _Token], Condition]
    choices: Callable[[Run], list[str]] = lambda run: []


FIELDS: dict[str, Field] = {
    "node": Field("events of nodes", _read_node, lambda run: [node.name for node in run.nodes]),
    "topic": Field(
        "events that receive from or send to one",
        _read_topic,
        lambda run: list(run.topics),
    ),
    "kind": Field("timer, sub, srv, client, …", _read_kind, lambda run: list(_kind_choices())),
    "entity": Field(
        "events of an entity, by name or #number",
        _read_entity,
        lambda run: sorted({e.name for e in run.entities.values() if e.name}),
    ),
    "type": Field(
        "events with messages of a type",
        _read_type,
        lambda run: sorted({e.type for e in run.entities.values() if e.kind in WITH_TOPIC}),
    ),
    "time": Field("simulated seconds: 1.5..2, >3, 20ms", _read_time),
    "index": Field("event numbers: 100..200, >5000", _read_index),
    "text": Field("text in messages and logs (slow)", _read_text),
    "level": Field("logs of a level or worse", _read_level, lambda run: list(_LEVELS)),
    "out": Field(
        "events with an output of a kind", _read_out, lambda run: [k.label for k in OutputKind]
    ),
    "is": Field("raised, suspended, silent, finding", _read_is, lambda run: list(_STATES)),
    "hash": Field("first digits of an input or output hash", _read_hash),
}
"""The fields by name."""


def completions(text: str, run: Run) -> list[str]:
    """Return what ``text`` could become by finishing its last word, most likely first."""
    head, word = _last_word(text)
    sign = "-" if word.startswith("-") else ""
    name, colon, value = word[len(sign) :].partition(":")
    if not colon:
        if not name:
            return []
        return [f"{head}{sign}{field}:" for field in FIELDS if field.startswith(name.lower())]
    field = FIELDS.get(name.lower())
    if field is None:
        return []
    done, comma, last = value.rpartition(",")
    choices = field.choices(run)
    folded = last.casefold()
    begins = [c for c in choices if c.casefold().startswith(folded)]
    contains = [c for c in choices if folded and folded in c.casefold() and c not in begins]
    # What is completed in place must continue what was typed; the rest is offered as a list.
    return [f"{head}{sign}{name}:{done}{comma}{choice}" for choice in begins + contains]


def _last_word(text: str) -> tuple[str, str]:
    start = max(text.rfind(" "), text.rfind("(")) + 1
    return text[:start], text[start:]
