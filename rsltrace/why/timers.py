"""Reasons why a timer did not run."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise

from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.operation import TIMER_CANCEL, pack_operation
from rsltrace.why.delivery import Busy, RunEnded
from rsltrace.why.question import Question
from rsltrace.why.reason import Reason

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
        return Busy.between(question, from_ns + period_ns, to_ns)
