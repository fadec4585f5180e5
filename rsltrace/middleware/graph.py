"""Who is there and who is connected to whom.

Everything is in creation order, so that fan-out is the same on every machine (in DDS it depends on
hashes of addresses).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeVar

from rsltrace.errors import UnsupportedError
from rsltrace.middleware.qos import incompatible_policies

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.boundary.pubsub import PublisherHandle, SubscriptionHandle
    from rsltrace.doors.rclpy.boundary.services import ClientHandle, ServiceHandle

EndT = TypeVar("EndT", bound="EntityHandle")


class Graph:
    """The nodes and endpoints of one world."""

    def __init__(self) -> None:
        self.nodes: list[NodeHandle] = []
        self._publishers: dict[str, list[PublisherHandle]] = {}
        self._subscriptions: dict[str, list[SubscriptionHandle]] = {}
        self._clients: dict[str, list[ClientHandle]] = {}
        self._services: dict[str, list[ServiceHandle]] = {}

    def node_named(self, fully_qualified_name: str) -> NodeHandle | None:
        """Return the node of that name, or None."""
        for node in self.nodes:
            if node.fully_qualified_name == fully_qualified_name:
                return node
        return None

    def publishers(self, topic: str) -> list[PublisherHandle]:
        """Return the publishers of a topic in creation order."""
        return self._publishers.get(topic, [])

    def subscriptions(self, topic: str) -> list[SubscriptionHandle]:
        """Return the subscriptions of a topic in creation order."""
        return self._subscriptions.get(topic, [])

    def clients(self, service: str) -> list[ClientHandle]:
        """Return the clients of a service in creation order."""
        return self._clients.get(service, [])

    def all_clients(self) -> list[ClientHandle]:
        """Return every client."""
        return [client for clients in self._clients.values() for client in clients]

    def services(self, service: str) -> list[ServiceHandle]:
        """Return the servers of a service in creation order."""
        return self._services.get(service, [])

    # -- joining and leaving -------------------------------------------------------------------

    def add_publisher(self, publisher: PublisherHandle) -> None:
        """Connect a new publisher with the subscriptions that are there."""
        self._check_type(publisher)
        self._publishers.setdefault(publisher.topic, []).append(publisher)
        for subscription in self.subscriptions(publisher.topic):
            self._connect(publisher, subscription)

    def add_subscription(self, subscription: SubscriptionHandle) -> None:
        """Connect a new subscription; it gets what transient-local publishers kept for it."""
        self._check_type(subscription)
        self._subscriptions.setdefault(subscription.topic, []).append(subscription)
        for publisher in self.publishers(subscription.topic):
            self._connect(publisher, subscription)

    def remove_publisher(self, publisher: PublisherHandle) -> None:
        """Disconnect a publisher."""
        self._publishers[publisher.topic].remove(publisher)
        for subscription in publisher.subscriptions:
            subscription.publishers.remove(publisher)
            subscription.events.matched(-1)
        publisher.subscriptions = []
        for link in publisher.links or ():
            link.close()
        if publisher.links is not None:
            publisher.links.clear()

    def remove_subscription(self, subscription: SubscriptionHandle) -> None:
        """Disconnect a subscription."""
        self._subscriptions[subscription.topic].remove(subscription)
        for publisher in subscription.publishers:
            publisher.disconnect(subscription)
            publisher.events.matched(-1)
        subscription.publishers = []

    def add_client(self, client: ClientHandle) -> None:
        """Make a client known."""
        self._clients.setdefault(client.service, []).append(client)

    def remove_client(self, client: ClientHandle) -> None:
        """Forget a client."""
        self._clients[client.service].remove(client)

    def add_service(self, service: ServiceHandle) -> None:
        """Make a server known."""
        self._services.setdefault(service.service, []).append(service)

    def remove_service(self, service: ServiceHandle) -> None:
        """Forget a server."""
        self._services[service.service].remove(service)

    def _connect(self, publisher: PublisherHandle, subscription: SubscriptionHandle) -> None:
        apart = incompatible_policies(publisher.qos, subscription.qos)
        if apart:
            publisher.events.incompatible(apart[0])
            subscription.events.incompatible(apart[0])
            return
        publisher.connect(subscription)
        subscription.publishers.append(publisher)
        publisher.events.matched(+1)
        subscription.events.matched(+1)
        publisher.send_history(subscription)

    def _check_type(self, endpoint: PublisherHandle | SubscriptionHandle) -> None:
        others: list[PublisherHandle | SubscriptionHandle] = [
            *self.publishers(endpoint.topic),
            *self.subscriptions(endpoint.topic),
        ]
        for other in others:
            if other.type_name != endpoint.type_name:
                raise UnsupportedError(
                    f"topic {endpoint.topic} has two types: {other.describe()} is "
                    f"{other.type_name}, {endpoint.describe()} is {endpoint.type_name}. They "
                    "would never hear each other; rename or remap one of them"
                )

    # -- queries ---------------------------------------------------------------------------------

    def interfaces_of(self, node: NodeHandle) -> Iterator[Any]:
        """Yield the classes of the messages, services and actions that a node uses."""
        yield from (end.msg_type for end in self.publishers_of(node))
        yield from (end.msg_type for end in self.subscriptions_of(node))
        yield from (end.srv_type for end in self.services_of(node))
        yield from (end.srv_type for end in self.clients_of(node))
        yield from (action.action_type for action in node.actions)

    def endpoints_of(self, node: NodeHandle) -> list[EntityHandle]:
        """Return a node's publishers, subscriptions, services and clients."""
        return [
            *self.publishers_of(node),
            *self.subscriptions_of(node),
            *self.services_of(node),
            *self.clients_of(node),
        ]

    def publishers_of(self, node: NodeHandle) -> list[PublisherHandle]:
        """Return the publishers of a node, topic by topic."""
        return _of(node, self._publishers)

    def subscriptions_of(self, node: NodeHandle) -> list[SubscriptionHandle]:
        """Return the subscriptions of a node, topic by topic."""
        return _of(node, self._subscriptions)

    def services_of(self, node: NodeHandle) -> list[ServiceHandle]:
        """Return the servers of a node, service by service."""
        return _of(node, self._services)

    def clients_of(self, node: NodeHandle) -> list[ClientHandle]:
        """Return the clients of a node, service by service."""
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


def _of(node: NodeHandle, ends: dict[str, list[EndT]]) -> list[EndT]:
    return [end for named in ends.values() for end in named if end.node is node]


def action_names_and_types(
    topics: list[tuple[str, list[str]]],
) -> list[tuple[str, list[str]]]:
    """Return the actions among topics: each has one for feedback, by which rcl finds it, too."""
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
