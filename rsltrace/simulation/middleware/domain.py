"""The domain of a run: what its participants share.

A participant needs no client library: it receives and sends bytes. An adapter with one derives its
endpoints from these classes and adds them to the graph.
"""

from __future__ import annotations

from collections.abc import Callable

from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import ExceptionHandler
from rsltrace.simulation.middleware.events.failure import RunEndingExceptionHandler
from rsltrace.simulation.middleware.graph import Graph
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.simulation.middleware.participant import Participant
from rsltrace.simulation.middleware.publisher import (
    MessageFilter,
    Publisher,
    TopicObservers,
    Transport,
    Watcher,
)
from rsltrace.simulation.middleware.qos.policies import DEFAULT_QOS, Qos
from rsltrace.simulation.middleware.services import Client, Service
from rsltrace.simulation.middleware.subscription import Subscription
from rsltrace.simulation.middleware.timer import Timer


class Domain:
    """The participants (``graph``), how messages reach them (``transport``), and how their
    callbacks are run and recorded (``dispatcher``)."""

    def __init__(self, loop: EventLoop) -> None:
        self.loop = loop
        self.dispatcher = Dispatcher(loop)
        self.event = self.dispatcher.event
        self.entities = self.dispatcher.entities
        self.outcome = self.dispatcher.outcome
        self.transport = Transport(self.dispatcher)
        self.graph = Graph()
        self._exception_handler = RunEndingExceptionHandler(self.dispatcher)
        self.dispatcher.exception_handler = self._exception_handler

    def watch(self, topic: str, watcher: Watcher) -> None:
        """Call ``watcher(publisher, canonical bytes)`` for every message on a topic."""
        self._observers(topic).watchers.append(watcher)

    def filter(self, topic: str, function: MessageFilter | None) -> None:
        """Let a function filter what is published on a topic; None removes it."""
        self._observers(topic).filter = function

    def _observers(self, topic: str) -> TopicObservers:
        found = self.transport.observers.get(topic)
        if found is None:
            found = self.transport.observers[topic] = TopicObservers()
            for publisher in self.graph.publishers(topic):
                publisher.observers = found
        return found

    def join(
        self, name: str, namespace: str = "/", exception_handler: ExceptionHandler | None = None
    ) -> Participant:
        """Make a participant. An exception ends the run unless ``exception_handler`` handles it."""
        participant = Participant(
            self.dispatcher, name, namespace, exception_handler or self._exception_handler
        )
        self.graph.add_node(participant)
        return participant

    def leave(self, participant: Participant) -> None:
        """Destroy a participant and all that it made."""
        for entity in [*participant.timers, *self.graph.endpoints_of(participant), participant]:
            entity.destroy()

    def publisher(
        self, node: Participant, topic: str, type: MessageType, qos: Qos = DEFAULT_QOS
    ) -> Publisher:
        """Make a publisher of a fully qualified topic."""
        publisher = Publisher(self.transport, node, topic, type, qos)
        self.graph.add_publisher(publisher)
        return publisher

    def subscription(
        self,
        node: Participant,
        topic: str,
        type: MessageType,
        callback: Callable[[bytes], object],
        qos: Qos = DEFAULT_QOS,
    ) -> Subscription:
        """Make a subscription; ``callback`` gets canonical CDR."""
        settled = self.graph.settled_request(topic, qos)
        subscription = Subscription(self.dispatcher, node, topic, type, settled, callback)
        self.graph.add_subscription(subscription)
        return subscription

    def service(
        self,
        node: Participant,
        service: str,
        type: ServiceType,
        callback: Callable[[bytes], bytes],
        qos: Qos = DEFAULT_QOS,
    ) -> Service:
        """Make a server; ``callback`` gets a request and returns the response."""
        server = Service(self.transport, node, service, type, qos, callback)
        self.graph.add_service(server)
        return server

    def client(
        self, node: Participant, service: str, type: ServiceType, qos: Qos = DEFAULT_QOS
    ) -> Client:
        client = Client(self.transport, node, service, type, qos)
        self.graph.add_client(client)
        return client

    def timer(self, node: Participant, period_ns: int, callback: Callable[[], object]) -> Timer:
        timer = Timer(self.dispatcher, node, period_ns, callback)
        node.timers.append(timer)
        return timer
