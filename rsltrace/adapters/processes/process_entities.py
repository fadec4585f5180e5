"""What a process has made: its nodes, endpoints and timers, by the numbers that it has for them."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from dataclasses import astuple
from functools import partial
from typing import Any, Protocol

from rsltrace.adapters.processes.endpoints import (
    HostProcess,
    ProcessClient,
    ProcessService,
    ProcessSubscription,
    ProcessTimer,
    RosoutPublisher,
)
from rsltrace.adapters.processes.source_lines import callback_place, stack_text
from rsltrace.adapters.processes.wire import RecordKind, RecordReader, WakeReason, packed_item
from rsltrace.simulation.loop.timer_queue import TimerState
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.entity import DomainEntity, Runnable
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.event import ExceptionHandler
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.simulation.middleware.participant import Participant, QosEvent, full_name
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.event import NO_EVENT, CodeLine, EventKind
from rsltrace.trace.model.operation import PARAMETER_EVENTS

# What lets a process go on besides messages and timers: the end of a wait, and the graph.

_RESUME = int(EventKind.RESUME)
_OF_NODES = (TOPIC_ROSOUT, PARAMETER_EVENTS)


class GraphWaiter(Protocol):
    """A process, as what wakes it sees it."""

    name: str
    entity_id: int
    dispatcher: Dispatcher

    @property
    def waits_for_graph(self) -> bool:
        """Whether one of its threads waits for a change of the graph now."""

    def wake(self, thread: int) -> None:
        """Let a thread go on whose time has come."""

    def see_graph(self) -> None:
        """Let those threads go on that wait for a change of the graph."""


class WakingTimer:
    """Wakes a thread of a process when the time is over for which it sleeps or waits."""

    def __init__(self, process: GraphWaiter, thread: int) -> None:
        self._process = process
        self._thread = thread
        dispatcher = process.dispatcher
        self._state = TimerState(
            0, dispatcher.loop.now_ns, order=dispatcher.entities.new_id(), owner=self
        )
        self._asleep: tuple[int, Any, int] | None = None
        self._at_ns: int | None = None

    def at(self, deadline_ns: int, *, asleep: bool) -> None:
        """Wake it at a time; ``asleep`` says that the event under way goes on then."""
        if deadline_ns == self._at_ns:  # it sleeps on, whoever ran in between
            return
        self._at_ns = deadline_ns
        dispatcher = self._process.dispatcher
        event = dispatcher.event
        self._asleep = (event.entity, event.node, dispatcher.loop.events) if asleep else None
        self._state.deadline_ns = deadline_ns
        dispatcher.loop.timers.add(self._state)

    def off(self) -> None:
        """Forget it: the thread goes on."""
        self._at_ns = None
        self._process.dispatcher.loop.timers.remove(self._state)

    def dispatch(self) -> None:
        """Let the thread go on, as an event."""
        self.off()
        entity, node, cause = self._asleep or (self._process.entity_id, None, NO_EVENT)
        self._process.dispatcher.execute(
            self, entity, node, _RESUME, self._process.wake, (self._thread,), cause, 0, 0
        )

    def runnable(self) -> Runnable:
        """Describe it to a policy: a callback under way goes on, and has its worker."""
        entity = self._process.entity_id if self._asleep is None else self._asleep[0]
        return Runnable("resume", "", entity)

    def describe(self) -> str:
        """Name it for people."""
        return f"{self._process.name}: the end of a wait"


class GraphChange:
    """Wakes a process that waits for the graph to change; what changes before it waits, counts."""

    def __init__(self, process: GraphWaiter) -> None:
        self.process = process
        self._is_due = False
        self._is_queued = False

    def note(self) -> None:
        """The graph has changed."""
        self._is_due = True
        self.look()

    def look(self) -> None:
        """Wake the process if it waits for a change that there was."""
        if self._is_due and not self._is_queued and self.process.waits_for_graph:
            self._is_queued = True
            self.process.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Let the process go on, as an event, if it still waits."""
        self._is_queued = False
        process = self.process
        if not process.waits_for_graph:
            return
        self._is_due = False
        process.dispatcher.execute(
            self, process.entity_id, None, _RESUME, process.see_graph, (), NO_EVENT, 0, 0
        )

    def runnable(self) -> Runnable:
        """Describe it to a policy."""
        return Runnable("resume", "", self.process.entity_id)

    def describe(self) -> str:
        """Name it for people."""
        return f"{self.process.name}: a change of the graph"


# QoS events of processes: news of an endpoint's status, handed over when it is waited for.

_QOS_EVENT = int(EventKind.QOS_EVENT)
_NO_GID = bytes(16)


class ProcessQosEvent(QosEvent):
    """A status that a process wants to hear of. ``number`` is what the process calls it."""

    def __init__(
        self, process: HostProcess, number: int, end: Publisher | ProcessSubscription, status: str
    ) -> None:
        super().__init__(process.dispatcher, end.node)
        self.dispatcher.entities.pending.remove(self)  # it may fire at once, and is then reported
        self.process = process
        self.number = number
        self.listen(end, status)
        self.trigger()

    def dispatch(self) -> None:
        """Hand the status over, if it has not been taken and the process waits for it."""
        if self.destroyed:
            return
        if not self.has_news():
            self.is_queued = False
        elif not self.process.wants(self):
            self.process.hold(self)
        else:
            self.is_queued = False
            self.dispatcher.execute(
                self,
                self.entity_id,
                self.node,
                _QOS_EVENT,
                self.process.go_on_with,
                (self.number, WakeReason.ENTITY, self.take()),
                *self.cause,
                0,
            )

    def may_run(self) -> bool:
        """Return whether there is a status to hand over."""
        return self.has_news()

    def take(self) -> bytes:
        """Return the status, packed."""
        counts = astuple(self.take_event())
        return packed_item(0, 0, 0, 0, _NO_GID, struct.pack(f"<{len(counts)}q", *counts))

    def _destroy(self) -> None:
        super()._destroy()
        listeners = self.endpoint.events.listeners
        if listeners.get(self.status) is self:
            del listeners[self.status]


