"""A run at a glance: what went wrong, nodes and topics with their rates, where the time goes,
and what came of its checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import field
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rsltrace.errors import RsltraceError, TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.contents import CONTINUES, Occurrences, add_occurrences
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    EventFlag,
    EventKind,
    OutputKind,
    RandomDecision,
    encode_decision,
)
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.logs import LEVEL_WARN, silent_topics
from rsltrace_viewer.model.logs import Logs, first_event
from rsltrace_viewer.model.run import Run, Segment

if TYPE_CHECKING:
    from rsltrace.checks.evaluate import CheckResult

_LEVEL_ERROR = 40
_DRAW = int(OutputKind.DRAW)
_NOT_SENT = (_DRAW, int(OutputKind.ENTITY))
_VALUE_BITS = np.uint64(encode_decision(1).bit_length() - 1)
_VALUE = np.uint64(encode_decision(1) - 1)
_LOST = (int(RandomDecision.DROP), int(RandomDecision.BURST), int(RandomDecision.OUTAGE))


@dataclass(slots=True)
class Times:
    """Durations of an entity in simulated ns: how many, their sum, and the longest."""

    count: int = 0
    total_ns: int = 0
    most_ns: int = 0

    def add(self, count: int, total_ns: int, most_ns: int) -> None:
        """Add durations: how many, their sum, and the longest."""
        self.count += count
        self.total_ns += total_ns
        self.most_ns = max(self.most_ns, most_ns)

    @property
    def mean_ns(self) -> int:
        """The mean; there must be one."""
        return self.total_ns // self.count


@dataclass(slots=True)
class Met:
    """Something that events did: how often, and the first event that did."""

    count: int = 0
    first: int | None = None

    def add(self, indexes: npt.NDArray[np.integer]) -> None:
        """Add events by their indexes, which ascend."""
        if len(indexes):
            self.count += len(indexes)
            self.first = int(indexes[0]) if self.first is None else self.first


@dataclass(slots=True)
class Overview:
    """Counts of a run, so far: ``share`` of it is read (0 to 1). Keys are ids of entities.

    ``starts`` are events in which callbacks begin, ``sent`` counts the messages of publishers,
    ``waited`` is how long messages were on their way, ``took`` how long callbacks took, where the
    job gives them execution times, ``paused`` how long they waited themselves.
    """

    events: dict[int, Occurrences] = field(default_factory=dict)
    starts: dict[int, Occurrences] = field(default_factory=dict)
    sent: dict[int, Occurrences] = field(default_factory=dict)
    waited: dict[int, Times] = field(default_factory=dict)
    took: dict[int, Times] = field(default_factory=dict)
    paused: dict[int, Times] = field(default_factory=dict)
    raised: Met = field(default_factory=Met)
    lost: Met = field(default_factory=Met)
    qos: Met = field(default_factory=Met)
    share: float = 0.0


def read_overview(run: Run) -> Iterator[Overview]:
    """Yield the counts of a run after each segment. What is damaged is left out."""
    found = Overview()
    before: Segment | None = None
    for number in range(len(run.segments)):
        found.share = (number + 1) / len(run.segments)
        try:
            segment, outputs = run.segment(number), run.segment_outputs(number)
        except TraceError:
            yield found
            continue
        events, stamps = segment.events, segment.events["stamp"]
        add_occurrences(found.events, events["entity"], stamps)
        starts = ~np.isin(events["kind"], CONTINUES)
        add_occurrences(found.starts, events["entity"][starts], stamps[starts])
        draws = outputs[outputs["kind"] == _DRAW]
        sent = outputs[~np.isin(outputs["kind"], _NOT_SENT)]
        places = (sent["event"] - np.uint64(segment.first)).astype(np.intp)
        add_occurrences(found.sent, sent["entity"], stamps[places])
        _add_since_causes(found, segment, before)
        before = segment
        kinds, values = draws["hash"] >> _VALUE_BITS, (draws["hash"] & _VALUE).astype(np.int64)
        took = kinds == np.uint64(RandomDecision.EXECUTION)
        _add_times(found.took, draws["entity"][took], values[took])
        found.lost.add(draws["event"][np.isin(kinds, _LOST)])
        found.raised.add(events["index"][(events["flags"] & int(EventFlag.RAISED)) != 0])
        found.qos.add(events["index"][events["kind"] == int(EventKind.QOS_EVENT)])
        yield found
    found.share = 1.0
    yield found


_OF_CAUSES = ("stamp", "entity")


def _add_since_causes(found: Overview, segment: Segment, before: Segment | None) -> None:
    """Add how long after their causes events came, if these are in the segment or that before."""
    first = segment.first if before is None or before.last != segment.first else before.first
    read = [one.events for one in (before, segment) if one is not None and one.first >= first]
    stamps, entities = (np.concatenate([one[name] for one in read]) for name in _OF_CAUSES)
    causes = segment.events["cause_event"]  # NO_EVENT is larger than any
    known = (causes >= np.uint64(first)) & (causes < np.uint64(segment.last))
    places = np.flatnonzero(known)
    sent = (causes[places] - np.uint64(first)).astype(np.intp)
    entity = segment.events["entity"][places]
    took_ns = (segment.events["stamp"][places] - stamps[sent]).astype(np.int64)
    resumed = segment.events["kind"][places] == int(EventKind.RESUME)
    waited = resumed & (entities[sent] == entity)
    _add_times(found.waited, entity[~resumed], took_ns[~resumed])
    _add_times(found.paused, entity[waited], took_ns[waited])


def _add_times(
    times: dict[int, Times], entities: npt.NDArray[np.uint32], took_ns: npt.NDArray[np.int64]
) -> None:
    if not len(entities):
        return
    ids, places, counts = np.unique(entities, return_inverse=True, return_counts=True)
    total, most = np.zeros((2, len(ids)), dtype=np.int64)
    np.add.at(total, places, took_ns)
    np.maximum.at(most, places, took_ns)
    rows = zip(ids.tolist(), counts.tolist(), total.tolist(), most.tolist(), strict=True)
    for entity, number, total_ns, most_ns in rows:
        times.setdefault(entity, Times()).add(number, total_ns, most_ns)


@dataclass(frozen=True, slots=True)
class OverviewSection:
    """A node, callback or topic of the overview. ``share`` is its part of all events (of all
    messages; of the simulated time, where ``took`` is known). ``waited`` says how long its messages
    were on their way, ``took`` how long it ran, ``paused`` how long it waited while it ran."""

    name: str
    kind: str
    node: str
    count: int
    rate_hz: float | None
    share: float
    waited: Times | None = None
    took: Times | None = None
    paused: Times | None = None


def nodes_of(run: Run, overview: Overview) -> list[OverviewSection]:
    """Return the nodes, the busiest first."""
    nodes: dict[str, tuple[Occurrences, Times]] = {
        node.name: (Occurrences(), Times()) for node in run.nodes
    }
    for entity, series in overview.events.items():
        if entity:
            own = nodes.setdefault(run.node_name(entity), (Occurrences(), Times()))
            own[0].add(series.count, series.first_ns, series.last_ns)
            if (took := overview.took.get(entity)) is not None:
                own[1].add(took.count, took.total_ns, took.most_ns)
    whole = _whole(run, overview)
    return _sorted(
        OverviewSection(
            name,
            "node",
            name,
            series.count,
            series.rate_hz,
            (took.total_ns if overview.took else series.count) / whole,
            took=took if overview.took else None,
        )
        for name, (series, took) in nodes.items()
        if name != RUN_NAME
    )


def callbacks_of(run: Run, overview: Overview) -> list[OverviewSection]:
    """Return what ran callbacks, the busiest first."""
    parts, whole = [], _whole(run, overview)
    for entity, series in overview.events.items():
        found = run.entities.get(entity)
        if found is None or found.kind in (EntityKind.SYSTEM, EntityKind.NODE):
            continue
        took = overview.took.get(entity, Times())
        parts.append(
            OverviewSection(
                run.entity_name(entity),
                found.kind.label,
                run.node_name(entity),
                series.count,
                overview.starts.get(entity, series).rate_hz,
                (took.total_ns if overview.took else series.count) / whole,
                overview.waited.get(entity) if found.kind in _RECEIVERS else None,
                took if overview.took else None,
                overview.paused.get(entity),
            )
        )
    return _sorted(parts)


_RECEIVERS = (EntityKind.SUBSCRIPTION, EntityKind.SERVICE, EntityKind.CLIENT)


def _whole(run: Run, overview: Overview) -> int:
    """Return what shares are parts of: the simulated time; without execution times, all events."""
    if overview.took:
        return max(run.end_ns - run.start_ns, 1)
    return max(sum(series.count for series in overview.events.values()), 1)


def topics_of(run: Run, overview: Overview) -> list[OverviewSection]:
    """Return the topics that messages were sent on, the busiest first."""
    topics: dict[tuple[str, str], Occurrences] = {}
    for entity in run.entities.values():
        if entity.kind is not EntityKind.PUBLISHER or is_built_in(entity):
            continue
        own = topics.setdefault((run.entity_name(entity.id), entity.type), Occurrences())
        series = overview.sent.get(entity.id)
        if series is not None:
            own.add(series.count, series.first_ns, series.last_ns)
    total = sum(series.count for series in topics.values())
    return _sorted(
        OverviewSection(name, kind, "", one.count, one.rate_hz, one.count / max(total, 1))
        for (name, kind), one in topics.items()
    )


def _sorted(parts: Iterable[OverviewSection]) -> list[OverviewSection]:
    return sorted(parts, key=lambda part: (-part.share, -part.count, part.name))


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that went wrong: how often, and the key that goes from one to the next. ``first``
    is the first event with it, ``filter`` what shows all of them."""

    what: str
    count: int
    key: str = ""
    bad: bool = False
    first: int | None = None
    filter: str = ""


