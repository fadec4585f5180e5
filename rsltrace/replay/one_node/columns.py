"""What replaying a node has to know of a whole recording, in columns: who did what, and why."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

Column = npt.NDArray[Any]
SENT = (OutputKind.MESSAGE, OutputKind.LOG, OutputKind.REQUEST, OutputKind.RESPONSE)
_COLUMNS = ("stamp", "kind", "flags", "entity", "cause_event", "cause_output")


class Columns:
    """The events of a trace, ``events[i]`` by index, and its outputs in order.

    ``first_output[i]`` is where the outputs of event ``i`` begin (one more at the end).
    ``count`` is how many events there were until the run ended, and its nodes were told.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        events = [np.array(rows[list(_COLUMNS)]) for rows in trace.events()]
        self.events: Column = np.concatenate(events)
        outputs = [np.array(rows) for rows in trace.outputs()]
        self.outputs: Column = np.concatenate(outputs)
        places = np.arange(len(self.events) + 1, dtype=np.uint64)
        self.first_output: Column = np.searchsorted(self.outputs["event"], places)
        ended_after = trace.ended_after
        self.count = len(self.events) if ended_after is None else ended_after

    @cached_property
    def created_in(self) -> dict[int, int]:
        """By entity, the event that created it."""
        rows = self.outputs[self.outputs["kind"] == OutputKind.ENTITY]
        return dict(zip(rows["entity"].tolist(), rows["event"].tolist(), strict=True))

    @cached_property
    def constructions(self) -> list[int]:
        """The events that constructed the entries of the job, and the player of its bags."""
        found: list[int] = np.flatnonzero(self.events["kind"] == EventKind.CONSTRUCT).tolist()
        return found

    def outputs_of(self, event: int) -> Column:
        """Return the outputs of an event."""
        rows: Column = self.outputs[self.first_output[event] : self.first_output[event + 1]]
        return rows

    def payload(self, event: int, position: int) -> bytes | None:
        """Return what an output has sent, None if it was not kept."""
        found = self.trace.payload(self.trace.outputs_of(event)[position])
        return None if found is None else found[2]
