"""Plots of one or two recordings; times count from the start of each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rsltrace.errors import TraceError
from rsltrace_viewer.model.plots.series import (
    SAMPLES_MAX,
    TELLING_MAX,
    PlotSource,
    Series,
    numeric_paths,
    value_at,
)
from rsltrace_viewer.model.recordings.recording import Recording, Topic
from rsltrace_viewer.model.recordings.session import RecordingSession
from rsltrace_viewer.model.timeline.message_values import samples, too_large

_RATE_BINS = 240


class RecordingPlots:
    def __init__(self, session: RecordingSession) -> None:
        self._session = session

    def title(self) -> str:
        return self._session.title()

    def topics(self) -> list[str]:
        return list(dict.fromkeys(name for name, _ in self._session.keys if self._of(name)))

    def others(self) -> list[PlotSource]:
        return [PlotSource("rate", name) for name in self.topics()]

    def fields(self, topic: str) -> list[PlotSource]:
        for recording, found in self._of(topic):
            if found.data and found.data[0] is not None:
                message = recording.decode(found, found.data[0])
                return [PlotSource("field", topic, path) for path in numeric_paths(message)]
        return []

    def messages(self, topic: str) -> list[list[object]]:
        """Return some messages of a topic in each recording, as many in each. Raises TraceError."""
        found = self._of(topic)
        count = min((len(topic.data) for _, topic in found), default=0)
        chosen = [
            [topic.data[number] for _, topic in found] for number in samples(count, TELLING_MAX)
        ]
        small = [
            kept
            for ones in chosen
            if len(kept := [one for one in ones if one is not None]) == len(found)
            and not too_large(found[0][1].type, max(map(len, kept)))
        ]
        return [
            [recording.decode(topic, ones[place]) for ones in small]
            for place, (recording, topic) in enumerate(found)
        ]

    def first(self) -> tuple[str, str]:
        """Return the field that differs first, or the selected topic."""
        session = self._session
        diff = session.diff
        if diff is not None and diff.first is not None and diff.first.fields:
            return diff.first.topic, diff.first.fields[0].path
        return (session.keys[session.place][0] if session.keys else ""), ""

    def cursor_s(self) -> float | None:
        session = self._session
        if not session.pairs.count:
            return None
        time = session.message_text(min(session.row, session.pairs.count - 1))[0]
        return float(time) if time else None

    def series(self, source: PlotSource) -> Iterator[list[Series]]:
        """Yield the series of each recording. Raises TraceError."""
        done: list[Series] = []
        for recording, topic in self._of(source.name):
            latest = None
            steps = _rate if source.kind == "rate" else _field
            for latest in steps(recording, topic, source.field):
                yield [*done, latest]
            if latest is not None:
                done.append(latest)
        yield done

    def _of(self, name: str) -> list[tuple[Recording, Topic]]:
        found = []
        for recording in self._session.recordings:
            topics = [topic for topic in recording.topics if topic.name == name and topic.stamps]
            found += [(recording, topic) for topic in topics[:1]]
        return found


def _field(recording: Recording, topic: Topic, field: str) -> Iterator[Series]:
    count = len(topic.data)
    step = max(-(-count // SAMPLES_MAX), 1)
    note = f"one in {step} of {count:,} messages" if step > 1 else f"{count:,} messages"
    times, values = [], []
    for place in range(0, count, step):
        data = topic.data[place]
        if data is None:
            note = f"the first {place:,} messages: more are not kept in memory"
            break
        try:
            values.append(value_at(recording.decode(topic, data), field))
        except (AttributeError, TypeError, ValueError) as error:
            raise TraceError(f"{topic.name} has no number {field} in every message") from error
        times.append((topic.stamps[place] - recording.start_ns) / 1e9)
        if len(times) % 100 == 0:
            yield Series(np.array(times), np.array(values), note)
    yield Series(np.array(times), np.array(values), note)


def _rate(recording: Recording, topic: Topic, field: str) -> Iterator[Series]:
    stamps = (np.array(topic.stamps, dtype=np.int64) - recording.start_ns) / 1e9
    length = max((recording.end_ns - recording.start_ns) / 1e9, 1e-9)
    counts, edges = np.histogram(stamps, bins=_RATE_BINS, range=(0.0, length))
    width = length / _RATE_BINS
    yield Series(edges[:-1] + width / 2, counts / width, f"in steps of {width:.3g} s")
