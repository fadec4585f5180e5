"""Where a chain breaks off: a node takes a message, and what it publishes has another cause."""

from __future__ import annotations

from collections import deque

from rsltrace.checks.latency.flow import Flow
from rsltrace.checks.latency.paths import Hop, Wanted, sink_hop
from rsltrace.trace.model.built_in import NODE_TOPICS
from rsltrace.trace.model.entity import EntityKind

_Graph = dict[str, list[Hop]]
"""By topic: the nodes that receive it, with each topic that these publish."""


def where_broken(flow: Flow, wanted: Wanted) -> str:
    """Return why nothing came through the chain that is wanted, in a sentence."""
    first, last = wanted.first, wanted.last
    graph = _graph(flow)
    if wanted.topics:
        return _of_topics(flow, wanted, graph)
    if first is None or last is None:
        if first is not None:
            return f"no message was caused by one of {first}{_stored(flow, graph, first)}"
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


def samplers(flow: Flow) -> list[tuple[str, str]]:
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


def _of_topics(flow: Flow, wanted: Wanted, graph: _Graph) -> str:
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


def _stored(flow: Flow, graph: _Graph, topic: str) -> str:
    nodes = sorted({hop.node for hop in graph.get(topic, ())})
    return f"; {', '.join(nodes)} may make use of the last one: --via {nodes[0]}" if nodes else ""


def _graph(flow: Flow) -> _Graph:
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
