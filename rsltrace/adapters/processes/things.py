"""What a process has made: its nodes, endpoints and timers, by the numbers that it has for them."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from typing import Any, Protocol

from rsltrace.adapters.processes.endpoints import (
    Host,
    ProcessClient,
    ProcessService,
    ProcessSubscription,
    ProcessTimer,
    RosoutPublisher,
)
from rsltrace.adapters.processes.qos_events import ProcessQosEvent
from rsltrace.adapters.processes.wire import Fields, Say
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.entity import DomainEntity
from rsltrace.simulation.middleware.events.event import Door
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.simulation.middleware.participant import Participant, full_name
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.trace.format import TOPIC_ROSOUT

_TIMER = struct.Struct("<IIq")


class Interfaces(Door, Protocol):
    """Where a process finds its peers, and types by their names."""

    domain: Domain
    message_type: Callable[[str], MessageType]
    service_type: Callable[[str], ServiceType]


class Things(dict[int, Any]):
    """What a process has made and not given up; ``records`` are those by which it says so."""

    def __init__(self, door: Interfaces, process: Host) -> None:
        super().__init__()
        self._door = door
        self._process = process
        self._nodes: list[Participant] = []
        self._timers_named = 0
        self._made_in = -1
        self.records: dict[int, Callable[[Fields], None]] = {
            Say.NODE: self._node,
            Say.PUBLISHER: self._publisher,
            Say.SUBSCRIPTION: self._subscription,
            Say.SERVICE: self._service,
            Say.CLIENT: self._client,
            Say.TIMER: self._timer,
            Say.QOS_EVENT: self._qos_event,
            Say.TIMER_OF: self._timer_of,
            Say.CALLBACK: self._callback,
        }

    def _node(self, fields: Fields) -> None:
        number, name, namespace = fields.number(), fields.text(), fields.text()
        domain = self._door.domain
        taken = {other.number for other in domain.graph.nodes_named(full_name(namespace, name))}
        node = domain.join(name, namespace, self._door)
        node.number = next(count for count in itertools.count(1) if count not in taken)
        node.process = self._process
        self[number] = node
        self._nodes.append(node)
        self._made_in = domain.dispatcher.loop.events

    def _publisher(self, fields: Fields) -> None:
        number, node = fields.number(), self[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        kind = RosoutPublisher if topic == TOPIC_ROSOUT else Publisher
        domain = self._door.domain
        self[number] = end = kind(
            domain.transport, node, topic, self._door.message_type(type_name), qos
        )
        domain.graph.add_publisher(end)

    def _subscription(self, fields: Fields) -> None:
        number, node = fields.number(), self[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        graph = self._door.domain.graph
        settled = graph.settled_request(topic, qos)
        type = self._door.message_type(type_name)
        end = ProcessSubscription(self._process, number, node, topic, type, settled)
        self[number] = end
        graph.add_subscription(end)

    def _service(self, fields: Fields) -> None:
        domain = self._door.domain
        number, node = fields.number(), self[fields.number()]
        name, type, qos = fields.text(), self._door.service_type(fields.text()), fields.qos()
        end = ProcessService(self._process, number, domain.transport, node, name, type, qos)
        self[number] = end
        domain.graph.add_service(end)

    def _client(self, fields: Fields) -> None:
        domain = self._door.domain
        number, node = fields.number(), self[fields.number()]
        name, type, qos = fields.text(), self._door.service_type(fields.text()), fields.qos()
        end = ProcessClient(self._process, number, domain.transport, node, name, type, qos)
        self[number] = end
        domain.graph.add_client(end)

    def _timer(self, fields: Fields) -> None:
        number, may_be_an_executors, period_ns = fields.unpack(_TIMER)
        timer = ProcessTimer(self._process.dispatcher, self._process, number, period_ns)
        timer.cancel()  # until the process says when it is due
        self[number] = timer
        if not may_be_an_executors:
            self.own(timer)

    def _qos_event(self, fields: Fields) -> None:
        number, end = fields.number(), self[fields.number()]
        self[number] = ProcessQosEvent(self._process, number, end, fields.text())

    def own(self, timer: ProcessTimer) -> None:
        """Give a timer to the node that was made last: no function of rcl says whose it is."""
        if timer.node is not None or not self._nodes:
            return
        self._timers_named += 1
        timer.name = f"timer {self._timers_named}"
        self._give(timer, self._nodes[-1])

    def _give(self, timer: ProcessTimer, node: Participant) -> None:
        timer.node = node
        node.timers.append(timer)
        dispatcher = self._process.dispatcher
        dispatcher.entities.look_again(node)
        event = dispatcher.event
        if event.entity == timer.entity_id:
            event.node = timer.node

    def _timer_of(self, fields: Fields) -> None:
        """Take note of whose a timer is, which rclcpp says."""
        timer, node = self[fields.number()], self[fields.number()]
        if timer.node is not node:
            if timer.node is not None:
                timer.node.timers.remove(timer)
            self._give(timer, node)

    def _callback(self, fields: Fields) -> None:
        """Take note of the name of a callback, which rclcpp says."""
        self[fields.number()].named_callback(fields.text())

    @property
    def last_node(self) -> Participant | None:
        """The node that was made last, None if there is none."""
        return self._nodes[-1] if self._nodes else None

    @property
    def last_name(self) -> str:
        """Its full name, "" if there is none."""
        return self._nodes[-1].fully_qualified_name if self._nodes else ""

    @property
    def newest_node(self) -> Participant | None:
        """The node that was made last if that was in the event under way, else None."""
        is_new = self._made_in == self._process.dispatcher.loop.events
        return self.last_node if is_new else None

    def number_of(self, node: Participant | None) -> int:
        """Return what the process calls a node; 0 if it is none of its own."""
        return next((number for number, thing in self.items() if thing is node), 0)

    def give_up(self, number: int) -> None:
        """Destroy one of them."""
        thing: DomainEntity = self.pop(number)
        if isinstance(thing, ProcessTimer) and thing.node is not None:
            thing.node.timers.remove(thing)
        elif isinstance(thing, Participant):
            self._nodes.remove(thing)
        thing.destroy()

    def give_all_up(self) -> None:
        """Destroy all of them, the last that was made first."""
        for thing in reversed(list(self.values())):
            thing.destroy()
        self.clear()
