"""From a text to a condition.

    812                                     before event 812
    t=2.5s                                  before the first event at 2.5 s or later
    node /ekf    entity /scan               before an event of a node, of an entity (name, #number)
    topic /odom                             a message is sent (after), or received (before)
    /odom: pose.pose.position.x > 3         the same, of a message whose fields say so
    /odom.pose.pose.position.x > 3          (or so)
    output 3f2a                             after an event with such an output hash
    exception ValueError                    after an event that raised; without a type, anything
    log warn /too far/                      after a log record of a level or worse, of a text
    finding clock                           after an event in which the guard found something
    watch ekf.P[0][0]                       after an event that changes a value
    when node("ekf").P[0][0] > 1            after the event that makes it true

``… if EXPRESSION`` behind any of them but the last two has to be true as well. Names are those of
the viewer's filters: ``/x`` is exactly that, ``x`` is contained, ``*`` makes a pattern.
``node:/ekf`` is the same as ``node /ekf``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

from rsltrace.checks.conditions.condition import ActiveCondition, EventCondition
from rsltrace.checks.conditions.expressions import parse_expression
from rsltrace.checks.conditions.names import RunNames, topic_of, with_topic_prefix
from rsltrace.checks.conditions.occurrences import (
    EntityCondition,
    ExceptionCondition,
    FilteredCondition,
    FindingCondition,
    HashCondition,
    IndexCondition,
    LogCondition,
    NodeCondition,
    TimeCondition,
    TopicCondition,
    WatchCondition,
    WhenCondition,
    says_pattern,
    says_words,
)
from rsltrace.checks.conditions.view import PausedRun
from rsltrace.errors import ConditionError, did_you_mean
from rsltrace.job.values.times import parse_time_in_run
from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.words.entities import LOG_LEVELS, is_named

_HEAD = re.compile(r"([A-Za-z_]+)(?:\s*[:=]\s*|\s+|\Z)")
_MESSAGE = re.compile(r"([/A-Za-z_*?~][^\s:]*)\s*:(?!:)\s*")
_IF = re.compile(r"\bif\b")
_TYPE = re.compile(r"[A-Za-z_][\w.]*")
_HASH = re.compile(r"([0-9a-fA-F]{1,16})(?:…|\.\.\.)?")
_WORDS = {
    "event": "index",
    "t": "time",
    "hash": "output",
    "raised": "exception",
    "raise": "exception",
    "level": "log",
    "guard": "finding",
}
"""Other words for the same."""

_Arm = Callable[[PausedRun], ActiveCondition]


def parse_condition(text: str, names: RunNames | None = None) -> EventCondition:
    """Read a condition; ``names`` are those of the run, as far as they are known.

    :raises ConditionError: naming the place in the text, and what was probably meant.
    """
    return _ConditionParser(text, names or RunNames()).read()


class _ConditionParser:
    def __init__(self, text: str, names: RunNames) -> None:
        self._text = text
        self._names = names
        self._at = len(text) - len(text.lstrip())

    def read(self) -> EventCondition:
        text = self._text
        if not text.strip():
            raise self._wrong("where to stop? Say an event (812), a time (t=2.5s), node /name, …")
        if (digits := re.compile(r"\d+\b(?!\.)").match(text, self._at)) is not None:
            return self._index(digits.group())
        head = _HEAD.match(text, self._at)
        word = "" if head is None else _WORDS.get(head[1].lower(), head[1].lower())
        read = _READERS.get(word)
        if head is not None and read is not None:
            self._at = head.end()
            return read(self)
        if (message := _MESSAGE.match(text, self._at)) is not None:
            return self._message(message)
        rewritten = with_topic_prefix(text)
        if rewritten != text.strip() and topic_of(rewritten) is not None and "." in text:
            return _ConditionParser(rewritten, self._names).read()
        return self._bare()

    # -- by their first word -----------------------------------------------------------------------

    def _index(self, digits: str = "") -> EventCondition:
        if not digits:
            digits = self._value("the number of an event")
            if not digits.isdecimal() or not digits.isascii():
                raise self._wrong(f"{digits!r} is no number of an event", len(digits))
        if len(digits) > 19:
            raise self._wrong("no run has so many events", len(digits))
        self._at += len(digits)
        index = int(digits)
        return self._end(lambda moment: IndexCondition(index), before=True)

    def _time(self) -> EventCondition:
        value = self._value("a time")
        rest = re.compile(r"\s*(ns|us|ms|s|min|h)\b").match(self._text, self._at + len(value))
        if rest is not None:  # 2.5 s
            value = self._text[self._at : rest.end()]
        try:
            time = parse_time_in_run(value)
        except ValueError as error:
            raise self._wrong(str(error), len(value)) from None
        self._at += len(value)
        return self._end(partial(TimeCondition, time), before=True)

    def _node(self) -> EventCondition:
        name = self._name(self._names.nodes, "node")
        return self._end(lambda moment: NodeCondition(name), before=True)

    def _entity(self) -> EventCondition:
        value = self._value("a name")
        is_number = value.startswith("#") and value[1:].isdecimal()
        name = self._name(self._names.entities, "entity", check=not is_number)
        return self._end(lambda moment: EntityCondition(name), before=True)

    def _topic(self) -> EventCondition:
        text = self._text
        if (message := _MESSAGE.match(text, self._at)) is not None:
            return self._message(message)
        name = self._name(self._names.topics, "topic or service")
        self._skip_blanks()
        if (found := _IF.match(text, self._at)) is not None:
            return self._of_messages(name, found.end())
        reads = frozenset({"received", "sent"})
        return self._end(lambda moment: TopicCondition(text, name), reads, before=True, after=True)

    def _message(self, head: re.Match[str]) -> EventCondition:
        self._name(self._names.topics, "topic or service", head[1])
        return self._of_messages(head[1], head.end())

    def _of_messages(self, name: str, at: int) -> EventCondition:
        """Return the condition of a message on a topic, with the expression that begins there."""
        text = self._text
        found = {i for topic, i in self._names.interfaces.items() if is_named(name, topic)}
        expression = parse_expression(
            text[at:],
            self._names,
            whole=text,
            begin=at,
            interface=found.pop() if len(found) == 1 else "",
            has_own=True,
        )
        return EventCondition(
            text.strip(),
            before=True,
            after=True,
            reads=frozenset({"received", "sent", "nodes"}),
            arm=lambda moment: TopicCondition(text, name, expression),
        )

    def _output(self) -> EventCondition:
        value = self._value("the first digits of a hash")
        found = _HASH.fullmatch(value)
        if found is None:
            raise self._wrong("a hash has 1 to 16 digits of 0-9 and a-f", len(value))
        self._at += len(value)
        digits = found[1].lower()
        return self._end(lambda moment: HashCondition(digits), frozenset({"sent"}), after=True)

    def _exception(self) -> EventCondition:
        found = _TYPE.match(self._text, self._at)
        name = "" if found is None or found[0] == "if" else found[0]
        self._at += len(name)
        return self._end(lambda moment: ExceptionCondition(name), frozenset({"sent"}), after=True)

    def _log(self) -> EventCondition:
        level = 0
        found = _TYPE.match(self._text, self._at)
        if found is not None and found[0].lower() in LOG_LEVELS:
            level = LOG_LEVELS[found[0].lower()]
            self._at = found.end()
            self._skip_blanks()
        says = self._log_text()
        return self._end(lambda moment: LogCondition(level, says), frozenset({"sent"}), after=True)

    def _finding(self) -> EventCondition:
        sources = [source.value for source in NondeterminismSource]
        found = _TYPE.match(self._text, self._at)
        name = "" if found is None or found[0] == "if" else found[0].lower()
        if name and name not in sources:
            hint = did_you_mean(name, sources, f"there are {', '.join(sources)}")
            raise self._wrong(f"the guard has no kind {name!r}; {hint}", len(name))
        self._at += len(name)
        return self._end(lambda moment: FindingCondition(name), frozenset({"findings"}), after=True)

    def _watch(self) -> EventCondition:
        return self._of_nodes(WatchCondition)

    def _when(self) -> EventCondition:
        return self._of_nodes(WhenCondition)

    def _of_nodes(self, kind: type[WatchCondition] | type[WhenCondition]) -> EventCondition:
        rest = self._text[self._at :]
        expression = parse_expression(rest, self._names, whole=self._text, begin=self._at)
        return EventCondition(
            self._text.strip(),
            before=False,
            after=True,
            reads=frozenset({"nodes"}),
            arm=partial(kind, expression),
        )

    def _bare(self) -> EventCondition:
        """Read a name that stands alone (of a node, a topic or an entity), or a time."""
        value = self._value("where to stop")
        if value[0].isdecimal():
            return self._time()
        names = self._names
        of = {"node": names.nodes, "topic": names.topics, "entity": names.entities}
        found = [kind for kind, known in of.items() if value in known]
        if "node" in found and "topic" in found:
            raise self._wrong(
                f"{value} is a node and a topic: say node {value} or topic {value}", len(value)
            )
        if found:
            return _READERS[found[0]](self)
        if value.startswith("/"):
            every = (*names.nodes, *names.topics, *names.entities)
            wrong = names.unknown(value, every, "node, topic or entity")
            of_what = f"say node {value}, topic {value} or entity {value}"
            wrong = wrong or f"{of_what}; of messages {value}: EXPRESSION"
        else:
            hint = did_you_mean(value.lower(), [*_READERS, *_WORDS], _KNOWN)
            wrong = f"{value!r} is no condition; {hint}"
        raise self._wrong(wrong, len(value))

    # -- pieces ------------------------------------------------------------------------------------

    def _value(self, what: str) -> str:
        """Return the word that comes next, which is ``what``."""
        found = re.compile(r"\S+").match(self._text, self._at)
        if found is None:
            raise self._wrong(f"{what} is missing here", 1)
        return found.group()

    def _name(
        self, known: tuple[str, ...], what: str, name: str = "", *, check: bool = True
    ) -> str:
        name = name or self._value("a name")
        wrong = self._names.unknown(name, known, what) if check else ""
        if wrong:
            raise self._wrong(wrong, len(name))
        self._at += len(name)
        return name

    def _log_text(self) -> Callable[[str], object]:
        text, at = self._text, self._at
        if text[at : at + 1] == "/" and (end := _closing(text, at)) > at:
            try:
                says = says_pattern(text[at + 1 : end])
            except ValueError as error:
                self._at += 1
                message = f"not a regular expression: {error}"
                raise self._wrong(message, end - at - 1) from None
            self._at = end + 1
            return says
        quote = text[at : at + 1]
        if quote in ("'", '"') and (end := text.find(quote, at + 1)) > 0:
            self._at = end + 1
            return says_words(text[at + 1 : end])
        words = _IF.split(text[at:], maxsplit=1)[0]
        self._at += len(words)
        return says_words(words.strip())

    def _skip_blanks(self) -> None:
        while self._text[self._at : self._at + 1].isspace():
            self._at += 1

    def _end(
        self,
        arm: _Arm,
        reads: frozenset[str] = frozenset(),
        *,
        before: bool = False,
        after: bool = False,
    ) -> EventCondition:
        """Return the condition, with ``if …`` if that follows; nothing else may."""
        self._skip_blanks()
        text = self._text
        if self._at < len(text):
            if (found := _IF.match(text, self._at)) is None:
                rest = len(text.rstrip()) - self._at
                only = "only 'if EXPRESSION' can follow here, after a topic also ': EXPRESSION'"
                raise self._wrong(only, rest)
            expression = parse_expression(
                text[found.end() :], self._names, whole=text, begin=found.end(), has_own=True
            )
            inner = arm

            def arm(moment: PausedRun) -> ActiveCondition:
                return FilteredCondition(inner(moment), expression, text)

            reads |= {"received", "nodes"}
        return EventCondition(text.strip(), before, after, reads, arm)

    def _wrong(self, message: str, length: int | None = None) -> ConditionError:
        end = None if length is None else self._at + length
        return ConditionError(message, self._text, self._at, end)


def _closing(text: str, at: int) -> int:
    """Return where the slash is that closes a regular expression: before the end, or before
    ``if``; -1 if none does."""
    ends = [
        found.start() for found in re.finditer(r"/(?=\s*\Z|\s+if\b)", text) if found.start() > at
    ]
    return ends[0] if ends else -1


_READERS: dict[str, Callable[[_ConditionParser], EventCondition]] = {
    "index": _ConditionParser._index,
    "time": _ConditionParser._time,
    "node": _ConditionParser._node,
    "entity": _ConditionParser._entity,
    "topic": _ConditionParser._topic,
    "output": _ConditionParser._output,
    "exception": _ConditionParser._exception,
    "log": _ConditionParser._log,
    "finding": _ConditionParser._finding,
    "watch": _ConditionParser._watch,
    "when": _ConditionParser._when,
}
_KNOWN = (
    "say an event (812), t=2.5s, node, entity, topic, /topic: EXPRESSION, output, exception, log, "
    "finding, watch or when"
)
