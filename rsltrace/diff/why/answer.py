"""Finds the callback that is meant, and the first reason that holds; tells it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from statistics import median
from typing import Any, NoReturn, Protocol

from rsltrace.diff.why.delivery import (
    ClockStands,
    Late,
    LostByLink,
    PushedOut,
    RunEnded,
    TimerCancelled,
    TimerLate,
    Unfinished,
    Waiting,
)
from rsltrace.diff.why.filters import NoTransform, UnmatchedStamps
from rsltrace.diff.why.graph import (
    CreatedLate,
    IncompatibleQos,
    NodeEnded,
    NoSender,
    NotConstructed,
    NotReceived,
)
from rsltrace.diff.why.history import RunHistory
from rsltrace.diff.why.question import SENDERS, WITH_CALLBACK, Question, Reason, filter_of
from rsltrace.errors import TraceError, near_or_all, nearest
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.finding import decode_unseen, unseen_text
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import nodes_called
from rsltrace.trace.words.events import EventWords
from rsltrace.trace.words.phrases import as_sentence

# Finds the callback that is meant, or why there is none.


_NAMED = (EntityKind.PUBLISHER, *SENDERS)


def find_target(history: RunHistory, node: str, asked: str, at_ns: int | None) -> Question | Reason:
    """Return the question; or a reason, if there is no such callback but should be.

    :raises TraceError: no node, topic or callback has that name, or several have.
    """
    trace = history.trace
    nodes = [one for one in trace.entities.values() if one.kind is EntityKind.NODE]
    called = nodes_called(node, [one.name for one in nodes])
    if not called:
        known = [one.name for one in nodes]
        ends = [one for one in trace.entities.values() if one.name == node]
        if ends:
            at = [trace.node_of(one).name for one in ends if one.kind in WITH_CALLBACK]
            who = ", ".join(dict.fromkeys(at)) or "no node"
            text = f"{node} is not a node; {who} receives it: rsltrace why TRACE NODE {node}"
            raise TraceError(printable(text))
        reason = None if nearest(node, known) else _not_begun(history, node)
        return reason or _fail(trace, "node", node, known)
    if len(set(called)) > 1:
        text = f"{node!r} matches {', '.join(dict.fromkeys(called))}: give the full name"
        raise TraceError(printable(text))
    own = [one for one in nodes if one.name == called[0]]
    ids = {one.id for one in own}
    there = [e for e in trace.entities.values() if e.node in ids and e.kind in WITH_CALLBACK]
    if not asked:
        listed = ", ".join(dict.fromkeys(_names_of(there))) or "none"
        raise TraceError(printable(f"name a topic or callback of {called[0]}; there are {listed}"))
    topic = f"/{asked.lstrip('/')}"
    is_topic = any(e.name == topic and e.kind in _NAMED for e in trace.entities.values())
    found = [one for one in there if _is_meant(one, asked)]
    if not (found or is_topic or asked.startswith("/")):  # a name in the namespace of the node
        found = [one for one in there if f"{topic}/" in f"{one.name}/"]
    if len({filter_of(e) or (e.kind, e.name, e.detail.get("callback")) for e in found}) > 1:
        titles = [": ".join(dict.fromkeys((e.name, _callbacks(e)[-1]))) for e in found]
        listed = ", ".join(
            f"{e.id} ({e.kind.label} {title})" for e, title in zip(found, titles, strict=True)
        )
        text = f"{called[0]} has several {asked}; give a number: {listed}"
        raise TraceError(printable(text))
    if found:
        made = [e for e in found if at_ns is None or e.created_ns <= at_ns]
        return Question(history, (made or found)[-1], at_ns)
    question = Question(history, own[-1], at_ns)
    event = history.made_by(own[-1].id)
    if (raised := question.raised(event)) is not None:
        what = (printable(called[0]), raised[0])
        return NotConstructed(*what, question=question, place=raised[1], event=event)
    there = [one for one in there if not is_built_in(one)]
    received = [one for one in there if one.kind in SENDERS]
    if is_topic:
        last = topic.rpartition("/")[2]
        near = [one for one in received if one.name.rpartition("/")[2] == last] or received
        names = tuple(printable(one.name) for one in near)
        place = next((one.source for one in near if one.source), own[-1].source)
        return NotReceived(printable(topic), names, question=question, place=place)
    return _fail(trace, f"callback of {called[0]}", asked, _names_of(there))


def _names_of(entities: list[Entity]) -> list[str]:
    """Return the topics and callbacks of entities, without those that rclpy made."""
    own = [one for one in entities if not is_built_in(one)]
    callbacks = [str(one.detail.get("callback") or one.name) for one in own]
    return [*(one.name for one in own if one.kind in SENDERS), *callbacks]


def _callbacks(entity: Entity) -> list[str]:
    of = filter_of(entity)
    return [str(entity.detail.get("callback") or entity.name), *([of[0]] if of else [])]


def _is_meant(entity: Entity, asked: str) -> bool:
    callbacks = _callbacks(entity)
    names = {entity.name, str(entity.id), *callbacks, *(c.rpartition(".")[2] for c in callbacks)}
    name = f"/{asked.lstrip('/')}"
    return asked in names or entity.name == name or entity.name.startswith(f"{name}/_action/")


def _not_begun(history: RunHistory, node: str) -> Reason | None:
    """Return why a node of the job was never constructed, None if all were."""
    trace, question = history.trace, Question(history, history.trace.entity(0))
    kinds = history.events["kind"][: history.ended].tolist()
    constructs = [event for event, kind in enumerate(kinds) if kind == EventKind.CONSTRUCT]
    if len(question.rules("nodes")) <= len(constructs):
        return None
    for event in constructs:
        if (raised := question.raised(event)) is not None:
            other = EventWords(trace).node(trace.event(event), trace.outputs_of(event))
            what = (printable(f"/{node.lstrip('/')}"), raised[0], other or "another node")
            return NotConstructed(*what, question=question, place=raised[1], event=event)
    return None


def _fail(trace: Trace, what: str, word: str, names: list[str]) -> NoReturn:
    text = f"has no {what} that is called {word!r}{near_or_all(word, names)}"
    raise TraceError(f"{trace.name} {printable(text)}")


_MISSED_MAX = 100
_DEPTH_MAX = 8


def why(trace: Trace, node: str, asked: str, at_ns: int | None = None) -> Reason:
    """Return why a callback of a node did not run, or ran late.

    :raises TraceError: there is no such node, topic or callback, or its messages are in no trace.
    """
    found = find_target(RunHistory(trace), node, asked, at_ns)
    if isinstance(found, Reason):
        return found
    unseen = decode_unseen(trace.result)
    if found.entity.kind is EntityKind.SUBSCRIPTION and found.entity.name in unseen:
        topic = found.entity.name
        raise TraceError(f"{trace.name} cannot tell: {unseen_text([topic], unseen[topic])}")
    if at_ns is None or at_ns <= trace.end_ns:
        return _solve(found)
    until_then = _solve(replace(found, at_ns=trace.end_ns))
    return until_then if until_then.is_reason else RunEnded.at(found, at_ns)


def _solve(question: Question) -> Reason:
    """Look at the messages that may answer a question; take the first reason that holds."""
    others = []
    for one in _each_message(question):
        reason = _first(one)
        if reason.is_reason:
            return reason
        others.append(reason)
    return others[-1 if question.history.runs_of(question.entity.id) else 0]


def _first(question: Question) -> Reason:
    return next(filter(None, (reason.find(question) for reason in REASONS)))


def _each_message(question: Question) -> Iterator[Question]:
    """Yield the question for each message that may answer it, the likeliest first; last without."""
    history, messages = question.history, question.messages
    if question.entity.kind is EntityKind.CLIENT:
        messages = []
    if question.at_ns is not None:
        sent = [one for one in messages if one.sent_ns <= question.at_ns]
        if sent and not question.is_silent(sent, question.at_ns):
            yield replace(question, message=sent[-1])
        else:
            yield question
        return
    made = history.made_by(question.entity.id)
    missed = [one for one in messages if one.taken is None]
    taken = [one for one in messages if one.taken is not None]
    looked_at = [one for one in missed if one.event > made][:_MISSED_MAX]
    if not taken:
        looked_at += [one for one in missed if one.event <= made][-1:]
    waits = [history.stamp(one.taken or 0) - one.sent_ns for one in taken]
    if waits and max(waits) > 2 * median(waits):
        looked_at.append(taken[waits.index(max(waits))])
    for message in looked_at:
        yield replace(question, message=message)
    yield question


# -- reasons that ask further, or close the list ---------------------------------------------------


@dataclass(frozen=True)
class Silent(Reason):
    """The sender has sent nothing since ``last_ns`` (None: never), because of something else."""

    sender: str
    last_ns: int | None
    cause: Reason | None

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        if question.message is not None or not question.senders or question.depth >= _DEPTH_MAX:
            return None
        history, until_ns = question.history, question.until_ns
        if question.entity.kind is EntityKind.CLIENT:
            return cls._without_response(question)
        sent = [one for one in question.messages if one.sent_ns <= until_ns]
        if sent and not question.is_silent(sent, until_ns):
            return None
        sender = history.trace.entity(sent[-1].sender if sent else question.senders[0].id)
        # Nothing yet: what sends it later, if anything does.
        by = sent[-1] if sent else next(iter(question.messages), None)
        ran = int(history.events["entity"][by.event]) if by else _idle(history, sender.node)
        callback, cause = history.trace.entity(ran), None
        if callback.kind in WITH_CALLBACK:
            asked = Question(history, callback, question.at_ns, depth=question.depth + 1)
            cause = _solve(asked)
            if sent and cause.event is not None and history.stamp(cause.event) < sent[-1].sent_ns:
                cause = _solve(replace(asked, at_ns=until_ns))  # that was before the silence
        if cause is None or isinstance(cause, AsExpected):
            cause = NodeEnded.of_node(question, history.trace.node_of(sender))
        return cls._of(question, sender.id, sent[-1].sent_ns if sent else None, cause)

    @classmethod
    def _without_response(cls, question: Question) -> Reason | None:
        """Return why the last request of a client was not answered, None if it was."""
        history, server = question.history, question.senders[0]
        requests = history.messages([question.entity], server.id)
        requests = [one for one in requests if one.sent_ns <= question.until_ns]
        if not requests:
            return cls._of(question, question.entity.id, None, None)
        received = history.calls_of(question.entity.id)
        if len(received) >= len(requests):
            return None
        last, asked = requests[-1], Question(history, server, question.at_ns)
        if last.taken is not None and not question.is_silent(requests, question.time_ns):
            return None
        cause = _first(replace(asked, message=last, depth=question.depth + 1))
        last_ns = history.stamp(received[-1]) if received else None
        return cls._of(question, server.id, last_ns, cause if cause.is_reason else None)

    @classmethod
    def _of(
        cls, question: Question, sender: int, last_ns: int | None, cause: Reason | None
    ) -> Reason:
        place = cause.place if cause else question.place_of(sender)
        event = cause.event if cause else None
        what = (question.named(sender), last_ns, cause)
        return cls(*what, question=question, place=place, event=event)

    def words(self) -> str:
        when = (
            "" if self.question.at_ns is None else f" until {self.seconds(self.question.at_ns)} s"
        )
        when = when if self.last_ns is None else f" since {self.seconds(self.last_ns)} s"
        why = f", because {self.cause.clause()}" if self.cause else ""
        return f"{self.question.name} got nothing: {self.sender} has sent nothing{when}{why}"

    def because(self) -> Reason | None:
        return self.cause


def _idle(history: RunHistory, node: int) -> int:
    """Return the only callback of a node that never ran, 0 if there are several or none."""
    entities = history.trace.entities.values()
    own = [e for e in entities if e.node == node and e.kind in WITH_CALLBACK and not is_built_in(e)]
    never = [one.id for one in own if not history.runs_of(one.id)]
    return never[0] if len(never) == 1 else 0


@dataclass(frozen=True)
class AsExpected(Reason):
    count: int
    at_ns: int | None

    is_reason = False

    @classmethod
    def find(cls, question: Question) -> Reason:
        history = question.history
        runs = history.calls_of(question.entity.id, question.until_ns)
        event = runs[-1] if runs else None
        what = (len(runs), None if event is None else history.stamp(event))
        return cls(*what, question=question, place=question.place, event=event)

    def words(self) -> str:
        if not self.count:
            runs = self.question.history.runs_of(self.question.entity.id)
            if self.question.at_ns is not None and runs:
                first = self.when(self.question.history.stamp(runs[0]))
                return f"{self.question.name} did not run until then, as expected: first {first}"
            return f"{self.question.name} did not run, and nothing kept it from running"
        last = "" if self.at_ns is None else f", last {self.when(self.at_ns)}"
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"{self.question.name} ran as expected, {times}{last}"


class _Finder(Protocol):
    def find(self, question: Question) -> Reason | None: ...


REASONS: tuple[_Finder, ...] = (
    NoSender,
    IncompatibleQos,
    NodeEnded,
    CreatedLate,
    LostByLink,
    Waiting,
    TimerCancelled,
    ClockStands,
    Unfinished,
    Silent,
    PushedOut,
    RunEnded,
    Late,
    TimerLate,
    UnmatchedStamps,
    NoTransform,
    AsExpected,
)
"""In this order: what keeps everything away comes before what happens to single messages."""


# -- telling it ------------------------------------------------------------------------------------


def sentence(reason: Reason) -> str:
    """Return a reason as one sentence, with the line of code of what is to blame."""
    where = f" ({printable(reason.place)})" if reason.place else ""
    return as_sentence(f"{reason.words()}{where}")


def answer_lines(reason: Reason) -> Iterator[str]:
    """Yield a reason as a sentence, then its evidence."""
    yield sentence(reason)
    yield from (f"  {line}" for line in evidence(reason))


def evidence(reason: Reason) -> Iterator[str]:
    """Yield the lines that show what the trace says, printable."""
    yield from map(printable, _evidence(reason))


def _evidence(reason: Reason) -> Iterator[str]:
    question, history = reason.question, reason.question.history
    if messages := [one for one in question.messages if one.sent_ns <= question.time_ns]:
        by = [history.stamp(one.taken) for one in messages if one.taken is not None]
        taken = sum(stamp <= question.time_ns for stamp in by)
        counts = Counter(one.sender for one in messages).items()
        senders = ", ".join(f"{number} by {question.named(one)}" for one, number in counts)
        yield f"sent: {senders}; received: {taken}"
    yield from reason.evidence()
    inner = reason.because()
    if inner is not None:
        yield from inner.evidence()
    for event in dict.fromkeys(one.event for one in (reason, inner) if one is not None):
        if event is not None:
            entity = int(history.events["entity"][event])
            kind = EventKind(int(history.events["kind"][event])).label
            what = question.named(entity) if entity else kind
            place = f" at {printable(question.place_of(entity))}" if entity else ""
            yield f"event {event}, {reason.seconds(history.stamp(event))} s: {what}{place}"


def as_json(reason: Reason) -> dict[str, Any]:
    """Return a reason, its sentence and the evidence as JSON-compatible values."""
    values = {one.name: getattr(reason, one.name) for one in fields(reason)}
    return {
        "reason": reason.kind,
        "sentence": sentence(reason),
        **{k: v for k, v in values.items() if not is_dataclass(v)},
        "because": as_json(inner) if (inner := reason.because()) is not None else None,
        "evidence": list(evidence(reason)),
    }
