"""Compare a run with a trace, event by event.

A chain hash covers an event and all before it, so one number per event is compared. The first
difference ends the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from rsltrace.simulation.loop.stop import Stop, StopCondition, stop_at
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.format import REPLAY_DIVERGED
from rsltrace.trace.model.event import EventKind

if TYPE_CHECKING:
    from rsltrace.run.session import RunResult, RunSession
    from rsltrace.trace.reader import Trace
    from rsltrace.trace.recorder import Recorder

DIVERGED = Stop(REPLAY_DIVERGED, 1)
_INTERRUPTIONS = {129: "hung up", 130: "interrupted", 143: "terminated"}
BRANCH_END = "as far as the run that it branches off"
_BY_DRIVER = "the driver of the simulation"


class EventVerification(EventObserver):
    """What a run has to do, and how far it has done so.

    ``until`` is how many events to verify, None for all. ``verified`` events were as recorded;
    ``diverged`` says that the next one was not. ``stop`` is with what the verification has ended
    the run, if it has. ``on_first`` is called before event number ``first``.
    """

    order = ObserverOrder.VERIFICATION

    def __init__(
        self,
        trace: Trace,
        until: int | None = None,
        *,
        first: int = 0,
        on_first: Callable[[RunSession], None] | None = None,
    ) -> None:
        self.verified = 0
        self.diverged = False
        self.stop: Stop | None = None
        self.is_last = False
        """Whether the run was ended where the trace's was, from outside of the job."""
        self.has_branched_off = False
        self._trace = trace
        self._limit, self._at_limit = limit_of(trace, until)
        self._on_first = on_first
        self._first = first if on_first is not None else -1
        self._next_mark = self._limit if self._first < 1 else self._first
        self._expected = self._hashes()
        self._session: RunSession
        self._recorder: Recorder

    def attach(self, session: RunSession) -> None:
        dispatcher = session.world.domain.dispatcher
        assert dispatcher.recorder is not None, "a replay is recorded"
        self._session, self._recorder = session, dispatcher.recorder
        dispatcher.add_observer(self)
        if self._first == 0 and self._on_first is not None:
            self._on_first(self._session)

    @property
    def chain_hash(self) -> int:
        """The chain hash of the last verified event, 0 if there is none."""
        return self._trace.event(self.verified - 1).chain_hash if self.verified else 0

    @property
    def end_ns(self) -> int:
        """The time of that event, or the start of the trace."""
        trace = self._trace
        return trace.event(self.verified - 1).stamp_ns if self.verified else trace.start_ns

    def branch_off(self) -> None:
        """Stop comparing: what follows is a branch."""
        self.has_branched_off = True
        self._session.world.domain.dispatcher.remove_observer(self)

    def end_of_branch(self) -> StopCondition | None:
        """Return the stop condition of a branch that would not end by itself."""
        if self._limit < 0:
            return None
        return stop_at(self._trace.event(self._limit - 1).stamp_ns, BRANCH_END)

    def after_event(self) -> None:
        if self._recorder.chain_hash == next(self._expected, None):
            self.verified = verified = self.verified + 1
            if verified == self._next_mark:
                self._at_mark()
        else:
            self.diverged = not (self.is_last or self.interrupted)
            self._end(DIVERGED)

    def _at_mark(self) -> None:
        if self.verified == self._first and self._on_first is not None:
            self._on_first(self._session)
            self._next_mark = self._limit
        if self.verified == self._limit:
            assert self._at_limit is not None
            self.is_last = self._at_limit.reason == self._trace.result.get("stop_reason")
            if self.is_last and self._limit < self._trace.event_count:
                # It was between two steps, perhaps, and time had moved on.
                loop = self._session.loop
                loop.now_ns = max(loop.now_ns, self._trace.event(self._limit).stamp_ns)
            self._end(self._at_limit, go_on=self.is_last)

    @property
    def interrupted(self) -> int:
        """The exit status of a replay that was interrupted, else 0."""
        stopped = self._session.loop.stopped
        if stopped is None or stopped is self.stop:
            return 0
        return stopped.exit_code if _INTERRUPTIONS.get(stopped.exit_code) == stopped.reason else 0

    @property
    def has_cut_short(self) -> bool:
        """Whether the replay ended before its job did."""
        stopped = self._session.loop.stopped
        is_branch_end = stopped is not None and stopped.reason == BRANCH_END
        return self.stop is not None or is_branch_end or self.interrupted != 0

    def _end(self, stop: Stop, *, go_on: bool = False) -> None:
        """End the run. The end of its nodes is compared only if the trace has it (``go_on``)."""
        if self.stop is None:
            self.stop = stop
            self._session.loop.stop(stop)
        if not go_on:  # what follows is no part of the run: its nodes shut down
            dispatcher = self._session.world.domain.dispatcher
            dispatcher.remove_observer(self)
            dispatcher.record(None)

    def _hashes(self) -> Iterator[int]:
        for rows in self._trace.events():
            yield from rows["chain_hash"].tolist()


def interruption(run: RunResult) -> int:
    """Return the exit status of an interrupted run, else 0."""
    return run.exit_code if _INTERRUPTIONS.get(run.exit_code) == run.stop_reason else 0


def limit_of(trace: Trace, until: int | None) -> tuple[int, Stop | None]:
    """Return after how many events a replay ends by itself (-1: never), and why."""
    count, found = trace.event_count, []
    if until is not None and until < count:
        found.append((until, Stop("as far as asked for")))
    outside = None if trace.edits else _first_outside(trace, until)  # else they are edits
    if outside is not None:
        why = f"event {outside} was done by {_BY_DRIVER}, and no trace says how to do it again"
        found.append((outside, Stop(why)))
    if not trace.complete:
        found.append((count, Stop("the trace was cut off there")))
    elif (stop := _from_outside(trace)) is not None:
        found.append((trace.ended_after or count, stop))
    return min(found, key=lambda one: one[0], default=(-1, None))


def _from_outside(trace: Trace) -> Stop | None:
    """Return how the trace's run was ended from outside of its job, if it was."""
    reason, code = trace.result.get("stop_reason", ""), trace.result.get("exit_code", "")
    if reason in _INTERRUPTIONS.values() and code in map(str, _INTERRUPTIONS):
        return Stop(reason, int(code))
    if reason == BRANCH_END or reason.endswith(f"by {_BY_DRIVER}") or reason.startswith(_BY_DRIVER):
        return Stop(reason, int(code) if code.isdecimal() else 0)
    return None


def _first_outside(trace: Trace, until: int | None) -> int | None:
    """Return the first event made by the driver of a ``Simulation``."""
    first = 0
    for rows in trace.events(0, until):
        if len(found := np.flatnonzero(rows["kind"] == EventKind.OUTSIDE)):
            return first + int(found[0])
        first += len(rows)
    return None