_TIMER = struct.Struct("<IIq")


class EntityFactory(ExceptionHandler, Protocol):
    """Where a process finds its peers, and types by their names."""

    domain: Domain
    message_type: Callable[[str], MessageType]
    service_type: Callable[[str], ServiceType]


class ProcessEntities(dict[int, Any]):
    """What a process has made and not given up; ``records`` are those by which it says so."""

    def __init__(self, adapter: EntityFactory, process: HostProcess) -> None:
        super().__init__()
        self._adapter = adapter
        self._process = process
        self._nodes: list[Participant] = []
        self._timers_named = 0
        self._made_in = -1
        self._sent_from: set[tuple[int, int, str]] = set()
        self.records: dict[int, Callable[[RecordReader], None]] = {
            RecordKind.NODE: self._node,
            RecordKind.PUBLISHER: self._publisher,
            RecordKind.SUBSCRIPTION: self._subscription,
            RecordKind.SERVICE: partial(
                self._exchange, ProcessService, adapter.domain.graph.add_service
            ),
            RecordKind.CLIENT: partial(
                self._exchange, ProcessClient, adapter.domain.graph.add_client
            ),
            RecordKind.TIMER: self._timer,
            RecordKind.QOS_EVENT: self._qos_event,
            RecordKind.TIMER_OF: self._timer_of,
            RecordKind.CALLBACK: self._callback,
            RecordKind.SENDER: self._sender,
        }

    def _node(self, fields: RecordReader) -> None:
        number, name, namespace = fields.number(), fields.text(), fields.text()
        domain = self._adapter.domain
        taken = {other.number for other in domain.graph.nodes_named(full_name(namespace, name))}
        node = domain.join(name, namespace, self._adapter)
        node.number = next(count for count in itertools.count(1) if count not in taken)
        node.process = self._process
        self[number] = node
        self._nodes.append(node)
        self._made_in = domain.dispatcher.loop.events

    def _publisher(self, fields: RecordReader) -> None:
        number, node = fields.number(), self[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        kind = RosoutPublisher if topic == TOPIC_ROSOUT else Publisher
        domain = self._adapter.domain
        self[number] = end = kind(
            domain.transport, node, topic, self._adapter.message_type(type_name), qos
        )
        domain.graph.add_publisher(end)

    def _subscription(self, fields: RecordReader) -> None:
        number, node = fields.number(), self[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        graph = self._adapter.domain.graph
        settled = graph.settled_request(topic, qos)
        type = self._adapter.message_type(type_name)
        end = ProcessSubscription(
            self._process, number, self._process.dispatcher, node, topic, type, settled
        )
        self[number] = end
        graph.add_subscription(end)

    def _exchange(self, kind: Any, add: Callable[[Any], None], fields: RecordReader) -> None:
        number, node = fields.number(), self[fields.number()]
        name, type, qos = fields.text(), self._adapter.service_type(fields.text()), fields.qos()
        transport = self._adapter.domain.transport
        self[number] = end = kind(self._process, number, transport, node, name, type, qos)
        add(end)

    def _timer(self, fields: RecordReader) -> None:
        number, may_be_an_executors, period_ns = fields.unpack(_TIMER)
        timer = ProcessTimer(self._process.dispatcher, self._process, number, period_ns)
        timer.cancel()  # until the process says when it is due
        self[number] = timer
        if not may_be_an_executors:
            self.own(timer)

    def _qos_event(self, fields: RecordReader) -> None:
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

    def _timer_of(self, fields: RecordReader) -> None:
        """Take note of whose a timer is, which rclcpp says."""
        timer, node = self[fields.number()], self[fields.number()]
        if timer.node is not node:
            if timer.node is not None:
                timer.node.timers.remove(timer)
            self._give(timer, node)

    def _callback(self, fields: RecordReader) -> None:
        """Take note of the name of a callback, which rclcpp says."""
        end, name = self[fields.number()], fields.text()
        end.named_callback(name, callback_place(name, list(fields.frames())))

    def _sender(self, fields: RecordReader) -> None:
        """Record the line of code that is about to send by an endpoint, once for each callback."""
        end, dispatcher = self[fields.number()], self._process.dispatcher
        if end.trace_name() in _OF_NODES or dispatcher.recorder is None:
            return  # rcl and rclcpp send there
        stack = stack_text(fields.rest())
        place, _, function = stack.partition("\n")[0].partition(" in ")
        recorder, key = dispatcher.recorder, (end.entity_id, dispatcher.event.entity, place)
        if key in self._sent_from:
            return
        if function or not stack:  # with debug information, or no more looked up
            self._sent_from.add(key)
            line = CodeLine(recorder.index, end.entity_id, recorder.outputs, place, function)
            recorder.code_line(line, dispatcher.loop.now_ns)

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
