"""Events of one run, resolved for people: entities by name, outputs in a few words."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.rows import CONSTRUCT, ComparedTrace, OutputRow, outputs_of
from rsltrace.diff.facts.evidence import EventSummary
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.words.code import code_places, places_text, relative_place
from rsltrace.trace.words.entities import EntityKey
from rsltrace.trace.words.events import output_text

COUNTED_MAX = 8192
"""Events up to here get their number among their entity's events. Counting takes reading."""

_SUMMARY_OUTPUTS_MAX = 4
_DRAW = int(OutputKind.DRAW)
_SEGMENTS_BACK = 2


class EventViews:
    def __init__(self, run: ComparedTrace) -> None:
        self._run = run

    def view(self, index: int) -> EventSummary:
        run = self._run
        event = run.trace.event(index)
        outputs = outputs_of(run, index)
        number = self._number(event.entity, event.kind, outputs)
        return EventSummary(
            index=index,
            stamp_ns=run.trace.stamp(event.stamp_ns),
            entity=run.matching.keys[number],
            kind=event.kind,
            flags=event.flags,
            cause_event=event.cause_event,
            cause_output=event.cause_output,
            input_hash=event.input_hash,
            output_hash=event.output_hash,
            state_hash=event.state_hash,
            outputs=event.outputs,
            position=self._position(index, event.entity) if event.entity else 0,
            summary=self.summary(outputs),
            code=places_text(
                [relative_place(run.trace, one) for one in code_places(run.trace, event)]
            ),
        )

    def before_in_node(self, index: int, count: int, node: int) -> list[int]:
        """Return the last ``count`` events of a node before ``index``, in order.

        Two segments are looked at: what lies further back is no context any more.
        """
        found: list[int] = []
        if node and count:
            for part in self._segments_before(index):
                numbers = self._run.matching.numbers(
                    self._run.trace, part["entity"], of_b=self._run.of_b
                )
                own = np.array(self._run.matching.nodes)[numbers] == node
                own &= part["kind"] != CONSTRUCT
                found[:0] = part["index"][own].tolist()
                if len(found) >= count:
                    break
        return found[-count:]

    def summary(self, outputs: list[OutputRow]) -> str:
        """Return outputs as a short text: ``/t1, call /s1``."""
        keys = self._run.matching.keys
        texts = [
            output_text(kind, keys[n].name, keys[n].kind)
            for kind, n, _, _ in outputs
            if kind != _DRAW
        ]
        if len(texts) > _SUMMARY_OUTPUTS_MAX:
            texts[_SUMMARY_OUTPUTS_MAX:] = [f"{len(texts) - _SUMMARY_OUTPUTS_MAX} more"]
        return ", ".join(texts)

    def _number(self, entity: int, kind: EventKind, outputs: list[OutputRow]) -> int:
        keys = self._run.matching.keys
        if kind is EventKind.CONSTRUCT:
            for output_kind, number, _, _ in outputs:
                if output_kind == OutputKind.ENTITY and keys[number].kind == "node":
                    return number
        ids = np.array([entity], dtype=np.uint32)
        return int(self._run.matching.numbers(self._run.trace, ids, of_b=self._run.of_b)[0])

    def _segments_before(self, index: int) -> Iterator[npt.NDArray[np.void]]:
        """Yield the last segments before ``index``, backwards, cut off there."""
        starts = self._run.trace.segments["first_event"]
        segment = int(np.searchsorted(starts, np.uint64(index), side="left")) - 1
        end = index
        for number in range(segment, max(segment - _SEGMENTS_BACK, -1), -1):
            start = int(starts[number])
            yield from self._run.trace.events(start, end)
            end = start

    def _position(self, index: int, entity: int) -> int:
        if index > COUNTED_MAX:
            return -1
        return int(np.count_nonzero(self._first_entities[:index] == entity))

    @cached_property
    def _first_entities(self) -> npt.NDArray[np.uint32]:
        parts = [part["entity"] for part in self._run.trace.events(0, COUNTED_MAX)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.uint32)


def drawn_for(key: EntityKey) -> str:
    """Return what a random draw is about: a link, or a clock that was set."""
    if key.kind == EntityKind.NODE.label:
        return f"the clock of {key.name}"
    return f"{key.kind} {key.name} of {key.node}"


def subject_of(view: EventSummary) -> str:
    """Return the node an event is of, ``main package:main`` for a main without one, or ""."""
    is_main = view.entity.kind == EntityKind.MAIN.label
    return view.node or (f"main {view.entity.name}" if is_main else "")


def entity_detail(run: ComparedTrace, number: int) -> dict[str, object]:
    """Return what the trace says of an entity, nothing if the run has it not."""
    table = run.matching.numbers_b if run.of_b else run.matching.numbers_a
    ids = (table == number).nonzero()[0]
    return run.trace.entities[int(ids[0])].detail if len(ids) else {}
