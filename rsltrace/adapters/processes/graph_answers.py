"""Answers to what processes ask about the graph, as ``native/rmw_graph.cpp`` reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rsltrace.adapters.processes.wire import HEAD, RecordReader, gid_of, packed_qos, packed_text
from rsltrace.simulation.middleware.graph import Graph, names_and_types
from rsltrace.simulation.middleware.participant import Participant, full_name
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.subscription import Subscription

NamesAndTypes = Sequence[tuple[str, list[str]]]


def answer(graph: Graph, question: RecordReader) -> bytes:
    """Answer a question: its kind, and two texts that say what of."""
    kind, one, other = question.number(), question.text(), question.text()
    if kind == 1:
        return _nodes(graph)
    if kind in _COUNTED:
        return HEAD.pack(len(_COUNTED[kind](graph, one)))
    if kind == 6:
        return _found(graph.topic_names_and_types())
    if kind == 7:
        return _found(graph.service_names_and_types())
    if kind in _OF_NODE:
        node = graph.node_named(full_name(other, one))
        return HEAD.pack(0) if node is None else _found(_OF_NODE[kind](graph, node))
    ends: Sequence[Publisher | Subscription] = (
        graph.publishers(one) if kind == 12 else graph.subscriptions(one)
    )
    return HEAD.pack(len(ends)) + b"".join(map(_described, ends))


_COUNTED: dict[int, Callable[[Graph, str], Sequence[object]]] = {
    2: Graph.publishers,
    3: Graph.subscriptions,
    4: Graph.clients,
    5: Graph.services,
}


def _ends_of(ends: Sequence[Publisher | Subscription]) -> NamesAndTypes:
    return names_and_types([(end.topic, end.type_name) for end in ends])


_OF_NODE: dict[int, Callable[[Graph, Participant], NamesAndTypes]] = {
    8: lambda graph, node: _ends_of(graph.publishers_of(node)),
    9: lambda graph, node: _ends_of(graph.subscriptions_of(node)),
    10: lambda graph, node: names_and_types(
        [(end.service, end.type_name) for end in graph.services_of(node)]
    ),
    11: lambda graph, node: names_and_types(
        [(end.service, end.type_name) for end in graph.clients_of(node)]
    ),
}


def _texts(texts: Sequence[str]) -> bytes:
    return HEAD.pack(len(texts)) + b"".join(map(packed_text, texts))


def _nodes(graph: Graph) -> bytes:
    nodes = graph.nodes
    return b"".join(
        (
            _texts([node.name for node in nodes]),
            _texts([node.namespace for node in nodes]),
            _texts(["/"] * len(nodes)),
        )
    )


def _found(found: NamesAndTypes) -> bytes:
    parts = [packed_text(name) + _texts(types) for name, types in found]
    return HEAD.pack(1) + HEAD.pack(len(parts)) + b"".join(parts)


def _described(end: Publisher | Subscription) -> bytes:
    return b"".join(
        (
            packed_text(end.node.name),
            packed_text(end.node.namespace),
            packed_text(end.type_name),
            gid_of(end.entity_id),
            packed_qos(end.qos),
            packed_text(end.type.describe()[1]),
        )
    )
