"""One process of a run: what it says becomes outputs, and it goes on when the loop lets it."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from typing import Any, Protocol

from rsltrace.doors.processes import graph_answers
from rsltrace.doors.processes.child import Child, Ended
from rsltrace.doors.processes.endpoints import (
    Endpoint,
    ProcessClient,
    ProcessService,
    ProcessSubscription,
    ProcessTimer,
    RosoutPublisher,
)
from rsltrace.doors.processes.wire import (
    GO,
    GRAPH_ID,
    HEAD,
    NEVER_NS,
    RECORD,
    Fields,
    Ready,
    Say,
    Told,
    WireError,
    gid_of,
    packed_qos,
)
from rsltrace.errors import NodeError
from rsltrace.loop.timer import TimerState
from rsltrace.middleware.domain import Domain
from rsltrace.middleware.entity import DomainEntity
from rsltrace.middleware.events.event import Door
from rsltrace.middleware.interface import MessageType, ServiceType
from rsltrace.middleware.participant import Participant, full_name
from rsltrace.middleware.publisher import Publisher
from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.event import NO_EVENT, EventFlag, EventKind
from rsltrace.model.stamp import format_seconds
from rsltrace.trace.format import TOPIC_ROSOUT

_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)
_GRACE_S = 5.0
"""How long a process may take (in real time) to end when it is told to."""
_WAITER = struct.Struct("<IIqI")
_TIMER = struct.Struct("<IIq")
_DEADLINE = struct.Struct("<Iq")
_REQUEST_ID = struct.Struct("<I16sq")
_HELLO = struct.Struct("<qQ")
_RECORD_SIZE = RECORD.size
_PUBLISH, _WAIT = int(Say.PUBLISH), int(Say.WAIT)
_number = HEAD.unpack_from
_NOT_A_BATCH = (WireError, LookupError, ValueError, TypeError, AttributeError, struct.error)
"""What reading raises if something else than the library has written to the link."""

Question = Callable[[Fields], bytes]


class Surroundings(Door, Protocol):
    """What a process finds in its run."""

    domain: Domain
    message_type: Callable[[str], MessageType]
    service_type: Callable[[str], ServiceType]
    log: Callable[[int, str, str], None]

    def seed_of(self, key: str) -> int:
        """Return the number from which a process draws what others take for entropy."""

    def has_ended(self, process: Process) -> None:
        """Take note that a process has ended, in the event under way."""


class Process:
    """An executable that runs beside rsltrace; in the trace, a main.

    ``things`` are its nodes, endpoints and timers, by the numbers that it has for them.
    """

    def __init__(self, door: Surroundings, name: str, key: str, *, log_failure: bool) -> None:
        self.door = door
        self.dispatcher = door.domain.dispatcher
        self.name = name
        self.key = key
        self.log_failure = log_failure
        self.entity_id = 0
        self.announced = True
        self.begun_ns = 0
        self.child: Child
        self.ended: Ended | None = None
        self.things: dict[int, Any] = {}
        self._nodes: list[Participant] = []
        self._timers_named = 0
        self._wanted: dict[int, int] = {}
        """Which thread waits for a thing."""
        self._waits: tuple[tuple[int, int], ...] = ()
        self._sets: dict[int, tuple[int, ...]] = {}
        self._waking: dict[int, WakingTimer] = {}
        self._held: list[Endpoint | ProcessTimer] = []
        self._running_thread = 0
        self._same_wait = b""
        """What it waited for last, if that has no end."""
        self._waking_soon = False
        self._last: Endpoint | ProcessTimer | None = None
        self._is_stopping = False
        self._graph = GraphChange(self)
        door.domain.graph.changed.append(self._graph.note)
        self._questions: dict[int, Question] = {
            Say.HELLO: self._hello,
            Say.TAKE: self._take,
            Say.GID: lambda fields: gid_of(self.things[fields.number()].entity_id),
            Say.QOS: self._qos,
            Say.MATCHED: self._matched,
            Say.GRAPH: lambda fields: graph_answers.answer(door.domain.graph, fields),
        }
        self._records: dict[int, Callable[[Fields], None]] = {
            Say.NODE: self._node,
            Say.PUBLISHER: self._publisher,
            Say.SUBSCRIPTION: self._subscription,
            Say.SERVICE: self._service,
            Say.CLIENT: self._client,
            Say.TIMER: self._timer,
            Say.GONE: self._gone,
            Say.REQUEST: self._request,
            Say.RESPONSE: self._response,
            Say.LOG: self._log,
            Say.REPORT: self._report,
            Say.TIMER_PASSED: self._timer_passed,
            Say.TIMER_NEXT: self._timer_next,
            Say.WAIT_SET: self._wait_set,
            Say.ALIVE: self._alive,
        }

    # -- as the trace has it ---------------------------------------------------------------------

    def describe(self) -> str:
        """Name the process for people."""
        return self.name

    def settle(self) -> bool:
        """Return whether its owner is known: it has none."""
        return True

    def entity(self) -> Entity:
        """Return the process as the trace describes it."""
        return Entity(self.entity_id, 0, EntityKind.MAIN, self.name, "", self.begun_ns, {})

    @property
    def has_failed(self) -> bool:
        """Whether it has ended as it should not, while the run went on."""
        return self.ended is not None and self.ended.failed and not self._is_stopping

    # -- going on --------------------------------------------------------------------------------

    def begin(self, child: Callable[[], Child]) -> None:
        """Start it, and let it run up to its first wait, within the event under way."""
        self.child = child()
        self._converse()

    @property
    def waits_for_graph(self) -> bool:
        """Whether one of its threads waits for a change of the graph now."""
        return GRAPH_ID in self._wanted

    def wants(self, thing: Endpoint | ProcessTimer) -> bool:
        """Return whether one of its threads waits for a thing now."""
        return thing.number in self._wanted

    def hold(self, thing: Endpoint | ProcessTimer) -> None:
        """Keep what is ready until the process waits for it."""
        self._held.append(thing)

    def go_on_with(self, number: int, ready: Ready, item: bytes) -> None:
        """Let the thread that waits for a thing go on, until the process waits again."""
        thing = self.things[number]
        self._last = thing
        self._go(self._wanted[number], ready, number, item)

    def wake(self, thread: int) -> None:
        """Let a thread go on whose time has come."""
        self._go(thread, Ready.TIMEOUT, 0, b"")

    def see_graph(self) -> None:
        """Let those threads go on that wait for a change of the graph."""
        self._go(self._wanted[GRAPH_ID], Ready.GRAPH, GRAPH_ID, b"")

    def was_no_callback(self) -> None:
        """Say that the event under way is no callback's: an executor's own timer was due."""
        event = self.dispatcher.event
        event.kind, event.entity, event.node, event.input_hash = _RESUME, self.entity_id, None, 0

    def _go(self, thread: int, ready: Ready, number: int, item: bytes) -> None:
        waking = self._waking.get(thread)
        if waking is not None:
            waking.off()
        self._running_thread = thread
        now_ns = self.dispatcher.loop.now_ns
        head = GO.pack(GO.size - 8 + len(item), Told.GO, now_ns, thread, ready, number)
        self.child.send(head + item)
        self._converse()

    def _converse(self) -> None:
        """Take what the process says until it waits again, or has ended."""
        while True:
            batch = self.child.receive()
            if batch is None:
                self._has_ended()
                return
            try:
                answer = self._take_batch(batch)
            except _NOT_A_BATCH:
                self.child.kill()
                self._has_ended("wrote something of its own to")
                return
            if answer is None:
                return
            if answer:
                self.child.send(answer)

    def _take_batch(self, batch: memoryview) -> bytes | None:
        """Do what a batch says; return the answer to the question at its end, None if it waits."""
        place, end = 0, len(batch)
        while place < end:
            kind, size = RECORD.unpack_from(batch, place)
            place += _RECORD_SIZE
            body = batch[place : place + size]
            place += size
            if kind == _PUBLISH:
                self.things[_number(body)[0]].send(body[4:].tobytes())
                continue
            if kind == _WAIT:
                if body != self._same_wait or self._held:
                    self._wait(Fields(body))
                    self._same_wait = b"" if self._waking_soon else body.tobytes()
                return None
            fields = Fields(body)
            question = self._questions.get(kind)
            if question is not None:
                answer = question(fields)
                return RECORD.pack(len(answer), Told.ANSWER) + answer
            self._records[kind](fields)
        return b""

    # -- waiting ---------------------------------------------------------------------------------

    def _wait_set(self, fields: Fields) -> None:
        thread, number, count = fields.number(), fields.number(), fields.number()
        ids = fields.unpack(struct.Struct(f"<{count}I"))
        self._sets = {n: s for n, s in self._sets.items() if s[:1] != (thread,)}
        self._sets[number] = (thread, *ids)

    def _wait(self, fields: Fields) -> None:
        """Take note of what its threads wait for."""
        event = self.dispatcher.event
        waits = []
        self._waking_soon = False
        timed = set()
        for _ in range(fields.number()):
            thread, number, deadline_ns, size = fields.unpack(_WAITER)
            fields.unpack(struct.Struct(f"{size}s"))
            waits.append((thread, number))
            if number == 0 and thread == self._running_thread:
                event.flags |= _SUSPENDED
            if number == 0 or deadline_ns != NEVER_NS:
                self._waking_soon = True
            if deadline_ns != NEVER_NS:
                self._wake_at(thread, deadline_ns, asleep=number == 0)
                timed.add(thread)
        for thread in self._waking.keys() - timed:  # another thread has woken it
            self._waking[thread].off()
        if self._waits != tuple(waits):
            self._waits = tuple(waits)
            self._wanted = {
                thing: thread
                for thread, number in waits
                if number
                for thing in self._sets[number][1:]
            }
        if self._held:
            self._release()
        self._graph.look()

    def _wake_at(self, thread: int, deadline_ns: int, *, asleep: bool) -> None:
        waking = self._waking.get(thread)
        if waking is None:
            waking = self._waking[thread] = WakingTimer(self, thread)
        waking.at(deadline_ns, asleep=asleep)

    def _release(self) -> None:
        """Let go of what was held back and is waited for now."""
        loop = self.dispatcher.loop
        held, self._held = self._held, []
        for thing in held:
            if thing.destroyed:
                continue
            if thing.number not in self._wanted:
                self._held.append(thing)
            elif isinstance(thing, ProcessTimer):
                if not thing.state.canceled:
                    loop.timers.add(thing.state)
            else:
                loop.ready.append(thing)

    # -- its end ---------------------------------------------------------------------------------

    def _has_ended(self, broken_link: str = "") -> None:
        """Take it out of the graph, within the event under way; ``broken_link`` as in ``Ended``.

        :raises NodeError: if it has failed, and the job does not say to go on.
        """
        ended = self.child.reap()
        self.ended = Ended(ended.status, broken_link or ended.broken_link)
        self.vanish()
        self.door.has_ended(self)
        if not self.ended.failed or self._is_stopping:
            return
        at = format_seconds(self.dispatcher.loop.now_ns)
        last = "its start" if self._last is None else self._last.describe()
        happened = f"process {self.name} {self.ended.said} at {at} s"
        text = f"{happened}; the last that it ran was {last}"
        if self.log_failure:
            self.door.log(40, self.name, text)
        else:
            now_ns = self.dispatcher.loop.now_ns
            raise NodeError(text, node="", entity=self.name, stamp_ns=now_ns, traceback_text="")

    def stop(self) -> None:
        """Tell it as whoever starts nodes does that the run is over (Ctrl-C), and end it once it
        waits again."""
        self._is_stopping = True
        self.child.give_up_after(_GRACE_S)
        self.child.send(RECORD.pack(0, Told.STOP))
        self._converse()
        if self.ended is None:
            self.child.dismiss()
            self.vanish()

    def vanish(self) -> None:
        """Destroy all that it has made."""
        for waking in self._waking.values():
            waking.off()
        for thing in reversed(list(self.things.values())):
            thing.destroy()
        self.things.clear()
        self._wanted.clear()

    # -- what it asks ----------------------------------------------------------------------------

    def _hello(self, fields: Fields) -> bytes:
        return _HELLO.pack(self.dispatcher.loop.now_ns, self.door.seed_of(self.key))

    def _take(self, fields: Fields) -> bytes:
        item = self.things[fields.number()].take()
        return HEAD.pack(0) if item is None else HEAD.pack(1) + item

    def _qos(self, fields: Fields) -> bytes:
        end = self.things[fields.number()]
        return packed_qos(
            end.profile if isinstance(end, ProcessService | ProcessClient) else end.qos
        )

    def _matched(self, fields: Fields) -> bytes:
        end = self.things[fields.number()]
        others = end.subscriptions if isinstance(end, Publisher) else end.publishers
        return HEAD.pack(len(others))

    # -- what it makes ---------------------------------------------------------------------------

    def _node(self, fields: Fields) -> None:
        number, name, namespace = fields.number(), fields.text(), fields.text()
        graph = self.door.domain.graph
        taken = {other.number for other in graph.nodes_named(full_name(namespace, name))}
        node = self.door.domain.join(name, namespace, self.door)
        node.number = next(count for count in itertools.count(1) if count not in taken)
        node.process = self
        self.things[number] = node
        self._nodes.append(node)

    def _publisher(self, fields: Fields) -> None:
        number, node = fields.number(), self.things[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        kind = RosoutPublisher if topic == TOPIC_ROSOUT else Publisher
        domain = self.door.domain
        self.things[number] = end = kind(
            domain.transport, node, topic, self.door.message_type(type_name), qos
        )
        domain.graph.add_publisher(end)

    def _subscription(self, fields: Fields) -> None:
        number, node = fields.number(), self.things[fields.number()]
        topic, type_name, qos = fields.text(), fields.text(), fields.qos()
        graph = self.door.domain.graph
        settled = graph.settled_request(topic, qos)
        type = self.door.message_type(type_name)
        end = ProcessSubscription(self, number, node, topic, type, settled)
        self.things[number] = end
        graph.add_subscription(end)

    def _service(self, fields: Fields) -> None:
        domain = self.door.domain
        number, node = fields.number(), self.things[fields.number()]
        name, type, qos = fields.text(), self.door.service_type(fields.text()), fields.qos()
        end = ProcessService(self, number, domain.transport, node, name, type, qos)
        self.things[number] = end
        domain.graph.add_service(end)

    def _client(self, fields: Fields) -> None:
        domain = self.door.domain
        number, node = fields.number(), self.things[fields.number()]
        name, type, qos = fields.text(), self.door.service_type(fields.text()), fields.qos()
        end = ProcessClient(self, number, domain.transport, node, name, type, qos)
        self.things[number] = end
        domain.graph.add_client(end)

    def _timer(self, fields: Fields) -> None:
        number, may_be_an_executors, period_ns = fields.unpack(_TIMER)
        timer = ProcessTimer(self.dispatcher, self, number, period_ns)
        timer.cancel()  # until the process says when it is due
        self.things[number] = timer
        if not may_be_an_executors:
            self.own(timer)

    def own(self, timer: ProcessTimer) -> None:
        """Give a timer to the node that was made last: no function of rcl says whose it is."""
        if timer.node is not None or not self._nodes:
            return
        self._timers_named += 1
        timer.name = f"timer {self._timers_named}"
        timer.node = self._nodes[-1]
        timer.node.timers.append(timer)
        self.dispatcher.entities.look_again(timer.node)
        event = self.dispatcher.event
        if event.entity == timer.entity_id:
            event.node = timer.node

    def _gone(self, fields: Fields) -> None:
        thing: DomainEntity = self.things.pop(fields.number())
        self._waits, self._same_wait = (), b""
        if isinstance(thing, ProcessTimer) and thing.node is not None:
            thing.node.timers.remove(thing)
        elif isinstance(thing, Participant):
            self._nodes.remove(thing)
        thing.destroy()

    # -- what it does ----------------------------------------------------------------------------

    def _request(self, fields: Fields) -> None:
        self.things[fields.number()].request(fields.rest())

    def _response(self, fields: Fields) -> None:
        number, gid, sequence = fields.unpack(_REQUEST_ID)
        self.things[number].answer(gid, sequence, fields.rest())

    def _log(self, fields: Fields) -> None:
        self.door.log(fields.number(), fields.text(), fields.text())

    def _report(self, fields: Fields) -> None:
        self.door.domain.outcome.notes.append(f"process {self.name}: {fields.text()}")

    def _timer_passed(self, fields: Fields) -> None:
        self.things[fields.number()].is_callback = False

    def _timer_next(self, fields: Fields) -> None:
        number, deadline_ns = fields.unpack(_DEADLINE)
        timer = self.things[number]
        if deadline_ns == NEVER_NS:
            timer.cancel()
        else:
            timer.due_at(deadline_ns)

    def _alive(self, fields: Fields) -> None:
        self.things[fields.number()].assert_liveliness()


class WakingTimer:
    """Wakes a thread of a process when the time is over for which it sleeps or waits."""

    def __init__(self, process: Process, thread: int) -> None:
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

    def describe(self) -> str:
        """Name it for people."""
        return f"{self._process.name}: the end of a wait"


class GraphChange:
    """Wakes a process that waits for the graph to change; what changes before it waits, counts."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self._is_due = False
        self._is_queued = False

    def note(self) -> None:
        """The graph has changed."""
        self._is_due = True
        self.look()

    def look(self) -> None:
        """Wake the process if it waits for a change that there was."""
        if self._is_due and not self._is_queued and self._process.waits_for_graph:
            self._is_queued = True
            self._process.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Let the process go on, as an event, if it still waits."""
        self._is_queued = False
        process = self._process
        if not process.waits_for_graph:
            return
        self._is_due = False
        process.dispatcher.execute(
            self, process.entity_id, None, _RESUME, process.see_graph, (), NO_EVENT, 0, 0
        )

    def describe(self) -> str:
        """Name it for people."""
        return f"{self._process.name}: a change of the graph"
