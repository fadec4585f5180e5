"""When what an event sent left: after the execution time of its callback, where that has one."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import (
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    decision_duration,
)
from rsltrace.trace.model.operation import RESUMES_COROUTINE, pack_operation

_COROUTINE = hash64(pack_operation(RESUMES_COROUTINE, 0))


class Departures:
    """By how much what events sent left after them, from the events of a trace in their order.

    A callback that goes on after a blocking call sends with its execution time still; a coroutine
    that goes on sends at once.
    """

    def __init__(self) -> None:
        self._suspended: dict[int, deque[int]] = {}
        """By entity with execution times: what its waiting callbacks keep, the oldest first."""
        self._resuming: set[tuple[int, int]] = set()
        """The outputs that let coroutines go on, which have not yet."""

    def read(
        self, first: int, events: npt.NDArray[np.void], outputs: npt.NDArray[np.void]
    ) -> dict[int, int]:
        """Take in the next events, the first of which has index ``first``, with their outputs.

        Return nanoseconds by the indexes of events, without those that are 0.
        """
        kinds, hashes, owners = outputs["kind"], outputs["hash"], outputs["event"]
        entities = events["entity"]
        suspended = self._suspended
        late: dict[int, int] = {}
        draws = (kinds == OutputKind.DRAW) & (hashes >> np.uint64(56) == RandomDecision.EXECUTION)
        for event, number in zip(owners[draws].tolist(), hashes[draws].tolist(), strict=True):
            late[event] = decision_duration(number, RandomDecision.EXECUTION) or 0
            suspended.setdefault(int(entities[event - first]), deque())
        if not suspended:
            return late
        timed = list(suspended)
        tasks = (kinds == OutputKind.TASK) & (hashes == np.uint64(_COROUTINE))
        places = np.flatnonzero(tasks & np.isin(outputs["entity"], timed))
        positions = places - np.searchsorted(owners, owners[places])
        self._resuming.update(zip(owners[places].tolist(), positions.tolist(), strict=True))
        resumed = events["kind"] == EventKind.RESUME
        waits = (events["flags"] & EventFlag.SUSPENDED) != 0
        for place in np.flatnonzero((resumed | waits) & np.isin(entities, timed)).tolist():
            waiting = suspended[int(entities[place])]
            if resumed[place] and waiting:
                kept_ns = waiting.popleft()
                row = events[place]
                cause = int(row["cause_event"]), int(row["cause_output"])
                if cause in self._resuming:
                    self._resuming.remove(cause)
                else:
                    late[first + place] = kept_ns
            if waits[place]:
                waiting.append(late.get(first + place, 0))
        return {event: ns for event, ns in late.items() if ns}
