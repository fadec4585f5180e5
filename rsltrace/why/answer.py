"""Finds the callback that is meant, and the first reason that holds; tells it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from statistics import median
from typing import Any, Protocol

from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import as_sentence, at_time, seconds_text
from rsltrace.why.delivery import Late, LostByLink, PushedOut, RunEnded, Unfinished, Waiting
from rsltrace.why.filters import NoTransform, UnmatchedStamps
from rsltrace.why.graph import (
    CreatedLate,
    IncompatibleQos,
    NodeEnded,
    NoSender,
)
from rsltrace.why.history import RunHistory
from rsltrace.why.question import WITH_CALLBACK, Question
from rsltrace.why.reason import Reason
from rsltrace.why.target import find_target
from rsltrace.why.timers import ClockStands, TimerCancelled, TimerLate

_MISSED_MAX = 100
_DEPTH_MAX = 8


def why(trace: Trace, node: str, asked: str, at_ns: int | None = None) -> Reason:
    """Return why a callback of a node did not run, or ran late.

    :raises TraceError: there is no such node, topic or callback.
    """
    found = find_target(RunHistory(trace), node, asked, at_ns)
    return found if isinstance(found, Reason) else _solve(found)


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
        ran = int(history.events["entity"][sent[-1].event]) if sent else _idle(history, sender.node)
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
            "" if self.question.at_ns is None else f" until {seconds_text(self.question.at_ns)} s"
        )
        when = when if self.last_ns is None else f" since {seconds_text(self.last_ns)} s"
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
            return f"{self.question.name} did not run, and nothing kept it from running"
        last = "" if self.at_ns is None else f", last {at_time(self.at_ns)}"
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
    if messages := question.messages:
        taken = sum(one.taken is not None for one in messages)
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
            yield f"event {event}, {seconds_text(history.stamp(event))} s: {what}{place}"


def as_json(reason: Reason) -> dict[str, Any]:
    """Return a reason, its sentence and the evidence as JSON-compatible values."""
    name = "".join(f"_{c.lower()}" if c.isupper() else c for c in type(reason).__name__)
    values = {one.name: getattr(reason, one.name) for one in fields(reason)}
    return {
        "reason": name.lstrip("_"),
        "sentence": sentence(reason),
        **{k: v for k, v in values.items() if not is_dataclass(v)},
        "because": as_json(inner) if (inner := reason.because()) is not None else None,
        "evidence": list(evidence(reason)),
    }
