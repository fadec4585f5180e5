"""The chains of a trace, and how long data takes through them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rsltrace.errors import TraceError, nearest
from rsltrace.latency.broken import samplers, where_broken
from rsltrace.latency.figures import Durations, Figures, figures
from rsltrace.latency.flow import Flow, follow
from rsltrace.latency.instances import (
    Instances,
    Parts,
    Passage,
    instances,
    parts_of,
    passages,
)
from rsltrace.latency.paths import Hop, Wanted
from rsltrace.model.entity import EntityKind
from rsltrace.trace.reader import Trace
from rsltrace.words.matching import is_named

MEASURES = ("latency", "age", "last_age", "reaction", "worst_reaction")
"""What is measured of a chain: see ``ChainLatency``."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A duration, and the events that published the input and the output that it lies between."""

    duration_ns: int
    input_event: int
    input_ns: int
    output_event: int
    output_ns: int


class ChainLatency:
    """A chain of a trace: what came through it, and how long that took.

    ``hops`` are its topics with the nodes that publish them, ``sampled`` the nodes of which an
    output is taken to come of the last message received. Durations are simulated ns.
    """

    def __init__(self, flow: Flow, path: int) -> None:
        self._flow = flow
        self._path = path
        self.hops: tuple[Hop, ...] = flow.paths.named(path)

    @property
    def name(self) -> str:
        """Its topics: ``/scan → /objects → /cmd_vel``."""
        return " → ".join(hop.topic for hop in self.hops)

    @cached_property
    def found(self) -> Instances:
        """Its inputs and outputs."""
        return instances(self._flow, self._path)

    @cached_property
    def parts(self) -> list[Parts]:
        """Where the time goes, for each hop after the first."""
        return parts_of(self._flow, self.found)

    @cached_property
    def passages(self) -> list[Passage]:
        """How many messages of each hop but the last went on."""
        return passages(self._flow, self._path, self.found)

    @property
    def inputs(self) -> int:
        """How many messages begin it."""
        return len(self.found.input_ns)

    @property
    def outputs(self) -> int:
        """How many messages end it."""
        return len(self.found.output_ns)

    def durations(self, measure: str) -> Durations:
        """Return the durations of one of ``MEASURES``, in order of the outputs (of the inputs, for
        reactions)."""
        return self._measured(measure)[0]

    def figures(self, measure: str) -> Figures | None:
        """Return the figures of one of ``MEASURES``; None if there is nothing to measure."""
        return figures(self.durations(measure))

    def worst(self, measure: str) -> Moment | None:
        """Return the first of the longest durations of one of ``MEASURES``."""
        durations = self.durations(measure)
        return self.moment(measure, int(durations.argmax())) if len(durations) else None

    def moment(self, measure: str, place: int) -> Moment:
        """Return one of the ``durations`` of a measure with its events."""
        durations, sources, outputs = self._measured(measure)
        found, source, output = self.found, int(sources[place]), int(outputs[place])
        return Moment(
            int(durations[place]),
            self._flow.event_of(int(found.input_rows[source])),
            int(found.input_ns[source]),
            self._flow.event_of(int(found.came[output, -1])),
            int(found.output_ns[output]),
        )

    def events(self) -> Durations:
        """Return the indexes of the events that each output came through, shape (outputs, hops)."""
        return self._flow.events_of(self.found.came)

    def _measured(self, measure: str) -> tuple[Durations, Durations, Durations]:
        """Return durations, the place of each one's input and that of its output."""
        found = self.found
        outputs = np.arange(len(found.source))
        if measure == "latency":
            return found.ages_ns()[found.first], found.source[found.first], found.first
        if measure == "age":
            return found.ages_ns(), found.source, outputs
        if measure == "last_age":
            return found.last_ages_ns(), found.source[:-1], outputs[1:]
        answers = found.answers()
        if measure == "reaction":
            return found.reactions_ns(), np.arange(len(answers)), answers
        if measure == "worst_reaction":
            return found.worst_reactions_ns(), np.arange(max(len(answers) - 1, 0)), answers[1:]
        raise ValueError(f"expected one of {', '.join(MEASURES)}, got {measure!r}")


@dataclass(frozen=True, slots=True)
class Latencies:
    """The chains of a trace, those with the most outputs first. ``notes`` say what to know of
    them: where a node takes messages and publishes without one as its cause."""

    chains: tuple[ChainLatency, ...]
    notes: tuple[str, ...] = ()


def measure_latencies(
    trace: Trace,
    *,
    start: str | None = None,
    end: str | None = None,
    topics: Sequence[str] = (),
    via: Collection[str] = (),
) -> Latencies:
    """Return the chains of a trace: all, those from and to a topic, or that through ``topics``.

    ``via`` names nodes (or globs of them) that publish what they make of the last message that
    they received, as a timer does that samples.

    :raises TraceError: the trace is damaged, there is no such topic or node, or nothing came
        through such a chain.
    """
    wanted = _wanted(trace, start, end, topics, via)
    flow = follow(trace, wanted)
    chains = [ChainLatency(flow, path) for path in flow.paths.ends()]
    if not chains and (wanted.first is not None or wanted.last is not None):
        raise TraceError(where_broken(flow, wanted))
    chains.sort(key=lambda one: (-one.outputs, one.name, one.hops))
    notes = [
        f"what {node} publishes is taken to come of the last message that it received of each topic"
        for node in wanted.via
    ]
    if wanted.first is None and wanted.last is None:
        notes += [said for node, said in samplers(flow) if node not in wanted.via]
    return Latencies(tuple(chains), tuple(notes))


def _wanted(
    trace: Trace, start: str | None, end: str | None, topics: Sequence[str], via: Collection[str]
) -> Wanted:
    sent, nodes = set(), []
    for entity in trace.entities.values():
        if entity.kind is EntityKind.PUBLISHER:
            sent.add(entity.name)
        elif entity.kind is EntityKind.NODE:
            nodes.append(entity.name)
    known = sorted(sent)
    for topic in dict.fromkeys(one for one in (start, end, *topics) if one is not None):
        if topic not in sent:
            raise TraceError(f"{trace.name}: nobody publishes {topic}" + _near(topic, known))
    if start is not None and start == end:
        raise TraceError(f"{start} is both ends of the chain; name a loop by its topics (--chain)")
    chosen: list[str] = []
    for one in via:
        found = [node for node in nodes if is_named(one, node)]
        if not found:
            raise TraceError(f"{trace.name}: no node is called {one}" + _near(one, nodes))
        chosen += found
    return Wanted(start, end, tuple(topics), tuple(dict.fromkeys(chosen)))


def _near(name: str, names: Sequence[str]) -> str:
    near = nearest(name, names)
    if near is not None:
        return f"; did you mean {near}?"
    listed = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    return f"; there are {listed or 'none'}"
