"""What a trace shows of response times: chains of callbacks, each from the release of a timer (or
the arrival of a message from outside) to the end of a callback, and how long callbacks ran."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rsltrace.native.timing.system import CallbackKey
from rsltrace.simulation.loop.timer_queue import TimerState
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    decision_duration,
)
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import timings

_CALLBACKS = frozenset(
    map(int, (EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT))
)
_RECEIVERS = (EntityKind.TIMER, EntityKind.SUBSCRIPTION, EntityKind.SERVICE, EntityKind.CLIENT)
_TIMER, _DRAW = int(EventKind.TIMER), int(OutputKind.DRAW)
_TIMER_CHANGED = int(OutputKind.TIMER)
_SUSPENDED = int(EventFlag.SUSPENDED)

ChainKey = tuple[CallbackKey, ...]
"""A chain: its callbacks. What came from outside begins with the callback that received it."""


@dataclass(slots=True)
class ChainPath:
    """A chain up to one of its callbacks, ``parent`` is that without the last. ``count`` is how
    many of the last one's callbacks came of one of the parent's at most, ``gap_ns`` the shortest
    time between two releases of what begins a chain. ``waits`` says that a callback of it waited.
    """

    key: ChainKey
    parent: int | None
    entity: int
    runs: int = 0
    worst_ns: int = 0
    worst_event: int = 0
    count: int = 1
    children: set[int] = field(default_factory=set)
    gap_ns: int | None = None
    waits: bool = False
    last: tuple[int, int] = (-1, 0)


class ObservedChains:
    """The chains of a trace, parents before children, and all durations of callbacks (ns).

    :raises TraceError: the trace is damaged.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.paths: list[ChainPath] = []
        self.durations: dict[CallbackKey, npt.NDArray[np.int64]] = {}
        self.callbacks = _callbacks(trace)
        self.of = {callback: trace.entity(number) for number, callback in self.callbacks.items()}
        self.reset: set[CallbackKey] = set()
        """Timers that were set otherwise in the run: they are taken to be due when they ran."""
        self._numbers: dict[tuple[int | None, int], int] = {}
        self._of_events: dict[int, tuple[int, int]] = {}
        self._released: dict[int, int] = {}
        self._read()

    def path(self, key: ChainKey) -> ChainPath | None:
        """Return the chain of these callbacks, None if the trace has none."""
        return next((one for one in self.paths if one.key == key), None)

    def period_ns(self, callback: CallbackKey) -> int | None:
        """Return the period of a timer."""
        period = self.of[callback].detail.get("period_ns")
        return period if isinstance(period, int) and callback.kind == "timer" else None

    def _read(self) -> None:
        native = timings(self.trace)
        took: dict[CallbackKey, list[int]] = {}
        for outputs in self.trace.outputs():
            for number in outputs["entity"][outputs["kind"] == _TIMER_CHANGED].tolist():
                if (callback := self.callbacks.get(number)) is not None:
                    self.reset.add(callback)
        timers = {
            number: TimerState(period, entity.created_ns, order=0, owner=None)
            for number, callback in self.callbacks.items()
            for entity in [self.trace.entity(number)]
            for period in [self.period_ns(callback)]
            if period
        }
        fields = ("index", "stamp", "entity", "kind", "flags", "cause_event")
        for events, outputs in zip(self.trace.events(), self.trace.outputs(), strict=True):
            busy = _busy(events, outputs)
            columns = [events[name].tolist() for name in fields]
            for row in zip(*columns, strict=True):
                index, stamp_ns, entity, kind, flags, cause = row
                callback = self.callbacks.get(entity)
                parent: int | None
                start_ns, end_ns, due_ns = stamp_ns, stamp_ns + busy.get(index, 0), None
                if len(native):
                    timing = native[index]
                    start_ns = int(timing["wall"])
                    end_ns = start_ns + int(timing["duration"])
                    due_ns = int(timing["ready"]) or None
                if callback is None or kind not in _CALLBACKS:
                    self._released[index] = end_ns
                    continue
                took.setdefault(callback, []).append(end_ns - start_ns)
                parent, release_ns = None, start_ns
                if kind == _TIMER:
                    if due_ns is None:
                        due_ns = self._due(timers.get(entity), callback, start_ns)
                    release_ns = due_ns
                elif (came_of := self._of_events.get(cause)) is not None:
                    parent, release_ns = came_of
                elif cause != NO_EVENT and cause in self._released:
                    release_ns = self._released[cause]
                else:
                    release_ns = due_ns or start_ns
                number = self._extend(parent, entity, callback)
                if number is None:
                    continue
                self._note(number, index, cause, release_ns, end_ns, bool(flags & _SUSPENDED))
                self._of_events[index] = (number, release_ns)
        self.durations = {one: np.array(found, np.int64) for one, found in took.items()}

    def _due(self, state: TimerState | None, callback: CallbackKey, now_ns: int) -> int:
        if state is None or callback in self.reset:
            return now_ns
        due_ns = min(state.deadline_ns, now_ns)
        state.call(now_ns)
        return due_ns

    def _extend(self, parent: int | None, entity: int, callback: CallbackKey) -> int | None:
        """Return the chain that goes on with a callback; None in a loop."""
        number = self._numbers.get((parent, entity))
        if number is not None:
            return number
        before: ChainKey = () if parent is None else self.paths[parent].key
        if callback in before:
            return None
        number = self._numbers[parent, entity] = len(self.paths)
        self.paths.append(ChainPath((*before, callback), parent, entity))
        if parent is not None:
            self.paths[parent].children.add(number)
        return number

    def _note(
        self, number: int, event: int, cause: int, release_ns: int, end_ns: int, waits: bool
    ) -> None:
        path = self.paths[number]
        if path.parent is None:
            if path.runs:
                gap_ns = release_ns - path.last[0]
                path.gap_ns = gap_ns if path.gap_ns is None else min(path.gap_ns, gap_ns)
            path.last = (release_ns, 0)
        else:
            count = path.last[1] + 1 if path.last[0] == cause else 1
            path.last = (cause, count)
            path.count = max(path.count, count)
        path.runs += 1
        path.waits = path.waits or waits
        if end_ns - release_ns > path.worst_ns:
            path.worst_ns, path.worst_event = end_ns - release_ns, event


def _callbacks(trace: Trace) -> dict[int, CallbackKey]:
    """Return what runs callbacks, by the ids of entities."""
    seen: Counter[tuple[str, str, str]] = Counter()
    found = {}
    for number in sorted(trace.entities):
        entity: Entity = trace.entities[number]
        if entity.kind not in _RECEIVERS:
            continue
        words = (trace.node_of(entity).name, entity.kind.label, entity.name)
        found[number] = CallbackKey(*words, seen[words])
        seen[words] += 1
    return found


def _busy(events: npt.NDArray[np.void], outputs: npt.NDArray[np.void]) -> dict[int, int]:
    """Return how long the callbacks of events took in simulated time, by index of event."""
    draws = outputs[outputs["kind"] == _DRAW]
    busy = {}
    owners = dict(zip(events["index"].tolist(), events["entity"].tolist(), strict=True))
    for event, entity, number in zip(
        draws["event"].tolist(), draws["entity"].tolist(), draws["hash"].tolist(), strict=True
    ):
        duration_ns = decision_duration(number, RandomDecision.EXECUTION)
        if duration_ns is not None and owners.get(event) == entity:
            busy[event] = duration_ns
    return busy
