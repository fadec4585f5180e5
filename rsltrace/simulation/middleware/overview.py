"""The graph of a run as plain values: nodes, connections, and problems."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.graph import Graph
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos.policies import incompatible_policies
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.trace.model.operation import NODE_SERVICES, NODE_TOPICS

_ACTION = "/_action/"
_CLOCK = "/clock"
_TRANSFORMS = "/tf"
_STATIC_TRANSFORMS = "/tf_static"


@dataclass(frozen=True, slots=True)
class GraphEnd:
    """One end of a topic, service or action: the node, and (of a topic) its QoS as text."""

    node: str
    qos: str = ""


@dataclass(frozen=True, slots=True)
class GraphLink:
    """A topic, service or action with its ends in creation order. ``senders`` publish or call,
    ``receivers`` subscribe or serve. ``incompatible`` has (sender, receiver, policies) of pairs
    that do not connect."""

    kind: str
    name: str
    type: str
    senders: tuple[GraphEnd, ...]
    receivers: tuple[GraphEnd, ...]
    incompatible: tuple[tuple[GraphEnd, GraphEnd, str], ...] = ()


@dataclass(frozen=True, slots=True)
class GraphNode:
    """A node, its class, and its timers as (callback, period in ns)."""

    name: str
    type: str
    timers: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class GraphOverview:
    """The graph after construction. ``waiting`` says what has not finished."""

    nodes: tuple[GraphNode, ...]
    links: tuple[GraphLink, ...]
    waiting: tuple[str, ...] = ()
    problems: tuple[str, ...] = field(default=())

    def of_kind(self, kind: str) -> list[GraphLink]:
        """Return the links of one kind (``topic``, ``service``, ``action``)."""
        return [link for link in self.links if link.kind == kind]


def graph_overview(
    graph: Graph,
    waiting: Iterable[str],
    *,
    everything: bool = False,
    follows: Callable[[str], bool] = lambda node: False,
) -> GraphOverview:
    """Return the current graph; ``everything`` includes what every node has.

    ``follows`` says whether ``/clock`` drives a node's time; other nodes subscribe to it in vain.
    """
    nodes = tuple(
        GraphNode(node.fully_qualified_name, node.trace_type(), tuple(node.timer_periods()))
        for node in graph.nodes
    )
    links = [*_topics(graph), *_services(graph), *_actions(graph)]
    if not everything:
        links = [link for link in links if not _is_everywhere(link)]
    links.sort(key=lambda link: (link.kind, link.name))
    moving = any(link.name == _TRANSFORMS and link.senders for link in links)
    doubtful = [link for link in links if not (moving and _is_unheard_static(link))]
    return GraphOverview(
        nodes,
        tuple(links),
        waiting=tuple(waiting),
        problems=(
            *_namesakes(nodes),
            *(one for link in doubtful for one in _problems(link, follows)),
        ),
    )


def _namesakes(nodes: Iterable[GraphNode]) -> Iterator[str]:
    """Yield the names that several nodes share."""
    for name, count in Counter(node.name for node in nodes).items():
        if count > 1:
            yield (
                f"{count} nodes are named {name}: their parameters, services and logs go by that "
                "name; unless that is meant, give each a name of its own (name: or namespace:)"
            )


def _topics(graph: Graph) -> Iterator[GraphLink]:
    for name, (type_name,) in graph.topic_names_and_types():
        publishers, subscriptions = graph.publishers(name), graph.subscriptions(name)
        yield GraphLink(
            "topic",
            name,
            type_name,
            tuple(_end(publisher) for publisher in publishers),
            tuple(_end(subscription) for subscription in subscriptions),
            tuple(
                (
                    _end(publisher),
                    _end(subscription),
                    " and ".join(p.name.lower() for p in policies),
                )
                for publisher in publishers
                for subscription in subscriptions
                if (policies := incompatible_policies(publisher.qos, subscription.qos))
            ),
        )


def _services(graph: Graph) -> Iterator[GraphLink]:
    for name, (type_name, *_) in graph.service_names_and_types():
        yield GraphLink(
            "service",
            name,
            type_name,
            tuple(GraphEnd(_name_of(client)) for client in graph.clients(name)),
            tuple(GraphEnd(_name_of(server)) for server in graph.services(name)),
        )


def _actions(graph: Graph) -> Iterator[GraphLink]:
    ends: dict[tuple[str, str], tuple[list[GraphEnd], list[GraphEnd]]] = {}
    for node in graph.nodes:
        for action in node.actions:
            key = (action.name, action.type_name)
            ends.setdefault(key, ([], []))[0 if action.is_client else 1].append(
                GraphEnd(node.fully_qualified_name)
            )
    for (name, type_name), (clients, servers) in ends.items():
        yield GraphLink("action", name, type_name, tuple(clients), tuple(servers))


def _end(endpoint: Publisher | Subscription) -> GraphEnd:
    return GraphEnd(_name_of(endpoint), endpoint.qos.describe())


def _name_of(endpoint: DomainEntity) -> str:
    return "(no node)" if endpoint.node is None else str(endpoint.node.fully_qualified_name)


def _is_everywhere(link: GraphLink) -> bool:
    """Whether a link is one that rclpy makes for every node, or part of an action."""
    if _ACTION in link.name:
        return True
    if link.kind == "topic":
        return link.name in NODE_TOPICS and not link.receivers
    return link.kind == "service" and (
        link.name.rpartition("/")[2] in NODE_SERVICES and not link.senders
    )


def _is_unheard_static(link: GraphLink) -> bool:
    """Whether a link is the ``/tf_static`` subscription of tf2 listeners, without publishers."""
    return link.name == _STATIC_TRANSFORMS and not link.senders


def _problems(link: GraphLink, follows: Callable[[str], bool]) -> Iterator[str]:
    for sender, receiver, policy in link.incompatible:
        yield (
            f"topic {link.name}: {sender.node} and {receiver.node} do not connect: {policy} "
            f"({sender.node} offers {sender.qos}; {receiver.node} asks for {receiver.qos})"
        )
    if link.receivers and not link.senders and link.kind == "topic":
        nodes = [end.node for end in link.receivers]
        if link.name == _CLOCK:
            waiting = [node for node in nodes if follows(node)]
            if waiting:
                yield (
                    f"topic {_CLOCK}: {_who(waiting, 'uses it', 'use it')} (clocks: source: "
                    "topic), but it has no publisher: ROS time stands still at 0"
                )
        elif link.name not in NODE_TOPICS:
            who = _who(nodes, "subscribes", "subscribe")
            yield f"topic {link.name}: {who}, but it has no publisher"
    if link.senders and not link.receivers and link.kind != "topic":
        who = _who([end.node for end in link.senders], "calls", "call")
        yield f"{link.kind} {link.name}: {who}, but it has no server"


def _who(nodes: Iterable[str], one: str, several: str) -> str:
    """Return ``/a subscribes`` or ``/a, /b and /c subscribe``."""
    *names, last = dict.fromkeys(nodes)
    return f"{', '.join(names)} and {last} {several}" if names else f"{last} {one}"
