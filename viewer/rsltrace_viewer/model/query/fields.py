"""The fields of the filter language: what each means, how its value is read, what completes it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rsltrace.conditions.trace_events import TraceCondition
from rsltrace.errors import ConditionError
from rsltrace.trace.model.entity import WITH_TOPIC
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.words.kinds import SHORT_KINDS
from rsltrace.trace.words.matching import LOG_LEVELS, is_named
from rsltrace.trace.words.times import parse_time_in_run
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.query.conditions import Condition
from rsltrace_viewer.model.query.message_text import MessageText
from rsltrace_viewer.model.query.tokens import (
    LARGEST,
    QueryError,
    Token,
    alternatives,
    number_range,
    unquoted,
)
from rsltrace_viewer.model.run import Run


def _read_node(run: Run, token: Token) -> Condition:
    owners = set()
    for part in alternatives(token):
        matching = {node.id for node in run.nodes if is_named(part.text, node.name)}
        if not matching:
            names = ", ".join(node.name for node in run.nodes[:8])
            raise QueryError(f"no node matches; there are {names}", part.start, part.end)
        owners |= matching
    return conditions.of_nodes(run, frozenset(owners))


def _read_entity(run: Run, token: Token) -> Condition:
    found = set()
    for part in alternatives(token):
        number = part.text.removeprefix("#")
        matching = {
            e.id
            for e in run.entities.values()
            if (e.name and is_named(part.text, e.name)) or str(e.id) == number
        }
        if not matching:
            raise QueryError("no entity has such a name or number", part.start, part.end)
        found |= matching
    return conditions.OfEntities(conditions.ids(found))


def _read_topic(run: Run, token: Token) -> Condition:
    found = set()
    for part in alternatives(token):
        matching = {
            e.id
            for e in run.entities.values()
            if e.kind in WITH_TOPIC and is_named(part.text, e.name)
        }
        if not matching:
            names = ", ".join(run.topics[:8])
            raise QueryError(
                f"no topic or service matches; there are {names}", part.start, part.end
            )
        found |= matching
    return conditions.OfEntities(conditions.ids(found), outputs=True)


def _read_type(run: Run, token: Token) -> Condition:
    parts = alternatives(token)
    found = {
        e.id
        for e in run.entities.values()
        if e.type and any(is_named(p.text, e.type) for p in parts)
    }
    if not found:
        raise QueryError("no interface of the trace matches", token.start, token.end)
    return conditions.OfEntities(conditions.ids(found), outputs=True)


def _choose(token: Token, choices: dict[str, int], what: str) -> list[int]:
    chosen = []
    for part in alternatives(token):
        if part.text.lower() not in choices:
            known = ", ".join(choices)
            raise QueryError(f"there is no such {what}; there are {known}", part.start, part.end)
        chosen.append(choices[part.text.lower()])
    return chosen


def _kind_choices() -> dict[str, int]:
    return {kind.label: int(kind) for kind in EventKind} | {
        word: int(kind) for kind, word in SHORT_KINDS.items()
    }


def _read_kind(run: Run, token: Token) -> Condition:
    return conditions.OfKinds(np.array(_choose(token, _kind_choices(), "kind"), dtype=np.uint8))


def _read_out(run: Run, token: Token) -> Condition:
    choices = {kind.label: int(kind) for kind in OutputKind}
    kinds = _choose(token, choices, "kind of output")
    return conditions.WithOutput(frozenset(OutputKind(kind) for kind in kinds))


def level_of(token: Token) -> int:
    """Read a level of log records, of several the least. Raises QueryError."""
    return min(_choose(token, LOG_LEVELS, "level"))


def _read_level(run: Run, token: Token) -> Condition:
    return conditions.log_at_least(level_of(token))


_STATES: dict[str, Condition] = {
    "raised": conditions.RAISED,
    "suspended": conditions.WithFlag(EventFlag.SUSPENDED),
    "silent": conditions.Silent(),
    "finding": conditions.GUARD_FINDING,
}


def _read_is(run: Run, token: Token) -> Condition:
    found = []
    for part in alternatives(token):
        if part.text.lower() not in _STATES:
            raise QueryError(f"there are {', '.join(_STATES)}", part.start, part.end)
        found.append(_STATES[part.text.lower()])
    return found[0] if len(found) == 1 else conditions.Any(tuple(found))


def whole_number(text: str) -> int:
    """Read a whole number. Raises ValueError."""
    if not text.isdecimal():
        raise ValueError(f"{text!r} is no whole number")
    return min(int(text), LARGEST)


def _read_time(run: Run, token: Token) -> Condition:
    start_ns = run.trace.start_ns

    def stamp_ns(text: str) -> int:
        return parse_time_in_run(text).stamp_ns(start_ns)

    return conditions.Between("stamp", *number_range(token, stamp_ns, "a time"))


def _read_index(run: Run, token: Token) -> Condition:
    return conditions.Between("index", *number_range(token, whole_number, "an index"))


def _read_hash(run: Run, token: Token) -> Condition:
    digits = token.text.lower()
    if not re.fullmatch(r"[0-9a-f]{1,16}", digits):
        raise QueryError("a hash has 1 to 16 digits of 0-9 and a-f", token.start, token.end)
    return conditions.HashBegins(digits)


def _read_text(run: Run, token: Token) -> Condition:
    folded = unquoted(token).casefold()
    return conditions.Any((conditions.says(folded), MessageText(folded)))


def _read_where(run: Run, token: Token) -> Condition:
    try:
        return conditions.Where(TraceCondition(unquoted(token), run.trace))
    except ConditionError as error:
        raise QueryError(error.message, *place_of(token, error)) from None


def place_of(token: Token, error: ConditionError) -> tuple[int, int]:
    """Return where in a filter the part is that a condition is wrong in."""
    at = token.text.find(error.text)
    if at < 0:  # it was written in another way before it was read
        return max(token.start, 0), token.end
    return token.start + at + error.start, token.start + at + error.end


def bare_word(run: Run, token: Token) -> Condition:
    """Return the condition for a word without a field: in names, logs and exceptions."""
    word = unquoted(token)
    if not word:
        raise QueryError("there is nothing between the quotes", token.start, token.end)
    named = {
        e.id
        for e in run.entities.values()
        if is_named(word, e.name) or is_named(word, run.node_name(e.id))
    }
    return conditions.Any(
        (conditions.OfEntities(conditions.ids(named), outputs=True), conditions.says(word))
    )


@dataclass(frozen=True, slots=True)
class Field:
    """A field of the language: what it means, how it is read, what can be completed."""

    help: str
    read: Callable[[Run, Token], Condition]
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
    "text": Field("text in messages and logs", _read_text),
    "level": Field("logs of a level or worse", _read_level, lambda run: list(LOG_LEVELS)),
    "out": Field(
        "events with an output of a kind", _read_out, lambda run: [k.label for k in OutputKind]
    ),
    "is": Field("raised, suspended, silent, finding", _read_is, lambda run: list(_STATES)),
    "hash": Field("first digits of an input or output hash", _read_hash),
    "where": Field('conditions of breakpoints: "/odom: x > 1"', _read_where),
}
"""The fields by name."""
