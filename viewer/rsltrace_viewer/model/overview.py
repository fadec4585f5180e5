"""A run at a glance: what went wrong, nodes and topics with their rates, where the time goes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.model.built_in import is_built_in
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import NO_EVENT, EventFlag
from rsltrace.trace.counts import Series
from rsltrace.words.entities import RUN_NAME
from rsltrace.words.logs import LEVEL_WARN
from rsltrace_viewer.model.logs import Logs
from rsltrace_viewer.model.run import Run

_LEVEL_ERROR = 40


@dataclass(slots=True)
class Waiting:
    """How long messages of an entity were on their way, in simulated ns."""

    count: int = 0
    total_ns: int = 0
    most_ns: int = 0


@dataclass(slots=True)
class Overview:
    """Counts of a run, so far: ``share`` of it is read (0 to 1). Keys are ids of entities.

    ``sent`` counts the messages of publishers, ``raised`` are the first events with exceptions.
    """

    events: dict[int, Series] = field(default_factory=dict)
    sent: dict[int, Series] = field(default_factory=dict)
    waited: dict[int, Waiting] = field(default_factory=dict)
    raised: list[int] = field(default_factory=list)
    raised_count: int = 0
    share: float = 0.0


def read_overview(run: Run) -> Iterator[Overview]:
    """Yield the counts of a run as they become known. What is damaged is left out."""
    found = Overview()
    before: tuple[int, npt.NDArray[np.uint64]] = (0, np.zeros(0, dtype=np.uint64))
    for number in range(len(run.segments)):
        try:
            segment, outputs = run.segment(number), run.segment_outputs(number)
        except TraceError:
            continue
        events, stamps = segment.events, segment.events["stamp"]
        _add(found.events, events["entity"], stamps)
        places = (outputs["event"] - np.uint64(segment.first)).astype(np.intp)
        _add(found.sent, outputs["entity"], stamps[places])
        first, known = before[0], np.concatenate((before[1], stamps))
        if first + len(before[1]) != segment.first:
            first, known = segment.first, stamps
        _add_waiting(found.waited, events, first, known)
        before = segment.first, stamps
        raised = np.flatnonzero(events["flags"] & int(EventFlag.RAISED))
        found.raised_count += len(raised)
        if len(found.raised) < 100:
            found.raised += (raised[:100] + segment.first).tolist()
        found.share = (number + 1) / len(run.segments)
        yield found
    found.share = 1.0
    yield found


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


def _add_waiting(
    waited: dict[int, Waiting],
    events: npt.NDArray[np.void],
    first: int,
    stamps: npt.NDArray[np.uint64],
) -> None:
    """Add the time from what caused an event to the event; ``stamps`` are those from ``first``."""
    causes = events["cause_event"]
    usable = (causes != np.uint64(NO_EVENT)) & (causes >= np.uint64(first))
    own = events[usable]
    sent = stamps[(causes[usable] - np.uint64(first)).astype(np.intp)]
    took = (own["stamp"] - sent).astype(np.int64)
    for entity in np.unique(own["entity"]).tolist():
        mine = took[own["entity"] == entity]
        wait = waited.setdefault(entity, Waiting())
        wait.count += len(mine)
        wait.total_ns += int(mine.sum())
        wait.most_ns = max(wait.most_ns, int(mine.max()))


@dataclass(frozen=True, slots=True)
class Part:
    """A node, callback or topic of the overview. ``share`` is its part of all events (or of all
    messages), ``wait_ns`` the mean and longest time that its messages were on their way."""

    name: str
    kind: str
    node: str
    count: int
    rate_hz: float | None
    share: float
    wait_ns: tuple[int, int] | None = None


def nodes_of(run: Run, overview: Overview) -> list[Part]:
    """Return the nodes, the busiest first."""
    total = sum(series.count for series in overview.events.values())
    nodes: dict[str, Series] = {node.name: Series() for node in run.nodes}
    for entity, series in overview.events.items():
        if entity:
            own = nodes.setdefault(run.node_name(entity), Series())
            own.add(series.count, series.first_ns, series.last_ns)
    return _sorted(
        Part(name, "node", name, one.count, one.rate_hz, one.count / max(total, 1))
        for name, one in nodes.items()
        if name != RUN_NAME
    )


def callbacks_of(run: Run, overview: Overview) -> list[Part]:
    """Return what ran callbacks, the busiest first."""
    total = sum(series.count for series in overview.events.values())
    parts = []
    for entity, series in overview.events.items():
        found = run.entities.get(entity)
        if found is None or found.kind in (EntityKind.SYSTEM, EntityKind.NODE):
            continue
        waited = overview.waited.get(entity)
        wait = None
        if waited is not None and found.kind is EntityKind.SUBSCRIPTION:
            wait = (waited.total_ns // waited.count, waited.most_ns)
        name, node = run.entity_name(entity), run.node_name(entity)
        share = series.count / max(total, 1)
        parts.append(Part(name, found.kind.label, node, series.count, series.rate_hz, share, wait))
    return _sorted(parts)


def topics_of(run: Run, overview: Overview) -> list[Part]:
    """Return the topics that messages were sent on, the busiest first."""
    topics: dict[tuple[str, str], Series] = {}
    for entity, series in overview.sent.items():
        found = run.entities.get(entity)
        if found is None or found.kind is not EntityKind.PUBLISHER or is_built_in(found):
            continue
        own = topics.setdefault((run.entity_name(entity), found.type), Series())
        own.add(series.count, series.first_ns, series.last_ns)
    total = sum(series.count for series in topics.values())
    return _sorted(
        Part(name, kind, "", one.count, one.rate_hz, one.count / max(total, 1))
        for (name, kind), one in topics.items()
    )


def _sorted(parts: Iterator[Part] | Sequence[Part]) -> list[Part]:
    return sorted(parts, key=lambda part: (-part.count, part.name))


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that went wrong: how often, and the key that goes from one to the next."""

    what: str
    count: int
    key: str
    bad: bool
    first: int | None = None


def troubles_of(run: Run, overview: Overview, logs: Logs | None) -> list[Trouble]:
    """Return what went wrong; things that did not happen are said, too."""
    findings = run.trace.findings
    first = overview.raised[0] if overview.raised else None
    found = [Trouble("exceptions", overview.raised_count, "x", True, first)]
    if logs is not None:
        errors = logs.count(_LEVEL_ERROR)
        found.append(Trouble("errors logged", errors, "g", True))
        found.append(Trouble("warnings logged", logs.count(LEVEL_WARN) - errors, "w", False))
    count = sum(len(one) for one in findings.values())
    found.append(Trouble("findings of the guard", count, "u", False, min(findings, default=None)))
    return found
