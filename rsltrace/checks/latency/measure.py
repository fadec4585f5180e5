"""The chains of a trace, and how long data takes through them."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.flow import MessageFlow
from rsltrace.checks.latency.instances import (
    ChainMessages,
    Durations,
    HopMessages,
    HopTimes,
    LatencyFigures,
    figures,
    instances,
    parts_of,
    passages,
)
from rsltrace.checks.latency.paths import ChainSelection, Hop, sink_hop
from rsltrace.errors import TraceError, near_or_all
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import is_named

# Where a chain breaks off: a node takes a message, and what it publishes has another cause.

_SAMPLERS_NAMED = 3
_Graph = dict[str, list[Hop]]
"""By topic: the nodes that receive it, with each topic that these publish."""


def where_broken(flow: MessageFlow, wanted: ChainSelection) -> str:
    """Return why nothing came through the chain that is wanted, in a sentence."""
    first, last = wanted.first, wanted.last
    graph = _graph(flow)
    if wanted.topics:
        return _of_topics(flow, wanted, graph)
    if first is None or last is None:
        if first is not None:
            return f"no message was caused by one of {first}{_stored(graph, first)}"
        return f"no message of {last} was caused by another one"
    way = _way(graph, first, last)
    what = f"message of {last}" if flow.sink is None else f"callback of {flow.sink}"
    said = f"no {what} came of one of {first}"
    if not way:
        return f"{said}: no way leads there, from subscription to publisher"
    reached = {hop for path in flow.paths.hops for hop in path}
    known = {flow.paths.known[hop] for hop in reached}
    before = first
    for hop in way:
        if hop not in known:
            return f"{said}: {_break(before, hop)}"
        before = hop.topic
    return said


def samplers(flow: MessageFlow) -> list[tuple[str, str]]:
    """Return the nodes that receive messages and begin chains of their own, and what to know."""
    begun: dict[str, set[str]] = {}
    for hops in flow.paths.hops:
        if len(hops) == 1:
            hop = flow.paths.known[hops[0]]
            begun.setdefault(hop.node, set()).add(hop.topic)
    received: dict[str, set[str]] = {}
    of_entity = {one: flow.node_of(one) for one in set(flow.taken["entity"])}
    for entity, node in of_entity.items():
        received.setdefault(node, set()).add(flow.trace.entity(entity).name)
    return [
        (
            node,
            f"{node} publishes {', '.join(sorted(topics))} with no message as the cause, and "
            f"receives {', '.join(sorted(received[node]))}; --via {node} takes the last ones for "
            "what it used",
        )
        for node, topics in sorted(begun.items())
        if node in received
    ]


def _of_topics(flow: MessageFlow, wanted: ChainSelection, graph: _Graph) -> str:
    """Say at which of the topics of a chain it breaks off."""
    longest = max((len(hops) for hops in flow.paths.hops), default=0)
    if not longest:
        return f"there is no message of {wanted.topics[0]}"
    before, topic = wanted.topics[longest - 1 : longest + 1]
    at_end = flow.sink is not None and topic == sink_hop(flow.sink).topic
    what = f"callback of {flow.sink}" if at_end else f"message of {topic}"
    said = f"no {what} came of one of {before} that came through the chain"
    for hop in graph.get(before, ()):
        if hop.topic == topic:
            return f"{said}: {_break(before, hop)}"
    nobody = (
        f"{said}: it receives none"
        if at_end
        else f"{said}: nobody receives the one and publishes the other"
    )
    between = ",".join(hop.topic for hop in _way(graph, before, topic)[:-1])
    return f"{nobody}; {between} may belong in between" if between else nobody


def _break(before: str, hop: Hop) -> str:
    if hop == sink_hop(hop.node):
        return f"no callback of {hop.node} has taken a message of {before} that came of it"
    return (
        f"{hop.node} receives {before} and publishes {hop.topic}, but nothing that it publishes "
        f"there has such a message as its cause. If it makes use of the last one, as a timer does "
        f"that samples: --via {hop.node}"
    )


def _stored(graph: _Graph, topic: str) -> str:
    nodes = sorted({hop.node for hop in graph.get(topic, ())})
    return f"; {', '.join(nodes)} may make use of the last one: --via {nodes[0]}" if nodes else ""


def _graph(flow: MessageFlow) -> _Graph:
    received: dict[str, set[str]] = {}
    sent: dict[str, set[str]] = {}
    for entity in flow.trace.entities.values():
        node = flow.node_of(entity.id)
        if entity.kind is EntityKind.SUBSCRIPTION:
            received.setdefault(entity.name, set()).add(node)
        elif entity.kind is EntityKind.PUBLISHER and entity.name not in NODE_TOPICS:
            sent.setdefault(node, set()).add(entity.name)
    if flow.sink is not None:
        sent.setdefault(flow.sink, set()).add(sink_hop(flow.sink).topic)
    return {
        topic: [Hop(node, one) for node in sorted(nodes) for one in sorted(sent.get(node, ()))]
        for topic, nodes in received.items()
    }


def _way(graph: _Graph, first: str, last: str) -> list[Hop]:
    """Return a shortest way from one topic to another through nodes, without the first topic."""
    ways: dict[str, list[Hop]] = {first: []}
    queue = deque([first])
    while queue:
        topic = queue.popleft()
        for hop in graph.get(topic, ()):
            if hop.topic not in ways:
                ways[hop.topic] = [*ways[topic], hop]
                queue.append(hop.topic)
    return ways.get(last, [])


MEASURES = ("latency", "age", "last_age", "reaction", "worst_reaction")
"""What is measured of a chain: see ``ChainLatency``."""


MOMENT_DTYPE = np.dtype(
    [(name, "<i8") for name in ("duration", "input_event", "input_ns", "output_event", "output_ns")]
)
"""Durations as in ``ChainDuration``."""


@dataclass(frozen=True, slots=True)
class ChainDuration:
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

    def __init__(self, flow: MessageFlow, path: int) -> None:
        self._flow = flow
        self._path = path
        self.hops: tuple[Hop, ...] = flow.paths.named(path)

    @property
    def name(self) -> str:
        """Its topics: ``/scan → /objects → /cmd_vel``."""
        return " → ".join(hop.topic for hop in self.hops)

    @cached_property
    def found(self) -> ChainMessages:
        """Its inputs and outputs."""
        return instances(self._flow, self._path)

    @cached_property
    def parts(self) -> list[HopTimes]:
        """Where the time goes, for each hop after the first."""
        return parts_of(self._flow, self.found)

    @cached_property
    def passages(self) -> list[HopMessages]:
        """How many messages of each hop but the last went on."""
        return passages(self._flow, self._path, self.found)

    @property
    def inputs(self) -> int:
        return len(self.found.input_ns)

    @property
    def outputs(self) -> int:
        """How many messages end it."""
        return len(self.found.output_ns)

    def durations(self, measure: str) -> Durations:
        """Return the durations of one of ``MEASURES``, in order of the outputs (of the inputs, for
        reactions)."""
        return self._measured(measure)[0]

    def figures(self, measure: str) -> LatencyFigures | None:
        """Return the figures of one of ``MEASURES``; None if there is nothing to measure."""
        return figures(self.durations(measure))

    def worst(self, measure: str) -> ChainDuration | None:
        """Return the first of the longest durations of one of ``MEASURES``."""
        moments = self.moments(measure)
        if not len(moments):
            return None
        found = ChainDuration(*map(int, moments[moments["duration"].argmax()]))
        stamp = self._flow.trace.stamp
        return replace(found, input_ns=stamp(found.input_ns), output_ns=stamp(found.output_ns))

    def moments(self, measure: str) -> npt.NDArray[np.void]:
        """Return the ``durations`` of a measure with their events: MOMENT_DTYPE."""
        durations, sources, outputs = self._measured(measure)
        found, flow = self.found, self._flow
        moments = np.zeros(len(durations), dtype=MOMENT_DTYPE)
        moments["duration"] = durations
        moments["input_event"] = flow.events_of(found.input_rows)[sources]
        moments["input_ns"] = found.input_ns[sources]
        moments["output_event"] = flow.events_of(found.came[:, -1])[outputs]
        moments["output_ns"] = found.output_ns[outputs]
        return moments

    def unanswered(self) -> npt.NDArray[np.void]:
        """Return the inputs that no output came of, or of a later one: MOMENT_DTYPE, without a
        duration and an output."""
        answered, found = len(self.found.answers()), self.found
        moments = np.zeros(len(found.input_ns) - answered, dtype=MOMENT_DTYPE)
        moments["input_event"] = self._flow.events_of(found.input_rows[answered:])
        moments["input_ns"] = found.input_ns[answered:]
        return moments

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
    them; ``missing`` says why there is no chain of those that were asked for."""

    chains: tuple[ChainLatency, ...]
    notes: tuple[str, ...] = ()
    missing: str = ""


