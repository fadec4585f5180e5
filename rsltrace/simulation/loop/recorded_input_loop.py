"""Loops that run one entry of a recorded graph with its recorded inputs.

The recorded events are a script. Those of other nodes are steps to perform; those of the nodes that
run here delay what follows them until they have happened. So the nodes meet each input in the state
in which they met it in the recording. An event of theirs that does not come (their code has
changed) is skipped once nothing else is left to do at its time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop
from typing import Any, Protocol

from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.ordered import OrderedLoop, ReadyItem
from rsltrace.simulation.loop.stop import Progress, Stop
from rsltrace.trace.model.event import EventKind

NEVER = 1 << 64
_QOS_EVENT = "qos_event"
_WAITING_KINDS = (
    "subscription",
    "timer",
    "client",
    "service",
    "guard_condition",
    "task",
    _QOS_EVENT,
)


@dataclass(slots=True)
class RecordedStep:
    """A recorded event. ``perform`` repeats it; it is None for an event that happens by itself,
    which recorded ``kind`` and ``entity`` identify."""

    index: int
    stamp_ns: int
    kind: int
    entity: int
    perform: Callable[[], None] | None = None
    done: bool = False


class StepScript(Protocol):
    """The recorded events that matter, in their order."""

    end_ns: int
    """When the recorded run ended."""

    @property
    def next(self) -> RecordedStep | None:
        """The first step that is not done, None after the last."""

    def entity(self, entity: int) -> int:
        """Return the recorded entity that one of the run stands for, -1 if none."""

    def following(self, entity: int) -> int:
        """Return the index of the next event of a recorded entity, NEVER if none is to come."""


def stop_at_recorded_end(script: StepScript, loop: EventLoop) -> Callable[[Progress], Stop | None]:
    """Return the stop condition that ends the run when the recording ends."""

    def condition(progress: Progress) -> Stop | None:
        ahead = progress.next_ns is not None and progress.next_ns < script.end_ns
        if script.next is not None or ahead:
            return None
        loop.now_ns = max(loop.now_ns, script.end_ns)
        return Stop("the end of the recording")

    return condition


class RecordedInputLoop(EventLoop):
    """The plain loop with inputs from ``script``, which is set before it runs."""

    script: StepScript
    by_steps = False
    """Whether time moves on from step to step (``min_time_step``); what is due between is late."""

    def next_ns(self) -> int | None:
        step = self.script.next
        if step is not None and self.by_steps:
            return step.stamp_ns
        return _earlier_ns(super().next_ns(), step)

    def run_step(self) -> None:
        now_ns = self.now_ns
        self._release()
        limit = self.events + self._livelock_limit
        while not self._interrupt and self._do_next():
            if self.events >= limit:
                if self.now_ns == now_ns:
                    self._livelock(now_ns)
                now_ns = self.now_ns
                limit = self.events + self._livelock_limit

    def _release(self) -> bool:
        released = False
        while self.scheduled and self.scheduled[0][0] <= self.now_ns and not self._interrupt:
            release = heappop(self.scheduled)
            receiver = release[3](release)
            if receiver is not None:
                self.ready.append(receiver)
            released = True
        return released

    def _do_next(self) -> bool:
        """Do the next thing that is due; return False if there is none."""
        step = self.script.next
        if step is None and self.now_ns >= self.script.end_ns:
            return False
        if step is not None and step.stamp_ns > self.now_ns:
            step = None
        if self.tasks and self._run_task(step):
            return True
        if step is not None and step.perform is not None:
            step.done = True
            step.perform()
            return True
        if self._dispatch_one(step) or self._release() or (self.idle and self._run_idle()):
            return True
        if step is None:
            return False
        step.done = True  # what should have happened does not: the code has changed
        return True

    def _run_task(self, step: RecordedStep | None) -> bool:
        self.tasks.popleft().dispatch()
        return True

    def _dispatch_one(self, step: RecordedStep | None) -> bool:
        """Dispatch what is ready or due; ``step`` is the next recorded event."""
        if self.ready:
            self.ready.popleft().dispatch()
            return True
        timers = self.timers
        if timers.next_ns > self.now_ns:
            return False
        owner: Any = timers.head.owner  # type: ignore[union-attr]
        owner.dispatch()
        return True


class OrderedRecordedInputLoop(RecordedInputLoop, OrderedLoop):
    """The loop with recorded inputs for jobs with policies, executors, execution times or ties.

    The recording decides the order, so neither policy nor executors are asked. Where callbacks wait
    for workers (``has_workers``), those in the recording run at their recorded time; others are
    first come, first served. Polling calls (``spin_once``) have no event, so without a policy they
    are first come, first served, too.
    """

    has_workers = False
    by_policy = False

    def next_timer(self) -> Any:
        """Return the next timer that does not wait for its recorded time."""
        due, after = self.timers.due(self.now_ns)
        free = (timer for timer in due if not self._waits_for_recording(self.place(timer.owner)))  # type: ignore[arg-type]
        return next(free, after)

    def _run_task(self, step: RecordedStep | None) -> bool:
        for index, place in enumerate(self._tasks.places):
            if not self._waits_for_recording(place) or (
                step is not None and self._matches(place, step)
            ):
                del self._tasks.places[index]
                item: Any = place.candidate.item
                item.dispatch()
                return True
        return False

    def _dispatch_one(self, step: RecordedStep | None) -> bool:
        due, _ = self.timers.due(self.now_ns)
        waiting = self._ready.places
        places = [*waiting, *(self.place(timer.owner) for timer in due)]  # type: ignore[arg-type]
        chosen = self._recorded_choice(places, step)
        if chosen is None:
            return False
        for index, place in enumerate(waiting):
            if place is chosen:
                del waiting[index]
                break
        item: Any = chosen.candidate.item
        item.dispatch()
        return True

    def _recorded_choice(
        self, places: list[ReadyItem], step: RecordedStep | None
    ) -> ReadyItem | None:
        if step is not None:
            for place in places:
                if not _has_no_event(place.candidate.item) and self._matches(place, step):
                    return place
        free = [place for place in places if not self._waits_for_recording(place)]
        if not free or not _has_no_event(free[0].candidate.item):
            return free[0] if free else None
        if _is_poll(free[0]):
            return self._next_for_poll(free, step) if self.by_policy else free[0]
        # An executor of the user's own takes them in the order in which it gets them.
        others = [p for p in free if _has_no_event(p.candidate.item) and not _is_poll(p)]
        entity, following = self.script.entity, self.script.following
        return min(others, key=lambda place: following(entity(place.candidate.entity_id)))

    def _next_for_poll(self, free: list[ReadyItem], step: RecordedStep | None) -> ReadyItem:
        """Return the next recorded item if it is ready: the policy let the poll wait."""
        if step is None:
            return free[0]
        return next((place for place in free if self._matches(place, step)), free[0])

    def _matches(self, place: ReadyItem, step: RecordedStep) -> bool:
        candidate = place.candidate
        recorded = self.script.entity(candidate.entity_id)
        if recorded < 0 and candidate.kind == _QOS_EVENT:  # which has its id when it runs first
            return step.kind == EventKind.QOS_EVENT
        return recorded == step.entity

    def _waits_for_recording(self, place: ReadyItem) -> bool:
        """Whether it waits for its recorded time."""
        candidate = place.candidate
        if (
            not self.has_workers
            or candidate.kind not in _WAITING_KINDS
            or _is_handed_over(candidate.item)
        ):
            return False
        return candidate.kind == _QOS_EVENT or self.script.entity(candidate.entity_id) >= 0


def _is_handed_over(item: Any) -> bool:
    """Whether one of the user's own executors runs it."""
    return getattr(getattr(item, "node", None), "mailbox", None) is not None


def _is_poll(place: ReadyItem) -> bool:
    """Whether it is a call that only polls, and then has no event."""
    return bool(getattr(place.candidate.item, "quiet", False))


def _has_no_event(item: Any) -> bool:
    """Whether it makes no event itself: it is handed over, or resumes a blocked call."""
    return _is_handed_over(item) or hasattr(item, "quiet")


def _earlier_ns(own_ns: int | None, step: RecordedStep | None) -> int | None:
    if step is None:
        return own_ns
    return step.stamp_ns if own_ns is None else min(own_ns, step.stamp_ns)
