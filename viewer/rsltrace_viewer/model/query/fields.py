"""The fields of the filter language: what each means, how its value is read, what completes it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import ConditionError, TraceError, near_or_all
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.values.times import parse_time_in_run
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.entity import WITH_TOPIC
from rsltrace.trace.model.event import NO_SEQUENCE, EventFlag, EventKind, OutputKind
from rsltrace.trace.segments import output_of
from rsltrace.trace.words.entities import LOG_LEVELS, SHORT_KINDS, is_named
from rsltrace.trace.words.phrases import seconds_text
from rsltrace_viewer.model.query import conditions
from rsltrace_viewer.model.query.conditions import EventFilter, Mask
from rsltrace_viewer.model.query.tokens import (
    LARGEST,
    QueryError,
    Token,
    alternatives,
    number_range,
    unquoted,
)
from rsltrace_viewer.model.run import Run, Segment

# Text in messages: their bytes are searched first, and only those that hold it are decoded.

_SEGMENTS_KEPT = 64
_POSITIONS = np.uint64(1 << 24)
"""More outputs than an event can have: its index times this, plus the position, names one."""
_WITHOUT = frozenset((OutputKind.ENTITY, OutputKind.DRAW))
_RESUME = np.uint8(int(EventKind.RESUME))
_AROUND_VALUES = frozenset("'\"\\{}[]:,()")
_IN_NUMBERS = frozenset("0123456789.+-_ einfatrulso")
"""What numbers, truth values and nothing are written with; their bytes are other ones."""

_Keys = npt.NDArray[np.uint64]


class MessageText:
    """Events whose input or one of whose outputs has ``folded`` in its decoded text."""

    def __init__(self, folded: str) -> None:
        self._folded = folded
        self._keys = lru_cache(maxsize=_SEGMENTS_KEPT)(self._keys_in)
        self._in_all: dict[int, bool] = {}

    def can_be_in(self, run: Run, number: int) -> bool:
        """Return True: only reading the segment tells."""
        return True

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        events = segment.events
        own = self._keys(run, segment.number)
        found: Mask = np.isin(events["index"], own // _POSITIONS)
        causes = events["cause_event"]
        caused = among & ~found & (events["kind"] != _RESUME) & (causes < np.uint64(run.count))
        if caused.any():
            firsts = run.segments["first_event"]
            numbers = np.searchsorted(firsts, causes[caused], side="right") - 1
            keys = np.concatenate([self._keys(run, n) for n in np.unique(numbers).tolist()])
            wanted = causes * _POSITIONS + events["cause_output"]
            found |= caused & np.isin(wanted, keys)
        return found

    def _keys_in(self, run: Run, number: int) -> _Keys:
        """Return which outputs in a segment have the text; one that cannot be read has none."""
        outputs = run.segment_outputs(number)
        positions = np.arange(len(outputs)) - np.searchsorted(outputs["event"], outputs["event"])
        keys = outputs["event"] * _POSITIONS + positions.astype(np.uint64)
        kept = (outputs["sequence"] != NO_SEQUENCE) & ~np.isin(outputs["kind"], list(_WITHOUT))
        found: list[int] = []
        for sort in np.unique(outputs[kept][["entity", "kind"]]):
            rows = kept & (outputs["entity"] == sort["entity"]) & (outputs["kind"] == sort["kind"])
            places = np.flatnonzero(rows)
            try:
                one = output_of(outputs[places[0]], run.trace.name)
                channel = run.trace.channel_of(one)
                if channel is None:
                    continue
                if not self._is_in_all(run, channel):
                    places = places[self._held(run, channel, outputs["sequence"][places])]
                    sequences = outputs["sequence"][places].tolist()
                    says = (self._says(run, channel, number) for number in sequences)
                    places = places[np.fromiter(says, np.bool_, len(places))]
            except TraceError:
                continue
            found += places.tolist()
        result: _Keys = keys[sorted(found)]
        return result

    def _held(
        self, run: Run, channel: ChannelInfo, sequences: npt.NDArray[np.uint32]
    ) -> npt.NDArray[np.bool_]:
        """Return which messages of a channel may have the text."""
        if not self._is_in_bytes(channel.schema_text):
            return np.ones(len(sequences), dtype=np.bool_)
        bounds = int(sequences.min()), int(sequences.max())
        text = self._folded.encode()
        hits = np.fromiter(run.trace.messages_with_text(channel.id, *bounds, text), np.uint32)
        return np.isin(sequences, hits)

    def _is_in_bytes(self, schema: str) -> bool:
        """Whether bytes tell: no name of a field is meant, no number, and nothing between them."""
        text = self._folded
        return (
            text.isascii()
            and text.isprintable()
            and text == text.strip()
            and not _AROUND_VALUES.intersection(text)
            and not _IN_NUMBERS.issuperset(text)
            and text not in schema.casefold()
            and "wstring" not in schema
        )

    def _is_in_all(self, run: Run, channel: ChannelInfo) -> bool:
        """Whether it is in the name of a field that every message of a channel has."""
        if not self._folded.isidentifier():
            return False
        if channel.id not in self._in_all:
            try:
                _, data = run.trace.message(channel.id, 0)
                names = _names(run.trace.decode(channel, data))
            except TraceError:
                names = iter(())
            self._in_all[channel.id] = any(self._folded in name.casefold() for name in names)
        return self._in_all[channel.id]

    def _says(self, run: Run, channel: ChannelInfo, sequence: int) -> bool:
        from rsltrace.trace.decode import to_plain  # its library takes as long as opening a trace

        try:
            plain = to_plain(run.trace.decode(channel, run.trace.message(channel.id, sequence)[1]))
        except TraceError:  # one that cannot be decoded says nothing of the others
            return False
        return self._folded in str(plain).casefold()


def _names(message: object) -> Iterator[str]:
    """Yield the names of the fields of a decoded message, but for those in its lists."""
    from rsltrace.trace.decode import field_names

    kind: Any = type(message)
    for name in field_names(kind) or ():
        yield name
        yield from _names(getattr(message, name))


def _read_node(run: Run, token: Token) -> EventFilter:
    owners = set()
    for part in alternatives(token):
        matching = {node.id for node in run.nodes if is_named(part.text, node.name)}
        if not matching:
            near = near_or_all(part.text, (node.name for node in run.nodes))
            raise QueryError(f"no node matches{near}", part.start, part.end)
        owners |= matching
    return conditions.of_nodes(run, frozenset(owners))


def _read_entity(run: Run, token: Token) -> EventFilter:
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


def _read_topic(run: Run, token: Token) -> EventFilter:
    found = set()
    for part in alternatives(token):
        matching = {
            e.id
            for e in run.entities.values()
            if e.kind in WITH_TOPIC and is_named(part.text, e.name)
        }
        if not matching:
            near = near_or_all(part.text, run.topics)
            raise QueryError(f"no topic or service matches{near}", part.start, part.end)
        found |= matching
    return conditions.OfEntities(conditions.ids(found), outputs=True)


def _read_type(run: Run, token: Token) -> EventFilter:
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


def _read_kind(run: Run, token: Token) -> EventFilter:
    return conditions.OfKinds(np.array(_choose(token, _kind_choices(), "kind"), dtype=np.uint8))


def _read_out(run: Run, token: Token) -> EventFilter:
    choices = {kind.label: int(kind) for kind in OutputKind}
    kinds = _choose(token, choices, "kind of output")
    return conditions.WithOutput(frozenset(OutputKind(kind) for kind in kinds))


def level_of(token: Token) -> int:
    """Read a level of log records, of several the least. Raises QueryError."""
    return min(_choose(token, LOG_LEVELS, "level"))


def _read_level(run: Run, token: Token) -> EventFilter:
    return conditions.log_at_least(level_of(token))


_STATES: dict[str, EventFilter] = {
    "raised": conditions.RAISED,
    "suspended": conditions.WithFlag(EventFlag.SUSPENDED),
    "silent": conditions.Silent(),
    "finding": conditions.GUARD_FINDING,
}


def _read_is(run: Run, token: Token) -> EventFilter:
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


def time_range(token: Token, start_ns: int, ends: tuple[int, int] | None) -> tuple[int, int]:
    """Read a range of times that count from ``start_ns``; ``ends``: the first and the last there
    is, None if that is not known. Raises QueryError, also for a range without any of these."""
    last_ns = None if ends is None else ends[1]

    def stamp_ns(text: str) -> int:
        return parse_time_in_run(text).stamp_ns(start_ns, last_ns)

    low, high = number_range(token, stamp_ns, "a time")
    if ends is not None and (low > ends[1] or high < ends[0]):
        since = " to ".join(seconds_text(end - start_ns) for end in ends)
        there = " to ".join(f"@{seconds_text(end)}" for end in ends)
        absolute = f", or {there}" if start_ns else ""
        text = f"out of range: times count from the start, {since} s{absolute}"
        raise QueryError(text, token.start, token.end)
    return low, high


def _read_time(run: Run, token: Token) -> EventFilter:
    ends = (run.start_ns, run.end_ns) if run.trace.complete else None
    return conditions.Between("stamp", *time_range(token, run.trace.start_ns, ends))


def _read_index(run: Run, token: Token) -> EventFilter:
    return conditions.Between("index", *number_range(token, whole_number, "an index"))


def _read_hash(run: Run, token: Token) -> EventFilter:
    digits = token.text.lower()
    if not re.fullmatch(r"[0-9a-f]{1,16}", digits):
        raise QueryError("a hash has 1 to 16 digits of 0-9 and a-f", token.start, token.end)
    return conditions.HashBegins(digits)


def _read_text(run: Run, token: Token) -> EventFilter:
    folded = unquoted(token).casefold()
    return conditions.Any((conditions.says(folded), MessageText(folded)))


def _read_where(run: Run, token: Token) -> EventFilter:
    from rsltrace.checks.conditions.trace_events import TraceCondition  # as long as opening a trace

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


def bare_word(run: Run, token: Token) -> EventFilter:
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
    read: Callable[[Run, Token], EventFilter]
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