def measure_latencies(
    trace: Trace,
    *,
    start: str | None = None,
    end: str | None = None,
    topics: Sequence[str] = (),
    via: Collection[str] = (),
) -> Latencies:
    """Return the chains of a trace: all, those from and to a topic, or that through ``topics``.

    A node as ``end`` (or last of the topics) stands for the end of its callback that has taken the
    last message. ``via`` names nodes (or globs of them) that publish what they make of the last
    message that they received, as a timer does that samples.

    :raises TraceError: the trace is damaged, there is no such topic or node, or nothing came
        through such a chain.
    """
    *_, found = measuring(trace, start=start, end=end, topics=topics, via=via)
    assert found is not None
    if found.missing:
        raise TraceError(f"{trace.name}: {found.missing}")
    return found


def measuring(
    trace: Trace,
    *,
    start: str | None = None,
    end: str | None = None,
    topics: Sequence[str] = (),
    via: Collection[str] = (),
) -> Iterator[Latencies | None]:
    """Read a trace: yield None after each segment, and in the end its chains.

    :raises TraceError: the trace is damaged.
    """
    chosen = nodes_called(trace, via)
    sink = _sink(trace, topics[-1] if topics else end)
    if sink is not None and topics:
        topics = (*topics[:-1], sink_hop(sink).topic)
    elif sink is not None:
        end = sink_hop(sink).topic
    missing = _not_there(trace, start, end, topics, via, sink)
    if missing:
        yield Latencies((), missing=missing)
        return
    wanted = ChainSelection(start, end, tuple(topics), chosen, sink)
    flow = MessageFlow(trace, wanted)
    for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
        flow.read(events, outputs)
        yield None
    chains = [ChainLatency(flow, path) for path in flow.paths.ends()]
    if not chains and (wanted.first is not None or wanted.last is not None):
        missing = where_broken(flow, wanted)
    chains.sort(key=lambda one: (-one.outputs, one.name, one.hops))
    notes = [
        f"what {node} publishes is taken to come of the last message that it received of each topic"
        for node in wanted.via
    ]
    if wanted.first is None and wanted.last is None:
        sampling = [said for node, said in samplers(flow) if node not in wanted.via]
        notes += sampling[:_SAMPLERS_NAMED]
        if len(sampling) > _SAMPLERS_NAMED:
            more = len(sampling) - _SAMPLERS_NAMED
            notes.append(f"so do {more} more nodes; --via takes globs, too")
    yield Latencies(tuple(chains), tuple(notes), missing)


