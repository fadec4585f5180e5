"""Plots of one or two runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rsltrace.diff.result import Diff
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace_viewer.model.plots.series import (
    CHAIN_AGE,
    CHAIN_LATENCY,
    TELLING_MAX,
    PlotSource,
    Series,
    channel_of,
    fields_of,
    series_of,
    sources_of,
    topics_with_messages,
)
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.message_values import samples, too_large

_NOTHING = Series(np.zeros(0), np.zeros(0), "")


class RunPlots:
    """What can be plotted of ``runs``. ``topic`` is that of the selected event, or empty;
    ``chains`` are the names of those that are known."""

    def __init__(
        self,
        runs: Sequence[Run],
        title: str,
        *,
        topic: str,
        stamp_ns: int | None,
        diff: Diff | None = None,
        chains: Sequence[str] = (),
    ) -> None:
        self._runs = runs
        self._title = title
        self._topic = topic
        self._stamp_ns = stamp_ns
        self._diff = diff
        self._chains = list(dict.fromkeys(chains))

    def title(self) -> str:
        return self._title

    def topics(self) -> list[str]:
        return list(dict.fromkeys(t for run in self._runs for t in topics_with_messages(run)))

    def others(self) -> list[PlotSource]:
        """Return rates, latencies, and what is known of chains."""
        kinds = (CHAIN_LATENCY, CHAIN_AGE)
        chains = [PlotSource(kind, name) for name in self._chains for kind in kinds]
        return [*dict.fromkeys(s for run in self._runs for s in sources_of(run)), *chains]

    def fields(self, topic: str) -> list[PlotSource]:
        """Return the numeric fields of a topic. Raises TraceError."""
        of_runs = (
            fields_of(run, topic) for run in self._runs if topic in topics_with_messages(run)
        )
        return list(dict.fromkeys(field for fields in of_runs for field in fields))

    def messages(self, topic: str) -> list[list[object]]:
        """Return some messages of a topic in each run, as many in each. Raises TraceError."""
        found = [(run.trace, channel) for run in self._runs if (channel := channel_of(run, topic))]
        count = min((trace.message_counts[channel.id] for trace, channel in found), default=0)
        chosen = [
            [trace.message(channel.id, number)[1] for trace, channel in found]
            for number in samples(count, TELLING_MAX)
        ]
        small = [ones for ones in chosen if not too_large(found[0][1].type, max(map(len, ones)))]
        return [
            [trace.decode(channel, ones[place]) for ones in small]
            for place, (trace, channel) in enumerate(found)
        ]

    def first(self) -> tuple[str, str]:
        """Return the field that differs first; otherwise the topic of the selected event."""
        known = self.topics()
        diff = self._diff
        if diff is not None:
            divergences = [one for one in (diff.shown, *diff.divergences) if one is not None]
            differing = [
                (message.topic, field.path)
                for divergence in divergences
                for message in divergence.messages
                if message.topic in known
                for field in message.fields
            ]
            # A parameter that differs is no curve; what a node then sends is.
            if differing:
                return min(differing, key=lambda one: (one[0] in NODE_TOPICS, "stamp" in one[1]))
        wanted = self._topic in known and self._topic not in NODE_TOPICS
        return (self._topic if wanted else ""), ""

    def cursor_s(self) -> float | None:
        return None if self._stamp_ns is None else (self._stamp_ns - self._runs[0].base_ns) / 1e9

    def series(self, source: PlotSource) -> Iterator[list[Series]]:
        done: list[Series] = []
        for run in self._runs:
            latest = None
            for latest in series_of(run, source):
                yield [*done, _since_start(run, latest)]
            done.append(_since_start(run, latest) if latest is not None else _NOTHING)
        yield done


def _since_start(run: Run, one: Series) -> Series:
    if not run.base_ns:
        return one
    return Series(np.asarray(one.times - run.base_ns / 1e9), one.values, one.note)
