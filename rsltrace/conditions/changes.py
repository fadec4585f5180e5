"""Conditions that compare an event with what was before it."""

from __future__ import annotations

from typing import Any

from rsltrace.conditions.condition import ActiveCondition, error_text, shown
from rsltrace.conditions.expressions import Expression
from rsltrace.conditions.view import EventView, PausedRun
from rsltrace.job.values.times import TimeInRun
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import format_seconds

NOT_THERE = "(not there)"


class TimeCondition(ActiveCondition):
    """Before the first event at a time of the run or after it."""

    def __init__(self, time: TimeInRun, moment: PausedRun) -> None:
        self._time_ns = time.stamp_ns(moment.start_ns)
        self._is_past = moment.stamp_ns >= self._time_ns

    def before(self, view: EventView) -> str:
        """Compare with the event's time; nodes may be constructed at another."""
        if self._is_past or view.stamp_ns < self._time_ns or view.kind == EventKind.CONSTRUCT:
            return ""
        self._is_past = True
        return f"{format_seconds(view.stamp_ns - view.start_ns)} s"


class WatchCondition(ActiveCondition):
    """After an event in which the value of an expression has changed.

    A value is known by its hash: two equal lists are the same, however they were made.
    """

    def __init__(self, expression: Expression, moment: PausedRun) -> None:
        from rsltrace.guard.state.hashing import StateHasher  # which loads numpy

        self._expression = expression
        self._hasher = StateHasher()
        self._hash, self._shown = self._now(moment)

    def after(self, view: EventView) -> str:
        before_hash, before = self._hash, self._shown
        self._hash, self._shown = self._now(view)
        if self._hash == before_hash:
            return ""
        return f"{self._expression.text}: {before} -> {self._shown}"

    def _now(self, moment: PausedRun) -> tuple[int, str]:
        try:
            value = self._expression.value(moment)
        except Exception as error:
            self.note = error_text(error)
            return 0, NOT_THERE
        self.note = ""
        try:
            found = self._hasher.digest(value, self._expression.text)
        except Exception as error:  # an attribute that raises when it is looked at
            self.note = error_text(error)
            return 0, shown(value)
        return found, shown(value)


class WhenCondition(ActiveCondition):
    """After the event with which an expression becomes true."""

    def __init__(self, expression: Expression, moment: PausedRun) -> None:
        self._expression = expression
        self._is_true = self._now(moment)

    def after(self, view: EventView) -> str:
        """See whether it was not before, and is now."""
        was_true, self._is_true = self._is_true, self._now(view)
        return f"{self._expression.text} is true now" if self._is_true and not was_true else ""

    def _now(self, moment: PausedRun) -> bool:
        try:
            value: Any = self._expression.value(moment)
            found = bool(value)
        except Exception as error:
            self.note = error_text(error)
            return False
        self.note = ""
        return found
