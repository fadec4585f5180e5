"""The filter language for recordings: which messages of which topics are meant.

topic:/scan time:1..2 -text:nan        the fields that messages have; the rest is as for traces
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import islice

import numpy as np
import numpy.typing as npt

from rsltrace.checks.conditions.expressions import parse_expression
from rsltrace.checks.conditions.names import OF_MESSAGE, with_topic_prefix
from rsltrace.checks.conditions.trace_events import StartOfTrace
from rsltrace.diff.bags.source import open_source
from rsltrace.errors import ConditionError, RsltraceError, near_or_all
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.decode import to_plain
from rsltrace.trace.words.entities import LOG_LEVELS, is_named
from rsltrace.trace.words.logs import parse_log
from rsltrace_viewer.model.query.fields import level_of, place_of, time_range, whole_number
from rsltrace_viewer.model.query.parser import Choices, Language, read
from rsltrace_viewer.model.query.tokens import (
    QueryError,
    Token,
    alternatives,
    number_range,
    unquoted,
)
from rsltrace_viewer.model.recordings.recording import Recording, Topic

Mask = npt.NDArray[np.bool_]
FIELDS = {
    "topic": "messages on a topic",
    "type": "messages of a type",
    "time": "seconds since the start: 1.5..2, >3, 20ms",
    "index": "message number on its topic: 100..200",
    "text": "text in the message, decoded",
    "level": "log records of a level or worse",
    "where": 'fields of messages: "/odom: x > 1"',
}
_PER_STEP = 256
_LOG_TYPE = "rcl_interfaces/msg/Log"


@dataclass(frozen=True, slots=True)
class TopicMessages:
    """Some messages of a topic: those from number ``start`` on, as many as ``data`` has."""

    recording: Recording
    topic: Topic
    start: int
    data: Sequence[bytes | None]

    @property
    def end(self) -> int:
        return self.start + len(self.data)

    def all(self, value: bool) -> Mask:
        """Return the same answer for each of them, shape (messages,)."""
        return np.full(len(self.data), value, dtype=np.bool_)

    def each(self, accept: Callable[[bytes], bool], among: Mask) -> Mask:
        """Return the answers of ``accept`` for the bytes of those in ``among``."""
        found = self.all(False)
        for place in np.flatnonzero(among).tolist():
            data = self.data[place]
            found[place] = data is not None and accept(data)
        return found


@dataclass(frozen=True, slots=True)
class TopicCondition:
    """Which messages of a part fulfil something: ``mask(part, among)``, where only those in
    ``among`` need an answer. ``reads``: it looks into messages."""

    mask: Callable[[TopicMessages, Mask], Mask]
    reads: bool = False


def read_filter(text: str, recordings: Sequence[Recording]) -> TopicCondition | None:
    """Return the condition that ``text`` stands for; None if it is empty. Raises QueryError."""
    topics, types = _names(recordings)
    return read(
        text,
        Language[TopicCondition](
            {
                "topic": partial(_named, topics, lambda topic: topic.name, "topic"),
                "type": partial(_named, types, lambda topic: topic.type, "type"),
                "time": partial(_time, recordings),
                "index": _index,
                "text": lambda token: _says(unquoted(token).casefold()),
                "level": _level,
                "where": partial(_where, topics),
            },
            _bare,
            lambda one: TopicCondition(lambda part, among: ~one.mask(part, among), one.reads),
            _all_of,
            _any_of,
        ),
    )


def choices(recordings: Sequence[Recording]) -> Choices:
    """Return what could follow each field."""
    topics, types = _names(recordings)
    known = {"topic": topics, "type": types, "level": list(LOG_LEVELS)}
    return {name: partial(list, known.get(name, [])) for name in FIELDS}


def steps_of(condition: TopicCondition, recording: Recording, topic: Topic) -> Iterator[Mask]:
    """Yield which messages of a topic fulfil a condition, some of them at a time. Messages that
    are not kept in memory are read again. Raises BagError, TraceError."""
    with ExitStack() as stack:
        messages: Iterator[bytes | None] = iter(topic.data)
        if condition.reads and topic.data and topic.data[-1] is None:
            source = stack.enter_context(open_source(recording.path))
            messages = (bytes(found[2]) for found in source.read([topic.number]))
        for start in range(0, len(topic.stamps), _PER_STEP):
            part = TopicMessages(recording, topic, start, list(islice(messages, _PER_STEP)))
            yield condition.mask(part, part.all(True))


def _names(recordings: Sequence[Recording]) -> tuple[list[str], list[str]]:
    topics = [topic for one in recordings for topic in one.topics]
    return sorted({topic.name for topic in topics}), sorted({topic.type for topic in topics})


def _named(names: list[str], of: Callable[[Topic], str], what: str, token: Token) -> TopicCondition:
    wanted = set()
    for part in alternatives(token):
        matching = {name for name in names if is_named(part.text, name)}
        if not matching:
            near = near_or_all(part.text, names)
            raise QueryError(f"no {what} matches{near}", part.start, part.end)
        wanted |= matching
    return TopicCondition(lambda part, among: part.all(of(part.topic) in wanted))


def _time(recordings: Sequence[Recording], token: Token) -> TopicCondition:
    ranges, errors = {}, []
    for one in recordings:
        try:
            ends = (one.start_ns, one.end_ns) if one.done else None
            ranges[one] = time_range(token, one.start_ns, ends)
        except QueryError as error:  # in the other recording something may be then
            errors.append(error)
    if not ranges:
        raise errors[0]

    def between(part: TopicMessages, among: Mask) -> Mask:
        stamps = np.array(part.topic.stamps[part.start : part.end], dtype=np.int64)
        low, high = ranges.get(part.recording, (1, 0))
        found: Mask = (stamps >= low) & (stamps <= min(high, 2**63 - 1))
        return found

    return TopicCondition(between)


def _index(token: Token) -> TopicCondition:
    low, high = number_range(token, whole_number, "an index")

    def between(part: TopicMessages, among: Mask) -> Mask:
        places = np.arange(part.start, part.end, dtype=np.uint64)
        found: Mask = (places >= np.uint64(low)) & (places <= np.uint64(high))
        return found

    return TopicCondition(between)


def _says(folded: str) -> TopicCondition:
    def says(part: TopicMessages, among: Mask) -> Mask:
        def accept(data: bytes) -> bool:
            try:
                return folded in str(to_plain(part.recording.decode(part.topic, data))).casefold()
            except RsltraceError:  # one that cannot be decoded says nothing
                return False

        return part.each(accept, among)

    return TopicCondition(says, reads=True)


def _level(token: Token) -> TopicCondition:
    least = level_of(token)

    def accept(data: bytes) -> bool:
        try:
            return parse_log(data).level >= least
        except ValueError:
            return False

    def logged(part: TopicMessages, among: Mask) -> Mask:
        is_log = part.topic.type == _LOG_TYPE
        return part.each(accept, among) if is_log else part.all(False)

    return TopicCondition(logged, reads=True)


def _where(topics: list[str], token: Token) -> TopicCondition:
    try:
        found = OF_MESSAGE.match(with_topic_prefix(unquoted(token)))
        if found is None:
            raise QueryError("say /topic: EXPRESSION", token.start, token.end)
        if found[1] not in topics:
            near = near_or_all(found[1], topics)
            raise QueryError(f"no topic matches{near}", token.start, token.end)
        expression = parse_expression(found[2], has_own=True)
    except ConditionError as error:
        raise QueryError(error.message, *place_of(token, error)) from None

    def holds(part: TopicMessages, among: Mask) -> Mask:
        if part.topic.name != found[1]:
            return part.all(False)
        start = StartOfTrace(part.recording.start_ns)

        def accept(data: bytes) -> bool:
            try:
                message = part.recording.decode(part.topic, data)
                return bool(expression.value(start, message=message))
            except Exception:  # of this message: what it cannot be evaluated of does not fulfil it
                return False

        return part.each(accept, among)

    return TopicCondition(holds, reads=True)


def _bare(token: Token) -> TopicCondition:
    word = unquoted(token)
    if not word:
        raise QueryError("there is nothing between the quotes", token.start, token.end)
    says = _says(word.casefold())

    def meant(part: TopicMessages, among: Mask) -> Mask:
        if is_named(word, part.topic.name) or is_named(word, part.topic.type):
            return part.all(True)
        return says.mask(part, among) if part.topic.type == _LOG_TYPE else part.all(False)

    return TopicCondition(meant, reads=True)


def _all_of(parts: Sequence[TopicCondition]) -> TopicCondition:
    ordered = sorted(parts, key=lambda one: one.reads)

    def all_of(part: TopicMessages, among: Mask) -> Mask:
        left: Mask = among.copy()
        for one in ordered:
            if not left.any():
                break
            left &= one.mask(part, left)
        return left

    return TopicCondition(all_of, ordered[-1].reads)


def _any_of(parts: Sequence[TopicCondition]) -> TopicCondition:
    ordered = sorted(parts, key=lambda one: one.reads)

    def any_of(part: TopicMessages, among: Mask) -> Mask:
        found = part.all(False)
        for one in ordered:
            found |= one.mask(part, among & ~found)
        return found

    return TopicCondition(any_of, ordered[-1].reads)
