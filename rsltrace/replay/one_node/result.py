"""The result of replaying one node, and the columns of a recording that it needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.diff.facts.evidence import FieldDifference
    from rsltrace.errors import RunError

Column = npt.NDArray[Any]
SENT = (OutputKind.MESSAGE, OutputKind.LOG, OutputKind.REQUEST, OutputKind.RESPONSE)
_COLUMNS = ("stamp", "kind", "flags", "entity", "cause_event", "cause_output")


class RecordingColumns:
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
        """The event that created each entity."""
        rows = self.outputs[self.outputs["kind"] == OutputKind.ENTITY]
        return dict(zip(rows["entity"].tolist(), rows["event"].tolist(), strict=True))

    @cached_property
    def constructions(self) -> list[int]:
        """The construction events of the job's entries and of its bag player."""
        found: list[int] = np.flatnonzero(self.events["kind"] == EventKind.CONSTRUCT).tolist()
        return found

    def outputs_of(self, event: int) -> Column:
        rows: Column = self.outputs[self.first_output[event] : self.first_output[event + 1]]
        return rows

    def payload(self, event: int, position: int) -> bytes | None:
        """Return the message of an output, None if it was not kept."""
        found = self.trace.payload(self.trace.outputs_of(event)[position])
        return None if found is None else found[2]


class OutputChangeKind(Enum):
    """What has become of an output."""

    CHANGED = "changed"
    MISSING = "missing"
    NEW = "new"


@dataclass(frozen=True, slots=True)
class OutputChange:
    """An output of the node that is not as recorded.

    ``time_ns`` is simulated time, ``kind`` is ``message``, ``request``, ``response``, ``log`` or
    ``exception``, ``name`` the topic or service. ``fields`` say what differs (``a`` recorded,
    ``b`` new); of a missing or new output it is one entry with the whole of it. ``recorded_event``
    and ``event`` are the indices of the events in the recording and in the replay, or None.
    """

    change: OutputChangeKind
    time_ns: int
    kind: str
    name: str
    recorded_event: int | None
    event: int | None
    fields: tuple[FieldDifference, ...]


@dataclass(frozen=True, slots=True)
class NodeReplayResult:
    """The outputs of a node that was replayed alone.

    ``trace`` (a path) is the recording, ``node`` the full name; ``inputs`` is how many recorded
    messages, requests and responses it received. ``compared`` is how many recorded outputs were
    compared (until ``end_ns``); ``changes`` are those that differ, by time. ``ended`` says why the
    replay ended. ``path`` is the replay's own trace or None. ``error`` is the node's failure,
    ``notes`` are texts for people.
    """

    trace: str
    node: str
    inputs: int
    compared: int
    changes: tuple[OutputChange, ...]
    start_ns: int
    end_ns: int
    ended: str
    path: Path | None = None
    error: RunError | None = field(default=None, compare=False)
    notes: tuple[str, ...] = ()
    interrupted: int = 0
    """The exit status of a replay that was itself interrupted (130: Ctrl-C), else 0."""

    @property
    def same(self) -> bool:
        """Whether every output is as recorded."""
        return not self.changes

    @property
    def diverged(self) -> bool:
        """Whether some output is not as recorded."""
        return bool(self.changes)

    @property
    def first(self) -> OutputChange | None:
        """The first output that is not as recorded."""
        return self.changes[0] if self.changes else None

    @property
    def exit_code(self) -> int:
        """0 the same, 1 not; of an interrupted replay 130, 143 or 129."""
        return 1 if self.changes else self.interrupted

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        inputs = "1 input" if self.inputs == 1 else f"{self.inputs} inputs"
        run = f"{inputs} over {format_seconds(self.end_ns - self.start_ns)} s"
        first = self.first
        if first is None and not self.compared:
            return f"{self.node} ran, but there is nothing to compare its outputs with ({run})"
        if first is None:
            return f"{self.node} is unchanged: {self.compared} outputs as recorded ({run})"
        when = format_seconds(first.time_ns)
        at = f"{first.kind} {first.name} at {when} s is {first.change.value}"
        more = len(self.changes) - 1
        later = f", and {more} later" if more else ""
        return f"{self.node} diverges: {at}{later}, of {self.compared} outputs ({run})"
