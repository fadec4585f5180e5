"""The loop: what runs next, and when simulated time moves on.

At simulated time t:

1. release what was scheduled for t, in (time, order of scheduling; bag messages first);
2. run ready events, first the tasks that the last event created, then the ready queue,
   until none is left;
3. run the due timer that is first in the timer queue, then go to 2;
4. when nothing is due: ask the stop conditions, then advance to the next timer or release.

The rules are RSLCPP's (measured, see ``docs/design.md``), except that tasks come first: that is
what rclpy's executors do.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Any, Literal, Protocol

from rsltrace.compiled import LoopFields, core
from rsltrace.errors import LivelockError
from rsltrace.simulation.loop.stop import Progress, Stop, StopCondition, quiet_until_ns
from rsltrace.simulation.loop.timer_queue import NEVER_NS, TimerQueue, TimerState
from rsltrace.trace.model.texts import Stamp, format_seconds


class Dispatchable(Protocol):
    """Something the loop can run. ``dispatch`` must not raise user errors: see ``stop``."""

    def dispatch(self) -> None:
        """Run one event, or none if there is nothing to do any more."""

    def describe(self) -> str:
        """Name it for an error message: ``/listener: subscription /chatter``."""


NOTHING_LEFT = "nothing left to do"
END_OF_TIME = "what is due next is beyond 2**63 ns, where ROS's time ends"
TIME_NS_MAX = 2**63 - 1
ORDER_BAG = 0
ORDER_RELEASE = 1

Release = tuple[Any, ...]
"""Time (ns), order (``ORDER_…``), place in the order of scheduling, the function called with this
tuple, and its arguments. The function returns what is ready now, or None. A message's release also
waits in the queue of its subscription: nearly every event of a run with delays makes one tuple."""


def _act(release: Release) -> None:
    release[4]()


class EventLoop(LoopFields):
    """The state of a simulation in time: clock, ready queue, timers, scheduled releases.

    Attributes read by the middleware on every event: ``now_ns``, ``ready``, ``tasks``, ``events``
    (how many have run), ``activity_ns``. ``scheduled`` is a heap of releases. As long as there are
    fewer events than ``looks_at``, the loop would do nothing now but dispatch the next task or the
    first of ``ready``: the code that now has the stack may do so instead. While it is -1, the loop
    would go on with ``next_arrival``; who does so instead sets ``stepped_ns`` to the time then.

    ``between_steps`` is called between time steps and returns how many events there must have been
    before it is called again. ``gate``, if set, is called between time steps with the time of the
    next one (None: nothing is left); it may switch to another stack and so pause the run. When it
    returns True, something may have been made ready meanwhile, and the loop looks again. Time moves
    on by ``min_step_ns`` at least; what is due in between runs late.
    """

    polls = False
    """Whether executors find out what is ready only at polling points: see ``wait_set.py``."""
    keeps_all = False
    """Whether queues keep all that arrives, however long they may be."""

    def __init__(
        self,
        *,
        start_ns: int,
        timers: TimerQueue,
        stop_conditions: tuple[StopCondition, ...] = (),
        livelock_limit: int = 100_000,
        between_steps: Callable[[], int] | None = None,
    ) -> None:
        self.now_ns = start_ns
        self.start_ns = start_ns
        self.origin_ns = start_ns
        self.events = 0
        self.activity_ns = start_ns
        self.ready: deque[Dispatchable] = deque()
        self.tasks: deque[Dispatchable] = deque()
        self.idle: list[Callable[[], bool]] = []
        self.timers = timers
        self.min_step_ns = 0
        self.stop_conditions = stop_conditions
        self.gate: Callable[[int | None], bool] | None = None
        self.stopped: Stop | None = None
        self.looks_at = -1
        self.stepped_ns = -1
        self._interrupt = False
        self._livelock_limit = livelock_limit
        self._between_steps = between_steps
        self._pause_events = 0
        self._until_events = -1
        self._quiet_ns = -1
        self.scheduled: list[Release] = []
        self.places = itertools.count()
        self.next_place = self.places.__next__

    @property
    def stamp(self) -> Stamp:
        """Simulated time for texts, which count from ``origin_ns``, the start of the run."""
        return Stamp(self.now_ns, self.origin_ns)

    def schedule(
        self, time_ns: int, action: Callable[[], None], *, order: int = ORDER_RELEASE
    ) -> None:
        """Run ``action`` at simulated time ``time_ns`` (at once if that is past)."""
        heappush(self.scheduled, (time_ns, order, self.next_place(), _act, action))

    def schedule_release(
        self, time_ns: int, release: Callable[[Release], Dispatchable | None], *what: object
    ) -> None:
        """Call ``release`` at simulated time ``time_ns``; ``what`` is its tuple from [4] on."""
        heappush(self.scheduled, (time_ns, ORDER_RELEASE, self.next_place(), release, *what))

    def stop(self, stop: Stop) -> None:
        """End the run after the current event. The first call counts."""
        if self.stopped is None:
            self.stopped = stop
        self.halt()

    def halt(self) -> None:
        """Dispatch nothing more: the run is over, remaining stacks only unwind."""
        self._interrupt = True
        self._until_events = self.looks_at = -1

    def stop_after_step(self, stop: Stop) -> None:
        """End the run after the current time step. The first call counts."""
        if self.stopped is None:
            self.stopped = stop
        self._until_events = -1

    def jump(self, time_ns: int) -> None:
        """Set the clock without running what lies between (from construct time to start)."""
        self.now_ns = time_ns
        self.start_ns = self.origin_ns = time_ns
        self.activity_ns = max(self.activity_ns, time_ns)

    def run(self) -> Stop:
        """Run until the run ends; return why."""
        quiet_ns = self._quiet_ns = quiet_until_ns(self.stop_conditions)
        while True:
            self._until_events = self._pause_events
            if self._interrupt or self.stopped is not None:  # maybe just now, by a signal
                self._until_events = -1
            self.run_step()
            if self.stopped is not None:  # by an event, or by a signal at any time
                return self.stopped
            next_ns = self.next_ns()
            if self.gate is not None and self.gate(next_ns):
                continue
            if next_ns is None or next_ns > quiet_ns or self.now_ns >= quiet_ns:
                stop = self._ask_conditions(next_ns)
                if stop is not None:
                    self.stopped = stop
                    return stop
            if next_ns is None:
                self.stopped = Stop(NOTHING_LEFT)
                return self.stopped
            if self.events >= self._pause_events and self._between_steps is not None:
                self._pause_events = self._between_steps()
            if next_ns > self.now_ns:
                if self.min_step_ns:
                    next_ns = self.stepped(next_ns, quiet_ns)
                if next_ns > TIME_NS_MAX:
                    self.stopped = Stop(END_OF_TIME)
                    return self.stopped
                self.now_ns = next_ns

    def stepped(self, next_ns: int, end_ns: int) -> int:
        """Return the next time, at least ``min_step_ns`` from now."""
        at_least_ns = self.now_ns + self.min_step_ns
        return max(next_ns, min(at_least_ns, end_ns) if end_ns > next_ns else at_least_ns)

    def next_timer(self) -> TimerState | None:
        return self.timers.head

    def next_ns(self) -> int | None:
        """Return when the next timer or release is due, or None."""
        timer = self.next_timer()
        release_ns: int | None = self.scheduled[0][0] if self.scheduled else None
        if timer is None or (release_ns is not None and release_ns < timer.deadline_ns):
            return release_ns
        return timer.deadline_ns

    def later_ns(self) -> int | None:
        """Return when the first timer or release is due after now, or None."""
        next_ns = self.next_ns()
        if next_ns is None or next_ns > self.now_ns:
            return next_ns
        times = [release[0] for release in self.scheduled if release[0] > self.now_ns]
        timer = self.timers.due(self.now_ns)[1]
        if timer is not None:
            times.append(timer.deadline_ns)
        return min(times, default=None)

    def run_step(self) -> None:
        """Run everything that is due at the current time.

        Also runs later time steps where no condition has to be checked between them: with delays on
        every link nearly every event is a time step of its own.
        """
        now_ns = self.now_ns
        scheduled = self.scheduled
        tasks = self.tasks
        ready = self.ready
        timers = self.timers
        idle = self.idle
        self.looks_at = -1
        while True:
            # Time steps with one arrival and nothing else due.
            now_ns = self.run_arrivals(now_ns)
            if self.stepped_ns == self.now_ns:
                now_ns, self.stepped_ns = self.stepped_ns, -1
            while scheduled and scheduled[0][0] <= now_ns and not self._interrupt:
                release = heappop(scheduled)
                receiver = release[3](release)
                if receiver is not None:
                    ready.append(receiver)
            limit = self.events + self._livelock_limit
            while True:
                self.looks_at = limit  # first: a signal that comes after this takes it back
                if self._interrupt:
                    break
                if tasks or ready:
                    self.run_ready(limit)
                else:
                    now_ns = self.now_ns  # a callback may have blocked, and time have passed
                    if timers.next_ns <= now_ns:
                        owner: Dispatchable = timers.head.owner  # type: ignore[union-attr, assignment]
                        owner.dispatch()
                    elif not idle or not self._run_idle():
                        break
                if self.events >= limit:
                    if self.now_ns == now_ns:
                        self._livelock(now_ns)
                    now_ns = self.now_ns  # a callback has waited, and time has passed meanwhile
                    limit = self.events + self._livelock_limit
            self.looks_at = -1
            if self.events >= self._until_events:
                return
            if self.now_ns != now_ns:  # a callback has waited, and others have gone on meanwhile
                return
            quiet_ns = -1 if self.gate is not None or self.min_step_ns else self._quiet_ns
            next_ns = timers.next_ns
            if scheduled and scheduled[0][0] < next_ns:
                next_ns = scheduled[0][0]
                if not idle and now_ns < next_ns < quiet_ns:
                    continue  # above
            if next_ns >= quiet_ns or next_ns <= now_ns or next_ns == NEVER_NS:
                return
            self.now_ns = now_ns = next_ns

    def python_next_arrival(self) -> Dispatchable | Literal[False] | None:
        """Move on to the next time step, if it has one arrival and nothing else has to be done or
        checked before; else return False. Return what is to be dispatched now, None for nothing.
        """
        scheduled, ready = self.scheduled, self.ready
        if not scheduled or ready or self.tasks or self.idle or self.gate is not None:
            return False
        next_ns = scheduled[0][0]
        if (
            not self.now_ns < next_ns < self._quiet_ns
            or self.events >= self._until_events
            or self.min_step_ns
            or next_ns >= self.timers.next_ns
        ):
            return False
        release = heappop(scheduled)
        self.now_ns = next_ns
        self.looks_at = -1
        receiver: Dispatchable | None = release[3](release)
        if scheduled and scheduled[0][0] <= self.now_ns:
            if receiver is not None:
                ready.append(receiver)
            return None
        return ready.popleft() if receiver is None and ready else receiver

    def python_run_arrivals(self, now_ns: int) -> int:
        """Dispatch time steps with one arrival; return when the last one was, else ``now_ns``."""
        while (next_one := self.next_arrival()) is not False:
            now_ns = self.now_ns
            if next_one is not None:
                next_one.dispatch()
        return now_ns

    def python_run_ready(self, limit: int) -> None:
        """Dispatch tasks, and what is ready, until none is left or ``limit`` events have run."""
        tasks, ready = self.tasks, self.ready
        while (tasks or ready) and self.events < limit:
            self.looks_at = limit  # first: a signal that comes after this takes it back
            if self._interrupt:
                return
            (tasks or ready).popleft().dispatch()

    if core is None or TYPE_CHECKING:
        next_arrival = python_next_arrival
        run_arrivals = python_run_arrivals
        run_ready = python_run_ready

    def _run_idle(self) -> bool:
        """Let those poll who wait for idle time; return whether one has work now."""
        woken = [poll() for poll in tuple(self.idle)]  # all of them, not just up to the first
        return any(woken)

    def _ask_conditions(self, next_ns: int | None) -> Stop | None:
        if not self.stop_conditions:
            return None
        progress = Progress(self.now_ns, next_ns, self.start_ns, self.events, self.activity_ns)
        for condition in self.stop_conditions:
            stop = condition(progress)
            if stop is not None:
                return stop
        return None

    def _livelock(self, now_ns: int) -> None:
        """Report the callbacks that keep each other going: run a little longer and count."""
        seen: dict[str, int] = {}
        for _ in range(1000):
            timer = self.timers.head
            if self.tasks:
                item = self.tasks.popleft()
            elif self.ready:
                item = self.ready.popleft()
            elif timer is not None and timer.deadline_ns <= now_ns:
                item = timer.owner  # type: ignore[assignment]
            else:
                break
            seen[item.describe()] = seen.get(item.describe(), 0) + 1
            item.dispatch()
        busiest = sorted(seen.items(), key=lambda pair: -pair[1])[:8]
        cycle = "; ".join(name for name, _ in busiest) or "unknown"
        raise LivelockError(
            f"simulated time stands still at {format_seconds(self.stamp)} s after "
            f"{self._livelock_limit} events: these keep each other going: {cycle}. Give one of "
            "them a timer or a delay, or raise livelock_limit in the job if this is meant to end"
        )


__all__ = ["ORDER_BAG", "ORDER_RELEASE", "Dispatchable", "EventLoop", "TimerState"]
