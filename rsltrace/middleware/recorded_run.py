"""Whether a run does what the recording did whose order it follows, event by event.

A policy only sees what it may choose from. That an event is the recording's shows when it is over,
whoever ran it: the loop, or an executor of the user's own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rsltrace.loop.loop import NOTHING_LEFT
from rsltrace.loop.recorded import Recorded, RecordedEvent, event_text
from rsltrace.loop.stop import Stop
from rsltrace.model.stamp import format_seconds

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core


class Following:
    """Compares the events of a run with those of a recording; the first that differs ends it.

    ``is_whole`` says that the recording was not cut off.
    """

    def __init__(self, core: Core, order: Recorded, *, is_whole: bool) -> None:
        self._core = core
        self.order = order
        self._is_whole = is_whole
        self._end_event = core.end_event
        self._last: tuple[int, RecordedEvent] | None = None
        self._is_beyond = False
        self._other_time: tuple[int, RecordedEvent, int] | None = None
        core.end_event = self._compared  # type: ignore[method-assign]

    def _compared(self) -> None:
        """Stand in for ``Core.end_event``: end the event, then see whether it was right."""
        core, order = self._core, self.order
        index, kind, entity = core.loop.events, core.kind, core.current_entity
        handle = core.current_handle
        self._end_event()
        if core.ended_after is not None or core.error is not None:
            return
        expected = order.event(index)
        if expected is None:
            self._is_beyond = True
            return
        self._last = index, expected
        now_ns = core.loop.now_ns
        name = order.name_of(entity)
        if kind != expected.kind or name not in (None, expected.name):
            if handle is not None and (name is None or not entity):
                name = handle.describe()
            here = f"here it was {event_text(kind, name or 'something else', now_ns)}"
            error = order.cannot_follow(index, expected, here)
            core.error = error
            core.loop.stop(Stop("the recorded order cannot be followed", error.exit_code))
        elif now_ns != expected.stamp_ns and self._other_time is None:
            self._other_time = index, expected, now_ns

    def notes(self) -> Iterator[str]:
        """Yield what somebody should know who takes the run for the recorded one."""
        core, file = self._core, self.order.file
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
        count = core.loop.events if core.ended_after is None else core.ended_after
        following = None if self._is_beyond else self.order.event(count)
        stopped = core.loop.stopped
        if following is not None and (
            following.stamp_ns < core.loop.now_ns
            or (stopped is not None and stopped.reason == NOTHING_LEFT)
        ):
            yield (f"the run ended before {file} did: its event {count}, {following}, has not come")
