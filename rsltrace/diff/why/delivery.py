"""Reasons that concern one message: lost, pushed out of a queue, waiting, late."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise

from rsltrace.diff.why.history import Message
from rsltrace.diff.why.question import Question, Reason
from rsltrace.simulation.loop.timer_queue import ZERO_PERIOD_NS
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import OutputKind, decision_text, encode_decision
from rsltrace.trace.model.finding import decode_drops, decode_waits
from rsltrace.trace.model.operation import TIMER_CANCEL, pack_operation
from rsltrace.trace.model.texts import format_duration, printable

_AT_LINE = re.compile(r" at (\S+:\d+) in ")
_HINT = ", which may be one of the events"


@dataclass(frozen=True)
class LostByLink(Reason):
    sender: str
    how: str
    sent_ns: int

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message = question.message
        if message is None or message.loss is None:
            return None
        what = (question.sender, decision_text(encode_decision(message.loss)), message.sent_ns)
        place = question.place_of(message.sender)
        return cls(*what, question=question, place=place, event=message.event)

    def words(self) -> str:
        sent = f"the message that {self.sender} sent {self.when(self.sent_ns)}"
        return f"{sent} was {self.how} on the way to {self.question.name}"


@dataclass(frozen=True)
class Waiting(Reason):
    """A call that waited until the end of the run held the callback back."""

    text: str
    since_ns: int

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        entity, message = question.entity, question.message
        if message is not None and message.taken is not None:
            return None
        own = f"{question.node.name}: {entity.kind.label} {entity.name} waits "
        for wait in decode_waits(question.history.trace.result):
            held = entity.id in wait.held or wait.text.startswith(own)
            if held and wait.since_ns <= question.until_ns:
                one = next(iter(question.occupations(wait.since_ns, question.end_ns)), None)
                places = _AT_LINE.findall(wait.text)
                text = _AT_LINE.split(wait.text)[0].partition(_HINT)[0]
                place, event = places[-1] if places else "", one.event if one else None
                return cls(text, wait.since_ns, question=question, place=place, event=event)
        return None

    def words(self) -> str:
        return (
            f"{self.question.name} is held back since {self.seconds(self.since_ns)} s: {self.text}"
        )


@dataclass(frozen=True)
class Busy(Reason):
    """Another callback occupied the executor or the callback group for a part of ``late_ns``, and
    ``more`` did."""

    by: str
    verb: str
    from_ns: int
    to_ns: int
    late_ns: int
    more: int

    @classmethod
    def between(cls, question: Question, from_ns: int, to_ns: int) -> Busy | None:
        """Return what kept the callback from running for longest in a stretch of time."""
        found = question.occupations(from_ns, to_ns) if from_ns < to_ns else []
        if not found:
            return None
        one, place = found[0], question.place_of(found[0].entity)
        return cls(
            question.named(one.entity),
            one.verb,
            one.from_ns,
            min(one.to_ns, question.end_ns),
            to_ns - from_ns,
            len(found) - 1,
            question=question,
            place=place,
            event=one.event,
        )

    def clause(self) -> str:
        itself = "an earlier callback of it" if self.by == self.question.name else self.by
        times = f"from {self.seconds(self.from_ns)} s to {self.seconds(self.to_ns)} s"
        more = f", and {self.more} more callbacks" if self.more > 1 else ""
        more = ", and another callback" if self.more == 1 else more
        return f"{itself} {self.verb} {times}{more}"

    def words(self) -> str:
        return f"{self.question.name} was {format_duration(self.late_ns)} late: {self.clause()}"


@dataclass(frozen=True)
class Unfinished(Reason):
    """The callback itself began, and had not ended by then; or at the end of the run, which took
    longer than ever before."""

    since_ns: int

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        until_ns, own, message = question.time_ns, question.entity.id, question.message
        calls = [one for one in question.history.occupations if one.entity == own]
        open_ones = [one for one in calls if one.from_ns <= until_ns < one.to_ns]
        if not open_ones or (message is not None and message.taken != open_ones[0].event):
            return None
        since_ns = open_ones[0].from_ns
        longest_ns = max((c.to_ns - c.from_ns for c in calls if c.to_ns <= until_ns), default=0)
        if question.at_ns is None and until_ns - since_ns <= 2 * longest_ns:
            return None
        event = open_ones[0].event
        return cls(since_ns, question=question, place=question.place, event=event)

    def words(self) -> str:
        ended = f"had not ended {self.when(self.question.time_ns)}"
        return f"{self.question.name} began {self.when(self.since_ns)} and {ended}"


@dataclass(frozen=True)
class PushedOut(Reason):
    """A full queue dropped the message for one sent at ``by_ns``; ``holder``: whose queue."""

    holder: str
    size: int
    sent_ns: int
    by_ns: int
    busy: Busy | None

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message = question.message
        found = None if message is None or message.taken is not None else _pusher(question, message)
        if message is None or found is None:
            return None
        holder, size, by = found
        busy = Busy.between(question, message.arrival_ns, by.arrival_ns)
        place = busy.place if busy else question.place_of(by.sender)
        what = (holder, size, message.sent_ns, by.sent_ns, busy)
        return cls(*what, question=question, place=place, event=by.event)

    def words(self) -> str:
        whose = "its queue" if self.holder == self.question.name else f"the queue of {self.holder}"
        why = f", because {self.busy.clause()}" if self.busy else ""
        return (
            f"{self.question.name} lost the message of {self.seconds(self.sent_ns)} s: {whose} "
            f"(depth {self.size}) was full, and the message of {self.seconds(self.by_ns)} s pushed "
            f"it out{why}"
        )

    def because(self) -> Reason | None:
        return self.busy


def _pusher(question: Question, message: Message) -> tuple[str, int, Message] | None:
    """Return whose queue was full, its depth, and the message that pushed this one out of it."""
    trace = question.history.trace
    made, until_ns = question.history.made_by(question.entity.id), _outage_end(question, message)
    connected = {one.id for one in question.senders if not question.mismatch(one)}
    sent = [m for m in question.messages if m.loss is None and m.event > made]
    sent = [one for one in sent if one.sender in connected]
    drops = [one for one in decode_drops(trace.result) if one.entity == question.entity.id]
    for drop in sorted(drops, key=lambda one: not one.in_outage):
        if drop.in_outage:
            held = [m for m in sent if m.sender == message.sender and m.left_ns < until_ns]
            holder = f"{question.sender} in an outage"
        else:
            held = sorted(sent, key=lambda one: (one.arrival_ns, one.event, one.output))
            held = [one for one in held if one.arrival_ns <= trace.end_ns]
            holder = question.name
        if message in held and held.index(message) + drop.depth < len(held):
            return holder, drop.depth, held[held.index(message) + drop.depth]
    return None


def _outage_end(question: Question, message: Message) -> int:
    """Return the end of the outage in which a message was sent, 0 if there was none."""
    trace, topic = question.history.trace, question.entity.name
    nodes = [question.node.name, trace.node_of(trace.entity(message.sender)).name]
    for one in question.rules("delay", "outages"):
        is_here = not one.get("node") or any(fnmatchcase(name, one["node"]) for name in nodes)
        is_here &= not one.get("topic") or fnmatchcase(topic, one["topic"])
        times = [trace.start_ns + one.get(key, 0) for key in ("from_ns", "to_ns")]
        if is_here and times[0] <= message.left_ns < times[1]:
            return int(times[1])
    return 0


@dataclass(frozen=True)
class RunEnded(Reason):
    """The run ended before the message was received, or before the timer was due."""

    due_ns: int
    stop_reason: str

    is_reason = False

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message = question.message
        if message is None or message.taken is not None:
            return None
        busy = Busy.between(question, message.arrival_ns, question.end_ns)
        return busy or cls.at(question, message.arrival_ns, message.event)

    @classmethod
    def at(cls, question: Question, due_ns: int, event: int | None = None) -> Reason:
        stop_reason = printable(question.history.trace.result.get("stop_reason", "it was cut off"))
        return cls(due_ns, stop_reason, question=question, place=question.place, event=event)

    def words(self) -> str:
        return (
            f"{self.question.name} was due {self.when(self.due_ns)}, and the run ended "
            f"{self.when(self.question.end_ns)}: {self.stop_reason}"
        )


@dataclass(frozen=True)
class Late(Reason):
    """The message was late: its sender's callback took ``took_ns``, the link ``delay_ns``."""

    sender: str
    sent_ns: int
    took_ns: int
    delay_ns: int

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        message = question.message
        if message is None or message.taken is None:
            return None
        took_ns = message.left_ns - message.sent_ns
        delay_ns = message.arrival_ns - message.left_ns
        began_ns = question.history.stamp(message.taken)
        busy = Busy.between(question, message.arrival_ns, began_ns)
        if busy is not None and busy.late_ns >= max(took_ns, delay_ns):
            return busy
        if not took_ns and not delay_ns:
            return None
        what = (question.sender, message.sent_ns, took_ns, delay_ns)
        place = question.place_of(message.sender)
        return cls(*what, question=question, place=place, event=message.taken)

    def words(self) -> str:
        spent = [f"the link took {format_duration(self.delay_ns)}"] if self.delay_ns else []
        spent += [f"its callback took {format_duration(self.took_ns)}"] if self.took_ns else []
        return (
            f"the message that {self.sender} sent {self.when(self.sent_ns)} reached "
            f"{self.question.name} {format_duration(self.took_ns + self.delay_ns)} later: "
            f"{' and '.join(spent)}"
        )


