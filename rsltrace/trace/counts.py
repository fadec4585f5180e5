"""Counting a trace: how many events and outputs, of what kinds, of which entities, how often."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.stamp import NS_PER_S
from rsltrace.trace.reader import Trace

_ENTITY = int(OutputKind.ENTITY)


@dataclass(slots=True)
class Series:
    """Things that happened: how many, the first and the last of them (simulated ns)."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate_hz(self) -> float | None:
        """How often per simulated second, from the first to the last; None for fewer than two."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * NS_PER_S / span_ns if span_ns > 0 else None

    def add(self, count: int, first_ns: int, last_ns: int) -> None:
        """Add ``count`` more."""
        self.first_ns = min(self.first_ns, first_ns) if self.count else first_ns
        self.last_ns = max(self.last_ns, last_ns) if self.count else last_ns
        self.count += count


@dataclass(slots=True)
class Counts:
    """A whole trace, counted. Keys are the numbers of entities and kinds as the trace has them.

    The creation of an entity is an output (and counted by kind), but not one of that entity's own.
    """

    events: dict[int, Series] = field(default_factory=dict)
    outputs: dict[int, Series] = field(default_factory=dict)
    event_kinds: Counter[int] = field(default_factory=Counter)
    output_kinds: Counter[int] = field(default_factory=Counter)

    def rate_hz(self, entity: int) -> float | None:
        """How often an entity ran, or (for one that never runs, as publishers) sent something."""
        series = self.events.get(entity) or self.outputs.get(entity)
        return series.rate_hz if series else None


def count(trace: Trace) -> Counts:
    """Read all events and outputs of ``trace``, a segment at a time, and count them.

    Raises TraceError where the trace is damaged.
    """
    counts = Counts()
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        stamps = events["stamp"]
        _add(counts.events, events["entity"], stamps)
        own = outputs[outputs["kind"] != _ENTITY]
        owners = (own["event"] - events["index"][0]).astype(np.intp)
        _add(counts.outputs, own["entity"], stamps[owners])
        _add_kinds(counts.event_kinds, events["kind"])
        _add_kinds(counts.output_kinds, outputs["kind"])
    return counts


def _add(
    series: dict[int, Series], entities: npt.NDArray[np.uint32], stamps: npt.NDArray[np.uint64]
) -> None:
    ids, places, counts = np.unique(entities, return_inverse=True, return_counts=True)
    first = np.full(len(ids), 2**64 - 1, dtype=np.uint64)
    last = np.zeros(len(ids), dtype=np.uint64)
    np.minimum.at(first, places, stamps)
    np.maximum.at(last, places, stamps)
    rows = zip(ids.tolist(), counts.tolist(), first.tolist(), last.tolist(), strict=True)
    for entity, number, first_ns, last_ns in rows:
        series.setdefault(entity, Series()).add(number, first_ns, last_ns)


def _add_kinds(counter: Counter[int], kinds: npt.NDArray[np.unsignedinteger]) -> None:
    values, counts = np.unique(kinds, return_counts=True)
    counter.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))
