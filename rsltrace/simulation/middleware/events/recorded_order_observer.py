"""Check that a run follows a recording's order, event by event.

A policy only sees its candidates. Whether an event is the recorded one shows when it is over,
whoever ran it: the loop, or one of the user's own executors.
"""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.simulation.loop.loop import NOTHING_LEFT
from rsltrace.simulation.loop.recorded_order import RecordedEvent, RecordedOrder, event_text
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.model.texts import format_seconds


class RecordedOrderObserver(EventObserver):
    """Compares the events of a run with a recording; the first difference ends the run.

    ``is_whole``: the recording is complete.
    """

    order = ObserverOrder.RECORDED_ORDER

    def __init__(self, dispatcher: Dispatcher, order: RecordedOrder, *, is_whole: bool) -> None:
        self._dispatcher = dispatcher
        self.policy = order
        self._is_whole = is_whole
        self._last: tuple[int, RecordedEvent] | None = None
        self._is_beyond = False
        self._other_time: tuple[int, RecordedEvent, int] | None = None
        dispatcher.add_observer(self)

    def after_event(self) -> None:
        loop, order = self._dispatcher.loop, self.policy
        event, outcome = self._dispatcher.event, self._dispatcher.outcome
        index, kind, entity, handle = loop.events - 1, event.kind, event.entity, event.handle
        if outcome.ended_after is not None or outcome.error is not None:
            return
        expected = order.event(index)
        if expected is None:
            self._is_beyond = True
            return
        self._last = index, expected
        name = order.name_of(entity)
        if kind != expected.kind or name not in (None, expected.name):
            if handle is not None and (name is None or not entity):
                name = handle.describe()
            here = f"here it was {event_text(kind, name or 'something else', loop.stamp)}"
            error = order.cannot_follow(index, expected, here)
            outcome.error = error
            loop.stop(Stop("the recorded order cannot be followed", error.exit_code))
        elif loop.now_ns != expected.stamp_ns and self._other_time is None:
            self._other_time = index, expected, loop.stamp

    def notes(self) -> Iterator[str]:
        """Yield how the run differs from the recorded one."""
        loop, file = self._dispatcher.loop, self.policy.file
        if self._other_time is not None:
            index, expected, now_ns = self._other_time
            yield (
                f"the run follows the order of {file}, but not its times: event {index} is "
                f"{expected} there, and at {format_seconds(now_ns)} s here"
            )
        if self._is_beyond and self._last is not None:
            index, event = self._last
            end = "ends with" if self._is_whole else "was cut off after"
            yield (
                f"{file} {end} its event {index} ({event}); from there on this run was first "
                "come, first served"
            )
        ended_after = self._dispatcher.outcome.ended_after
        count = loop.events if ended_after is None else ended_after
        following = None if self._is_beyond else self.policy.event(count)
        stopped = loop.stopped
        if following is not None and (
            following.stamp_ns < loop.now_ns
            or (stopped is not None and stopped.reason == NOTHING_LEFT)
        ):
            yield (f"the run ended before {file} did: its event {count}, {following}, has not come")