# Reasons why a timer did not run.

_CANCELLED = hash64(pack_operation(TIMER_CANCEL, 0))


@dataclass(frozen=True)
class TimerCancelled(Reason):
    """Cancelled and not reset; ``by`` is empty for one that was created with autostart=False."""

    by: str
    at_ns: int

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        history, timer = question.history, question.entity
        if timer.kind is not EntityKind.TIMER:
            return None
        changes = [
            (event, number)
            for _, event, number in history.outputs_of([timer.id], OutputKind.TIMER)
            if history.stamp(event) <= question.until_ns
        ]
        if not changes and timer.detail.get("autostart") is False:
            return cls("", timer.created_ns, question=question, place=timer.source)
        if not changes or changes[-1][1] != _CANCELLED:
            return None
        event = changes[-1][0]
        by = int(history.events["entity"][event]) or timer.node
        what = (question.named(by), history.stamp(event))
        return cls(*what, question=question, place=question.place_of(by), event=event)

    def words(self) -> str:
        if not self.by:
            return f"{self.question.name} was created with autostart=False, and never reset"
        at = self.when(self.at_ns)
        return f"{self.question.name} was cancelled {at} by {self.by}, and not reset"


@dataclass(frozen=True)
class ClockStands(Reason):
    """The clock of the node follows ``/clock``, which nobody publishes."""

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        if question.entity.kind is not EntityKind.TIMER:
            return None
        name, trace = question.node.name, question.history.trace
        rules = question.rules("clocks")
        rule = next((one for one in rules if fnmatchcase(name, one.get("node") or "*")), None)
        if rule is None or rule.get("source") != "topic":
            return None
        if any(channel.topic == "/clock" for channel in trace.channels.values()):
            return None
        return cls(question=question, place=question.place)

    def words(self) -> str:
        return (
            f"{self.question.name} waits for its clock, which follows /clock: nobody publishes it"
        )


