"""Which request a recorded response answers. A trace says who got it, and who asked what."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rsltrace.replay.one_node.columns import Column, Columns
from rsltrace.trace.model.event import EventKind, OutputKind

_BEGIN = (EventKind.SERVICE, EventKind.ACTION)


class Answers:
    """The requests of the unit's clients that others have taken, until they are answered."""

    def __init__(self, columns: Columns, is_own: Callable[[Column], Column]) -> None:
        events, outputs = columns.events, columns.outputs
        self._columns = columns
        self._asked: dict[tuple[int, int], tuple[int, int]] = {}
        """By event and output that asked: the client, and which of its requests it was."""
        counts: dict[int, int] = {}
        places = np.flatnonzero((outputs["kind"] == OutputKind.REQUEST) & is_own(outputs["entity"]))
        for place in places.tolist():
            event, client = int(outputs["event"][place]), int(outputs["entity"][place])
            counts[client] = counts.get(client, 0) + 1
            position = place - int(columns.first_output[event])
            self._asked[event, position] = client, counts[client]
        self._got: dict[tuple[int, int], int] = {}
        """By event and output that answered: the client."""
        self._open: dict[int, list[tuple[int, int, int]]] = {}
        """By service: (event that took it, client, number) of requests, oldest first."""
        self._untaken: dict[int, list[int]] = {}
        """By client, the numbers of the requests that nobody seems to have taken."""
        if not self._asked:
            return
        own = is_own(events["entity"])
        for index in np.flatnonzero(own & (events["cause_event"] < len(events))).tolist():
            row = events[index]
            cause = int(row["cause_event"]), int(row["cause_output"])
            self._got.setdefault(cause, int(row["entity"]))
        for index in np.flatnonzero(~own & np.isin(events["kind"], _BEGIN)).tolist():
            row = events[index]
            asked = self._asked.get((int(row["cause_event"]), int(row["cause_output"])))
            if asked is not None:
                self._open.setdefault(int(row["entity"]), []).append((index, *asked))
        taken = {asked[1:] for waiting in self._open.values() for asked in waiting}
        for client, number in self._asked.values():
            if (client, number) not in taken:
                self._untaken.setdefault(client, []).append(number)

    def of(self, event: int, position: int, service: int) -> tuple[int, int] | None:
        """Return the client (of the recording) that a response goes to, and which of its requests
        it answers; None if it goes to somebody else. Responses are asked for in their order."""
        waiting = self._open.get(service, [])
        for place, (begun, client, number) in enumerate(waiting):
            if begun == event:
                del waiting[place]
                return client, number
        asked_by = self._got.get((event, position))
        if asked_by is None:
            asked_by = self._drawn_for(event, position)
        for place, (begun, client, number) in enumerate(waiting):
            if begun < event and client == asked_by:
                del waiting[place]
                return client, number
        # In the trace of one node alone nobody has taken the requests: they are answered in order.
        numbers = self._untaken.get(asked_by)
        return (asked_by, numbers.pop(0)) if numbers else None

    def _drawn_for(self, event: int, position: int) -> int:
        """Return for whom chance decided when a response arrives, or that it does not."""
        rows = self._columns.outputs_of(event)[position + 1 : position + 2]
        drawn = len(rows) and rows["kind"][0] == OutputKind.DRAW
        return int(rows["entity"][0]) if drawn else -1