def troubles_of(run: Run, overview: Overview, logs: Logs | None) -> list[Trouble]:
    """Return what went wrong; the usual things also where they did not happen."""
    findings = run.trace.findings
    raised, lost, qos = overview.raised, overview.lost, overview.qos
    found = [Trouble("exceptions", raised.count, "x", True, raised.first)]
    if logs is not None:
        errors = logs.count(_LEVEL_ERROR)
        warnings = logs.count(LEVEL_WARN) - errors
        first = first_event(run, logs, _LEVEL_ERROR, _LEVEL_ERROR * 10)
        found.append(Trouble("errors logged", errors, "g", True, first, "level:error"))
        first = first_event(run, logs, LEVEL_WARN, _LEVEL_ERROR)
        found.append(Trouble("warnings logged", warnings, "w", first=first, filter="level:warn"))
    count = sum(len(one) for one in findings.values())
    first = min(findings, default=None)
    found.append(Trouble("findings of the guard", count, "u", first=first))
    if lost.count:
        found.append(Trouble("messages lost on the way", lost.count, first=lost.first))
    if qos.count:
        found.append(Trouble("QoS events", qos.count, first=qos.first, filter="kind:qos"))
    return found


def unheard_of(run: Run) -> str:
    """Return what is listened to and never published, in a sentence; empty if there is none."""
    return silent_topics(run.entities.values())


_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Checks:
    """The checks that were violated, how many passed, and why none could be held against the run,
    if so."""

    violated: tuple[CheckResult, ...] = ()
    passed: int = 0
    error: str = ""


def read_checks(run: Run) -> Iterator[Checks]:
    """Hold the checks of a run's job against it: yield now and then, and in the end what came of
    them; nothing if the job has none, or the run is not finished. Functions are not called, since
    a trace may come from anybody."""
    if not run.trace.complete or "checks" not in run.trace.job_text:
        return
    from rsltrace.checks.evaluate import PASSED, VIOLATED, evaluating, job_of_checks

    try:
        last = perf_counter()
        for results in evaluating(run.trace, job_of_checks(run.trace)):
            if results:
                violated = tuple(one for one in results if one.verdict == VIOLATED)
                yield Checks(violated, sum(one.verdict == PASSED for one in results))
            elif perf_counter() - last > _STEP_S:
                yield Checks()
                last = perf_counter()
    except RsltraceError as error:
        yield Checks(error=str(error).splitlines()[0])
