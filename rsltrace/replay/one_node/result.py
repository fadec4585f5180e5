"""The result of replaying one node, and the columns of a recording that it needs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import table

if TYPE_CHECKING:
    from rsltrace.diff.facts.evidence import FieldDifference
    from rsltrace.errors import RunError

# Format the result of ``replay --node``, as a table or as JSON.

_ROWS = 15
_WIDTH = 40


def as_text(result: NodeReplayResult, *, everything: bool) -> Iterator[str]:
    """Yield the lines of the report: the first changes, or (``everything``) all."""
    yield printable(result.sentence)
    if result.same:
        return
    shown: Sequence[OutputChange] = result.changes
    rows = [row for change in shown for row in _rows(change, result.start_ns)]
    left = 0
    if not everything and len(rows) > _ROWS:
        count, shown = 0, []
        for change in result.changes:
            count += len(change.fields)
            if shown and count > _ROWS:
                break
            shown.append(change)
        left = len(result.changes) - len(shown)
        rows = [row for change in shown for row in _rows(change, result.start_ns)][:_ROWS]
    yield ""
    yield from table([("time (s)", "output", "field", "recorded", "now"), *rows])
    if left:
        yield f"and {left} more {'output' if left == 1 else 'outputs'} (--all shows them)"


def _rows(change: OutputChange, start_ns: int) -> Iterator[tuple[str, ...]]:
    when, name = format_seconds(change.time_ns - start_ns), printable(change.name)
    output = name if change.kind == "message" else f"{change.kind} {name}"
    for one in change.fields:
        path, before, after = one.path, one.a, one.b
        if one.first and one.elements is not None:  # of an array, the first element that differs
            place, before, after = one.first[0]
            others = one.elements[0] - 1
            path += f"[{place}]" + (f" and {others} more" if others else "")
        before, after = shortened(before, _WIDTH), shortened(after, _WIDTH)
        yield when, output, printable(path), before or "(nothing)", after or "(nothing)"


def as_json(result: NodeReplayResult) -> str:
    return json.dumps(
        {
            "trace": result.trace,
            "node": result.node,
            "inputs": result.inputs,
            "compared": result.compared,
            "same": result.same,
            "changes": [_values(change) for change in result.changes],
            "end_ns": result.end_ns,
            "ended": result.ended,
            "exit_code": result.exit_code,
            "error": None if result.error is None else str(result.error),
            "path": None if result.path is None else str(result.path),
            "notes": list(result.notes),
        }
    )


def _values(change: OutputChange) -> dict[str, object]:
    return {
        "change": change.change.value,
        "time_ns": change.time_ns,
        "kind": change.kind,
        "name": change.name,
        "recorded_event": change.recorded_event,
        "event": change.event,
        "fields": [asdict(one) for one in change.fields],
    }


Column = npt.NDArray[Any]
SENT = (OutputKind.MESSAGE, OutputKind.LOG, OutputKind.REQUEST, OutputKind.RESPONSE)
_COLUMNS = ("stamp", "kind", "flags", "entity", "cause_event", "cause_output")


class RecordingColumns:
    """The events of a trace, ``events[i]`` by index, and its outputs in order.

    ``first_output[i]`` is where the outputs of event ``i`` begin (one more at the end).
    ``count`` is how many events there were until the run ended and its nodes were shut down.
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
        when = format_seconds(first.time_ns - self.start_ns)
        at = f"{first.kind} {first.name} at {when} s is {first.change.value}"
        more = len(self.changes) - 1
        later = f", and {more} later" if more else ""
        return f"{self.node} diverges: {at}{later}, of {self.compared} outputs ({run})"
