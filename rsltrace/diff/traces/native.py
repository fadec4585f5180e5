"""Two runs of which at least one is native: what of their difference is content, order, timing.

No event of a native run is at the time of another run's, so events are not aligned. Messages are
compared topic by topic, without the times in them; callbacks by how often, when and in which order
each ran.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.diff.alignment.rows import longest_increasing
from rsltrace.diff.bags.comparison import compare_content
from rsltrace.diff.facts.bags import (
    CallbackTimes,
    ExtraMessages,
    NativeComparison,
    ReorderedCallback,
    TopicDiff,
)
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.evidence import Presence
from rsltrace.diff.facts.remarks import LogTimesIgnored, NativeRuns
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import Diff, interruptions, side
from rsltrace.errors import TraceError
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind
from rsltrace.trace.model.operation import PARAMETER_EVENTS
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import DurationStatistics, duration_statistics, event_columns
from rsltrace.trace.words.entities import EntityKey

NOT_COMPARED = ("stamp", "*.stamp", "/rosout:file")
"""Not compared: real or simulated time, and the path of a log's file, which native runs shorten."""

_CALLBACKS = tuple(
    int(kind)
    for kind in (
        EventKind.TIMER,
        EventKind.SUBSCRIPTION,
        EventKind.SERVICE,
        EventKind.CLIENT,
        EventKind.ACTION,
        EventKind.GUARD_CONDITION,
        EventKind.QOS_EVENT,
    )
)


def compare_native(a: Trace, b: Trace, options: DiffOptions) -> Diff:
    """Return the diff of two runs. Reads all of both.

    Raises TraceError for options that need events to be aligned.
    """
    if options.nodes:
        raise TraceError("events of native runs are not aligned: --topic chooses, --node cannot")
    content = compare_content(a, b, replace(options, ignore=(*options.ignore, *NOT_COMPARED)))
    sides = (_Callbacks(a), _Callbacks(b))
    compared, moved, first = _order(*sides)
    tails = tuple(tail for topic in content.topics if (tail := _tail(topic)) is not None)
    others = [
        topic
        for topic in content.topics
        if _says_something_else(topic)
        and not (topic.topic == PARAMETER_EVENTS and said_of_parameters(a) == said_of_parameters(b))
    ]
    firsts = [topic.first for topic in others if topic.first is not None]
    native = tuple(name for name, trace in (("a", a), ("b", b)) if is_native(trace))
    found = NativeComparison(
        native,
        content,
        bool(others or content.topics_only_a or content.topics_only_b),
        min(firsts, key=lambda one: one.after_ns, default=None),
        tails,
        compared,
        moved,
        first,
        tuple(_times(*sides)),
    )
    return Diff(
        a=side(a),
        b=side(b),
        verdict=_verdict(a, b, found),
        outcome=NativeRuns(),
        agreeing=0,
        aligned_to=(a.event_count, b.event_count),
        bytes_read=a.bytes_read + b.bytes_read,
        remarks=(
            *interruptions(a, b),
            *(one for one in content.remarks if not isinstance(one, LogTimesIgnored)),
        ),
        allow_truncated=options.allow_truncated,
        native=found,
    )


def _verdict(a: Trace, b: Trace, found: NativeComparison) -> Verdict:
    if found.differs:
        return Verdict.OTHER_CONTENT
    if not (a.complete and b.complete):
        return Verdict.AGREE_UNTIL_TRUNCATED
    return Verdict.SAME_CONTENT


def said_of_parameters(trace: Trace) -> Counter[str]:
    """Return what nodes have said of their parameters, in any order."""
    found: Counter[str] = Counter()
    for _, _, data in trace.messages(PARAMETER_EVENTS):
        message: Any = trace.decode(PARAMETER_EVENTS, data)
        found[repr((message.node, *(getattr(message, name) for name in _KINDS)))] += 1
    return found


_KINDS = ("new_parameters", "changed_parameters", "deleted_parameters")


def _says_something_else(topic: TopicDiff) -> bool:
    """Whether more than the order of a topic's messages, or their number at its end, differs.

    Publishers of one topic mix as the moment has it, so that messages change places.
    """
    missing = (topic.only_a or topic.only_b) and not _tail(topic)
    return bool(topic.differing or missing)


def _tail(topic: TopicDiff) -> ExtraMessages | None:
    """Return how many messages more one run has at the end of a topic, if that is all that
    differs."""
    first, more = topic.first, topic.only_a + topic.only_b
    if first is None or topic.differing or topic.moved or (topic.only_a and topic.only_b):
        return None
    shown = first.a if first.presence is Presence.ONLY_A else first.b
    if shown is None or shown.index != topic.agreeing:
        return None
    return ExtraMessages(topic.topic, more, "a" if topic.only_a else "b")


class _Callbacks:
    """The callbacks of one run, in the order in which they began."""

    def __init__(self, trace: Trace) -> None:
        events = event_columns(trace)
        self._stamps = events["stamp"].astype(np.int64)
        self._causes = events["cause_event"]
        keys = _keys(trace)
        wanted = np.isin(events["kind"], _CALLBACKS)
        self.places: defaultdict[EntityKey, list[int]] = defaultdict(list)
        for place, entity in zip(
            np.flatnonzero(wanted).tolist(), events["entity"][wanted].tolist(), strict=True
        ):
            if entity in keys:
                self.places[keys[entity]].append(place)

    def times(self, key: EntityKey) -> DurationStatistics | None:
        """Return the periods of a timer, or the latencies of what was caused."""
        places = np.array(self.places.get(key, ()), dtype=np.int64)
        if key.kind == EntityKind.TIMER.label:
            return duration_statistics(np.diff(self._stamps[places]))
        causes: npt.NDArray[np.uint64] = self._causes[places]
        known = causes != NO_EVENT
        return duration_statistics(
            self._stamps[places[known]] - self._stamps[causes[known].astype(np.int64)]
        )


def _keys(trace: Trace) -> dict[int, EntityKey]:
    """Return what each entity is, whatever its id."""
    met: Counter[tuple[str, str, str, str]] = Counter()
    keys = {}
    for entity in sorted(trace.entities.values(), key=lambda entity: entity.id):
        node = trace.entities.get(entity.node)
        name = node.name if node is not None else ""
        own = (name, entity.kind.label, entity.name, entity.type)
        keys[entity.id] = EntityKey(*own, met[own])
        met[own] += 1
    return keys


def _order(a: _Callbacks, b: _Callbacks) -> tuple[int, int, ReorderedCallback | None]:
    """Return how many callbacks both runs have, how many of them ran in another order, and the
    first of these. The n-th of an entity is compared with the n-th."""
    pairs: list[tuple[int, int, EntityKey]] = []
    for key, places in a.places.items():
        pairs += ((i, j, key) for i, j in zip(places, b.places.get(key, ()), strict=False))
    pairs.sort(key=lambda pair: pair[0])
    kept = longest_increasing([j for _, j, _ in pairs])
    moved = [place for place in range(len(pairs)) if place not in kept]
    first = None
    if moved:
        i, j, key = pairs[moved[0]]
        first = ReorderedCallback(key, i, j)
    return len(pairs), len(moved), first


def _times(a: _Callbacks, b: _Callbacks) -> list[CallbackTimes]:
    return [
        CallbackTimes(
            key,
            len(a.places.get(key, ())),
            len(b.places.get(key, ())),
            "period" if key.kind == EntityKind.TIMER.label else "latency",
            a.times(key),
            b.times(key),
        )
        for key in dict.fromkeys((*a.places, *b.places))
    ]
