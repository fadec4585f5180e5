"""When callbacks of a native run really ended, and when its messages really left and arrived.

In a simulation this follows from what was drawn; there, a clock has it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsltrace.trace.native import event_columns, is_native, timings
from rsltrace.trace.reader import Trace

NONE = -1


class EventDurations:
    """The times of a native run, by the indexes of its events.

    ``durations`` has how long each event took, in ns, shape (events,).
    """

    def __init__(self, trace: Trace) -> None:
        rows = timings(trace)
        events = event_columns(trace)[: len(rows)]
        self.durations: list[int] = rows["duration"].astype(np.int64).tolist()
        known = (rows["source"] != 0) & (events["cause_event"] < np.arange(len(rows)))
        took = rows["ready"].astype(np.int64) - rows["source"].astype(np.int64)
        took[~known | (rows["ready"] == 0)] = NONE
        self._delays: list[int] = np.maximum(took, NONE).tolist()
        self._left = self._sent(rows, events, known)

    def delay_ns(self, event: int) -> int:
        """Return how long the input of an event was on its way; NONE if nobody knows."""
        return self._delays[event]

    def left_ns(self, event: int, output: int, began_ns: int) -> int:
        """Return when a message left that an event sent which began at a time: as whoever received
        it was told, else at the end of the event."""
        return began_ns + self._left.get((event, output), self.durations[event])

    def _sent(
        self,
        rows: npt.NDArray[np.void],
        events: npt.NDArray[np.void],
        known: npt.NDArray[np.bool_],
    ) -> dict[tuple[int, int], int]:
        """Return how long after the start of an event its outputs left, of those received."""
        causes = events["cause_event"][known].astype(np.int64)
        since = rows["source"][known].astype(np.int64) - rows["wall"][causes].astype(np.int64)
        since = np.clip(since, 0, rows["duration"][causes].astype(np.int64))
        keys = zip(causes.tolist(), events["cause_output"][known].tolist(), strict=True)
        return dict(zip(keys, since.tolist(), strict=True))


def native_times(trace: Trace) -> EventDurations | None:
    """Return the times of a native run, None of a simulated one.

    :raises TraceError: the trace is damaged.
    """
    return EventDurations(trace) if is_native(trace) and len(timings(trace)) else None
