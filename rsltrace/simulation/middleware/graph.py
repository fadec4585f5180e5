"""The nodes and endpoints of a run, and their connections.

Everything is in creation order, so that fan-out is the same on every machine (in DDS it depends on
hashes of addresses).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rsltrace.errors import UnsupportedError
from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos.policies import Qos, incompatible_policies
from rsltrace.simulation.middleware.services import Client, Service
from rsltrace.simulation.middleware.subscription import Subscription

EndT = TypeVar("EndT", bound=DomainEntity)


class Graph:
    """The nodes and endpoints of one world. ``joined`` are called with each new node and server,
    ``changed`` after whatever has joined or left."""

    def __init__(self) -> None:
        self.nodes: list[Participant] = []
        self.joined: list[Callable[[DomainEntity], None]] = []
        self.changed: list[Callable[[], None]] = []
        self._named: dict[str, list[Participant]] = {}
        self._publishers: dict[str, list[Publisher]] = {}
        self._subscriptions: dict[str, list[Subscription]] = {}
        self._clients: dict[str, list[Client]] = {}
        self._services: dict[str, list[Service]] = {}

    def node_named(self, fully_qualified_name: str) -> Participant | None:
        return next(iter(self.nodes_named(fully_qualified_name)), None)

    def nodes_named(self, fully_qualified_name: str) -> list[Participant]:
        return self._named.get(fully_qualified_name, [])

    def publishers(self, topic: str) -> list[Publisher]:
        return self._publishers.get(topic, [])

    def subscriptions(self, topic: str) -> list[Subscription]:
        return self._subscriptions.get(topic, [])

    def clients(self, service: str) -> list[Client]:
        return self._clients.get(service, [])

    def all_clients(self) -> list[Client]:
        return [client for clients in self._clients.values() for client in clients]

    def services(self, service: str) -> list[Service]:
        return self._services.get(service, [])

    def add_node(self, node: Participant) -> None:
        self.nodes.append(node)
        self._named.setdefault(node.fully_qualified_name, []).append(node)
        node.graph = self
        self._announce(node)

    def add_publisher(self, publisher: Publisher) -> None:
        self._check_type(publisher)
        self._publishers.setdefault(publisher.topic, []).append(publisher)
        publisher.graph = self
        for subscription in self.subscriptions(publisher.topic):
            self._connect(publisher, subscription)
        self._notify_changed()

    def add_subscription(self, subscription: Subscription) -> None:
        """Connect a new subscription; it gets what transient-local publishers kept for it."""
        self._check_type(subscription)
        self._subscriptions.setdefault(subscription.topic, []).append(subscription)
        subscription.graph = self
        for publisher in self.publishers(subscription.topic):
            self._connect(publisher, subscription)
        self._notify_changed()

    def add_client(self, client: Client) -> None:
        self._clients.setdefault(client.service, []).append(client)
        client.graph = self
        self._notify_changed()

    def add_service(self, service: Service) -> None:
        self._services.setdefault(service.service, []).append(service)
        service.graph = self
        self._announce(service)

    def _announce(self, member: DomainEntity) -> None:
        for listener in self.joined:
            listener(member)
        self._notify_changed()

    def _notify_changed(self) -> None:
        for listener in self.changed:
            listener()

    def remove(self, member: DomainEntity) -> None:
        """Remove a member and disconnect its peers."""
        if isinstance(member, Publisher):
            self._publishers[member.topic].remove(member)
            for subscription in member.subscriptions:
                subscription.publishers.remove(member)
                subscription.events.matched(-1)
            member.disconnect_all()
        elif isinstance(member, Subscription):
            self._subscriptions[member.topic].remove(member)
            for publisher in self.publishers(member.topic):
                if publisher in member.publishers:
                    publisher.disconnect(member)
                    publisher.events.matched(-1)
            member.publishers = []
        elif isinstance(member, Client):
            self._clients[member.service].remove(member)
        elif isinstance(member, Service):
            self._services[member.service].remove(member)
        elif isinstance(member, Participant):
            self.nodes.remove(member)
            self._named[member.fully_qualified_name].remove(member)
        self._notify_changed()

    def settled_request(self, topic: str, requested: Qos) -> Qos:
        """Return the resolved QoS of a new subscription, given the current publishers."""
        peers = [publisher.qos for publisher in self.publishers(topic)]
        return requested.resolved(publisher=False, peers=peers)

    def _connect(self, publisher: Publisher, subscription: Subscription) -> None:
        policies = incompatible_policies(publisher.qos, subscription.qos)
        if policies:
            publisher.events.incompatible(policies[0])
            subscription.events.incompatible(policies[0])
            return
        publisher.connect(subscription)
        subscription.publishers.append(publisher)
        publisher.events.matched(+1)
        subscription.events.matched(+1)
        publisher.send_history(subscription)

    def _check_type(self, endpoint: Publisher | Subscription) -> None:
        there = self.publishers(endpoint.topic) or self.subscriptions(endpoint.topic)
        if there and there[0].type_name != endpoint.type_name:  # all that are there have one type
            other = there[0]
            raise UnsupportedError(
                f"topic {endpoint.topic} has two types: {other.describe()} is "
                f"{other.type_name}, {endpoint.describe()} is {endpoint.type_name}. They "
                "would never hear each other; rename or remap one of them"
            )

    def endpoints_of(self, node: Participant) -> list[DomainEntity]:
        return [
            *self.publishers_of(node),
            *self.subscriptions_of(node),
            *self.services_of(node),
            *self.clients_of(node),
        ]

    def publishers_of(self, node: Participant) -> list[Publisher]:
        return _of(node, self._publishers)

    def subscriptions_of(self, node: Participant) -> list[Subscription]:
        return _of(node, self._subscriptions)

    def services_of(self, node: Participant) -> list[Service]:
        return _of(node, self._services)

    def clients_of(self, node: Participant) -> list[Client]:
        return _of(node, self._clients)

    def topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return every topic with its type, sorted by name."""
        topics: dict[str, str] = {}
        for topic, publishers in self._publishers.items():
            topics.update((topic, publisher.type_name) for publisher in publishers)
        for topic, subscriptions in self._subscriptions.items():
            topics.update((topic, subscription.type_name) for subscription in subscriptions)
        return [(topic, [topics[topic]]) for topic in sorted(topics)]

    def service_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return every service that has a server or a client, sorted by name."""
        services: dict[str, set[str]] = {}
        for name, servers in self._services.items():
            services.setdefault(name, set()).update(server.type_name for server in servers)
        for name, clients in self._clients.items():
            services.setdefault(name, set()).update(client.type_name for client in clients)
        services = {name: types for name, types in services.items() if types}
        return [(name, sorted(services[name])) for name in sorted(services)]


def _of(node: Participant, ends: dict[str, list[EndT]]) -> list[EndT]:
    return [end for named in ends.values() for end in named if end.node is node]


def action_names_and_types(topics: list[tuple[str, list[str]]]) -> list[tuple[str, list[str]]]:
    """Return the actions among topics: rcl finds them by their feedback topics, too."""
    name_end, type_end = "/_action/feedback", "_FeedbackMessage"
    return [
        (name.removesuffix(name_end), [t.removesuffix(type_end) for t in types])
        for name, types in topics
        if name.endswith(name_end) and all(t.endswith(type_end) for t in types)
    ]


def names_and_types(endpoints: list[tuple[str, str]]) -> list[tuple[str, list[str]]]:
    """Group (name, type) pairs as rclpy's ``…_by_node`` queries return them."""
    grouped: dict[str, set[str]] = {}
    for name, type_name in endpoints:
        grouped.setdefault(name, set()).add(type_name)
    return [(name, sorted(grouped[name])) for name in sorted(grouped)]