def nodes_called(trace: Trace, names: Collection[str]) -> tuple[str, ...]:
    """Return the nodes of a trace that are meant by names and globs."""
    return tuple(node for node in _nodes(trace) if any(is_named(one, node) for one in names))


def _nodes(trace: Trace) -> list[str]:
    of_nodes = (one.name for one in trace.entities.values() if one.kind is EntityKind.NODE)
    return list(dict.fromkeys(of_nodes))


def _sink(trace: Trace, last: str | None) -> str | None:
    """Return the node that a chain is to end in, None if it is to end with a topic."""
    if last is None:
        return None
    if last in _topics(trace):
        return None
    return next((node for node in _nodes(trace) if last in (node, sink_hop(node).topic)), None)


def _topics(trace: Trace) -> list[str]:
    entities = trace.entities.values()
    return sorted({one.name for one in entities if one.kind is EntityKind.PUBLISHER})


def _not_there(
    trace: Trace,
    start: str | None,
    end: str | None,
    topics: Sequence[str],
    via: Collection[str],
    sink: str | None,
) -> str:
    """Return what there is not, of what is asked for."""
    sent = _topics(trace)
    ends = () if sink is None else (sink_hop(sink).topic,)
    for topic in (start, end, *topics):
        if topic is not None and topic not in sent and topic not in ends:
            return f"nobody publishes {topic}{near_or_all(topic, sent)}"
    if start is not None and start == end:
        return f"{start} is both ends of the chain; name a loop by its topics (--chain)"
    for one in via:
        if not nodes_called(trace, [one]):
            return f"no node is called {one}{near_or_all(one, _nodes(trace))}"
    return ""