@dataclass(frozen=True)
class TimerGone(Reason):
    """A timer did not run at the time that is asked about, and nothing kept it from running: no
    trace tells when a timer is destroyed."""

    last_ns: int
    period_ns: int

    @classmethod
    def after(cls, question: Question, last_ns: int, period_ns: int) -> Reason | None:
        timer, at_ns = question.entity, question.at_ns
        changed = any(question.history.outputs_of([timer.id], OutputKind.TIMER))
        if at_ns is None or not period_ns or changed or question.rules("clocks"):
            return None
        is_gone = at_ns - last_ns > 2 * period_ns
        return cls(last_ns, period_ns, question=question, place=question.place) if is_gone else None

    def words(self) -> str:
        period = f"its period is {format_duration(self.period_ns)}"
        return (
            f"{self.question.name} was destroyed, or nothing spins its node: it did not run after "
            f"{self.seconds(self.last_ns)} s, and {period}"
        )


class TimerLate:
    """A timer that was ``Busy`` longest, or not due before the end of the run."""

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        history, timer = question.history, question.entity
        period_ns = timer.detail.get("period_ns")
        if timer.kind is not EntityKind.TIMER or not isinstance(period_ns, int):
            return None
        begun_ns = max(timer.created_ns, history.trace.start_ns)
        runs = [history.stamp(one) for one in history.runs_of(timer.id)]
        if not runs and begun_ns + period_ns > question.end_ns:
            return RunEnded.at(question, begun_ns + period_ns)
        gaps = [*pairwise((begun_ns, *runs, question.end_ns))]
        if question.at_ns is not None:
            gaps = [gap for gap in gaps if gap[0] <= question.at_ns][-1:]
        from_ns, to_ns = max(gaps, key=lambda gap: gap[1] - gap[0], default=(0, 0))
        busy = Busy.between(question, from_ns + (period_ns or ZERO_PERIOD_NS), to_ns)
        return busy or TimerGone.after(question, from_ns, period_ns)
