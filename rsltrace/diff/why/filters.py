"""Reasons behind a callback that ran: message filters that match stamps, and tf2."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsltrace.diff.why.question import Question, Reason, filter_of
from rsltrace.errors import TraceError
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import NS_PER_S, format_duration, printable, shortened
from rsltrace.trace.words.logs import log_record
from rsltrace.trace.words.phrases import seconds_text

_SHOWN = 3
_SPOKEN = (OutputKind.LOG, OutputKind.EXCEPTION)
_TEXT_MAX = 200
_TF2 = re.compile(
    r"\"([^\"]+)\" passed to lookupTransform argument \w+ does not exist"
    r"|Could not find a connection between '([^']+)' and '[^']+'"
    r"|extrapolation .*looking up transform from frame \[([^\]]+)\]"
)
"""What tf2 says of a transform that it has not, or not at that time (its buffer_core.cpp)."""


def _decoded(question: Question, topic: Entity, event: int, output: int) -> Any:
    trace = question.history.trace
    payload = trace.payload(trace.outputs_of(event)[output])
    return None if payload is None else trace.decode(topic.name, payload[2])


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


@dataclass(frozen=True)
class UnmatchedStamps(Reason):
    """A message filter found no messages whose stamps match; ``waited`` has the last stamps by
    topic, ``nearest_ns`` is how far apart the nearest ones are (None: a topic has none)."""

    callback: str
    slop_ns: int
    nearest_ns: int | None
    waited: tuple[tuple[str, tuple[int, ...]], ...]

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        entity, entities = question.entity, question.history.trace.entities.values()
        of = filter_of(entity)
        if of is None:
            return None
        inputs = [one for one in entities if one.node == entity.node and filter_of(one) == of]
        stamps = {printable(one.name): sorted(_stamps(question, one)) for one in inputs}
        nearest_ns = None
        if all(stamps.values()):
            nearest_ns = _spread(list(stamps.values()))
            if nearest_ns < of[2] or not nearest_ns:  # an ApproximateTimeSynchronizer wants less
                return None
        waited = tuple((name, tuple(found[-_SHOWN:])) for name, found in stamps.items())
        what = (of[0], of[2], nearest_ns, waited)
        return cls(*what, question=question, place=of[1])

    def words(self) -> str:
        text = f"the message filter of {self.callback} never called it"
        if self.nearest_ns is None:
            missing = next(topic for topic, stamps in self.waited if not stamps)
            return f"{text}: it got nothing on {missing}"
        topics = " and ".join(topic for topic, _ in self.waited)
        allowed = format_duration(self.slop_ns)
        distance = f"{format_duration(self.nearest_ns)} apart, and it allows {allowed}"
        return f"{text}: the stamps of {topics} are at least {distance}"

    def evidence(self) -> Iterator[str]:
        for topic, stamps in self.waited:
            yield f"last stamps of {topic}: {', '.join(map(seconds_text, stamps)) or 'none'}"


def _spread(topics: list[list[int]]) -> int:
    """Return how far apart the nearest stamps are, one of each topic."""
    latest: dict[int, int] = {}
    spreads = []
    for stamp, topic in sorted((one, at) for at, stamps in enumerate(topics) for one in stamps):
        latest[topic] = stamp
        if len(latest) == len(topics):
            spreads.append(stamp - min(latest.values()))
    return min(spreads)


def _stamps(question: Question, one: Entity) -> Iterator[int]:
    asked = Question(question.history, one, question.at_ns)
    for message in asked.messages:
        if message.taken is not None and message.sent_ns <= question.until_ns:
            decoded = _decoded(asked, one, message.event, message.output)
            if hasattr(decoded, "header"):
                yield _stamp_ns(decoded.header)


@dataclass(frozen=True)
class NoTransform(Reason):
    """The callback logged or raised that tf2 has no transform; ``sent`` says who sent those of the
    frame, and when last."""

    said: str
    frame: str
    sent: tuple[str, ...]

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        history, until_ns = question.history, question.until_ns
        runs = history.runs_of(question.entity.id)
        runs = [event for event in runs if history.stamp(event) <= until_ns]
        spoke = history.outputs["event"][np.isin(history.outputs["kind"], _SPOKEN)]
        runs = runs if question.at_ns is None else runs[-1:]
        for event in sorted(set(runs) & set(spoke.tolist())):
            for said, place in _said(question, event):
                if (found := _TF2.search(said)) is not None:
                    frame = next(filter(None, found.groups()))
                    what = (said, printable(frame), tuple(_sent(question, frame, event)))
                    place = place or question.place
                    return cls(*what, question=question, place=place, event=event)
        return None

    def words(self) -> str:
        who = "; ".join(self.sent) if self.sent else f"nobody sent a transform of {self.frame}"
        said = shortened(self.said, _TEXT_MAX)
        return f"{self.question.name} ran, but tf2 had no transform: {said}: {who}"


def _said(question: Question, event: int) -> Iterator[tuple[str, str]]:
    trace = question.history.trace
    if (raised := question.raised(event)) is not None:
        yield raised
    for output in trace.outputs_of(event):
        if output.kind is OutputKind.LOG and (record := log_record(trace, output)) is not None:
            yield record.text, record.place


def _sent(question: Question, frame: str, event: int) -> Iterator[str]:
    """Yield who sent transforms of a frame before an event, and when last."""
    entities = question.history.trace.entities.values()
    topics = [
        e for e in entities if e.kind is EntityKind.PUBLISHER and e.name in ("/tf", "/tf_static")
    ]
    for sender in topics:
        last = ""
        for message in question.history.messages([sender], 0):
            try:
                decoded = _decoded(question, sender, message.event, message.output)
                transforms = decoded.transforms if message.event <= event else ()
            except (AttributeError, TraceError):  # not recorded, or another type
                continue
            for one in transforms:
                if frame in (one.child_frame_id, one.header.frame_id):
                    sent_ns = question.history.trace.stamp(message.sent_ns)
                    times = map(seconds_text, (sent_ns, _stamp_ns(one.header)))
                    last = "last at {} s, with stamp {} s".format(*times)
        if last:
            yield f"{question.named(sender.id)} sent {frame} {last}"
