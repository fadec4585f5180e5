"""Endpoints and timers of processes: what arrives is handed over when the process waits for it."""

from __future__ import annotations

from collections.abc import Callable, Container
from typing import Any, Protocol

from rsltrace.adapters.processes.wire import WakeReason, changed_item, gid_of, packed_item
from rsltrace.errors import RunError
from rsltrace.simulation.middleware.entity import Receiver
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.services import (
    CLIENT,
    SERVICE,
    Client,
    Exchange,
    RequestId,
    Service,
)
from rsltrace.simulation.middleware.subscription import SUBSCRIPTION, Delivery, Subscription
from rsltrace.simulation.middleware.timer import TIMER, Timer
from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import NO_EVENT, OutputKind

_NO_GID = bytes(16)


class WaitableEntity(Protocol):
    """What a process has made and may wait for. ``number`` is what the process calls it."""

    number: int
    destroyed: bool

    def dispatch(self) -> None:
        """Hand over what is ready."""

    def may_run(self) -> bool:
        """Return whether there is something to hand over now."""

    def describe(self) -> str:
        """Name it for people."""


class HostProcess(Protocol):
    """The process that endpoints and timers are in, as they see it."""

    name: str
    dispatcher: Dispatcher
    has_begun: bool

    def wants(self, thing: WaitableEntity) -> bool:
        """Return whether one of its threads waits for a thing now."""

    def hold(self, thing: WaitableEntity) -> None:
        """Keep what is ready until the process waits for it."""

    def go_on_with(self, number: int, ready: WakeReason, item: bytes) -> None:
        """Let the thread that waits for a thing go on, until the process waits again."""

    def begin_with(self, number: int, ready: WakeReason, item: bytes) -> None:
        """Let that thread go on already; ``go_on_with`` follows."""

    def was_no_callback(self) -> None:
        """Say that the event under way is no callback's."""

    def own(self, timer: ProcessTimer) -> None:
        """Give a timer whose callback has run to a node."""


class RosoutPublisher(Publisher):
    """A publisher of /rosout: what it sends are log records."""

    output_kind = int(OutputKind.LOG)

    def send(self, data: bytes, content_hash: int | None = None) -> None:
        super().send(data, hash64(log_content(data)))


class QueueEndpoint(Receiver):
    """An endpoint with a queue of arrivals. ``number`` is what the process calls it."""

    process: HostProcess
    number: int
    event_kind: int
    _begun: tuple[Any, bytes] | None = None
    """The arrival with which its process has begun, and how that was packed."""

    def __init__(self, process: HostProcess, number: int, *arguments: Any) -> None:
        """``arguments`` are those of the kind of endpoint."""
        super().__init__(*arguments)
        self.process = process
        self.number = number

    def dispatch(self) -> None:
        if not self.may_run():
            return
        if not self.process.wants(self):
            self.process.hold(self)
            return
        arrival = self.queue.popleft()
        if self._begun is None:
            item = self.packed(arrival)
        else:
            (begun, item), self._begun = self._begun, None
            if begun is not arrival:
                raise RunError(
                    f"{self.describe()} had begun with a message that was then pushed out of its "
                    "queue, by a publisher that was made in this instant: run the job without "
                    "`parallel`"
                )
        self.dispatcher.execute(
            self,
            self.entity_id,
            self.node,
            self.event_kind,
            self.process.go_on_with,
            (self.number, WakeReason.ENTITY, item),
            *arrival[self.origin],
        )

    def begin(self) -> None:
        """Let the process begin with the oldest arrival before its turn to be dispatched."""
        arrival = self.queue[0]
        item = self.packed(arrival)
        self._begun = arrival, item
        self.process.begin_with(self.number, WakeReason.ENTITY, item)

    def may_lose_arrivals(self, senders: Container[object]) -> bool:
        """Return whether what some processes send may push an arrival out of the queue."""
        return False

    def take(self) -> bytes | None:
        """Return the oldest arrival for who asks without having waited, None if there is none."""
        return self.packed(self.queue.popleft()) if self.queue else None

    def packed(self, arrival: Any) -> bytes:
        """Return an arrival as the process reads it."""
        raise NotImplementedError

    def arriving_type(self) -> str:
        raise NotImplementedError

    def changed(
        self, args: tuple[int, WakeReason, bytes], change: Callable[[bytes], bytes]
    ) -> tuple[tuple[int, WakeReason, bytes], bytes]:
        """Return the arguments of ``go_on_with`` with another message, and that message."""
        number, ready, item = args
        item, data = changed_item(item, change)
        return (number, ready, item), data


def with_source(source: str) -> dict[str, object]:
    """Return the detail of an entity for the line of its callback, if that is known."""
    return {"source": source} if source else {}


class _CallbackEndpoint(QueueEndpoint):
    """An endpoint whose callback has a name, if the process says it."""

    callback_name = ""
    source = ""

    def named_callback(self, name: str, source: str) -> None:
        """Take note of what its callback is called, and of its line."""
        self.callback_name, self.source = name, source

    def trace_detail(self) -> dict[str, object]:
        return {
            **super().trace_detail(),
            "callback": self.callback_name,
            **with_source(self.source),
        }


class ProcessSubscription(_CallbackEndpoint, Subscription):
    """A subscription of a process."""

    event_kind = SUBSCRIPTION
    _received = 0

    def arriving_type(self) -> str:
        return self.type_name

    def may_lose_arrivals(self, senders: Container[object]) -> bool:
        return self.keep is not None and any(one.node.process in senders for one in self.publishers)

    def packed(self, delivery: Delivery) -> bytes:
        self._received += 1
        received_ns = delivery[0] or delivery[8]
        return packed_item(
            delivery[8], received_ns, delivery[9], self._received, _NO_GID, delivery[4]
        )


class ProcessService(_CallbackEndpoint, Service):
    """A server of a process."""

    event_kind = SERVICE

    def __init__(self, process: HostProcess, number: int, *arguments: Any) -> None:
        super().__init__(process, number, *arguments)
        self._asked: dict[tuple[bytes, int], RequestId] = {}

    def packed(self, exchange: Exchange) -> bytes:
        request_id = exchange[4].request_id
        gid = gid_of(request_id.client.entity_id)
        self._asked[gid, request_id.sequence_number] = request_id
        return _packed_exchange(exchange, gid)

    def arriving_type(self) -> str:
        return f"{self.type_name}_Request"

    def answer(self, gid: bytes, number: int, data: bytes) -> None:
        """Send a response; one to nobody's request is lost, as in DDS."""
        request_id = self._asked.pop((gid, number), None)
        if request_id is not None:
            self.respond(data, request_id)


class ProcessClient(QueueEndpoint, Client):
    """A client of a process."""

    event_kind = CLIENT

    def packed(self, exchange: Exchange) -> bytes:
        return _packed_exchange(exchange, gid_of(self.entity_id))

    def arriving_type(self) -> str:
        return f"{self.type_name}_Response"


def _packed_exchange(exchange: Exchange, gid: bytes) -> bytes:
    info = exchange[4]
    number = info.request_id.sequence_number
    return packed_item(info.source_timestamp, info.received_timestamp, number, 0, gid, exchange[0])


class ProcessTimer(Timer):
    """A timer of a process: rcl's, of which the loop knows when it is due.

    rcl does not say whose it is, and what executors make for themselves (a wait with a time) looks
    like any other. So it is nobody's until its callback has been called.
    """

    begins_active = False

    def __init__(
        self, dispatcher: Dispatcher, process: HostProcess, number: int, period_ns: int
    ) -> None:
        super().__init__(dispatcher, None, period_ns)
        self.process = process
        self.number = number
        self.name = self.source = ""
        self.is_callback = True

    def named_callback(self, name: str, source: str) -> None:
        """Take note of what its callback is called, and of its line."""
        self.name, self.source = name, source

    def trace_detail(self) -> dict[str, object]:
        return {**super().trace_detail(), **with_source(self.source)}

    def due_at(self, deadline_ns: int) -> None:
        """Take note of when it is due, by what rcl says."""
        state, timers = self.state, self.dispatcher.loop.timers
        if deadline_ns != state.deadline_ns or state.canceled or state.ticket is None:
            state.deadline_ns, state.canceled = deadline_ns, False
            timers.add(state)

    def cancel(self) -> None:
        self.state.canceled = True
        self.dispatcher.loop.timers.remove(self.state)

    def may_run(self) -> bool:
        return not self.state.canceled and self.state.deadline_ns <= self.dispatcher.loop.now_ns

    def dispatch(self) -> None:
        loop, state, process = self.dispatcher.loop, self.state, self.process
        if not process.wants(self):
            loop.timers.remove(state)
            process.hold(self)
            return
        digest = self.deadline_hash()
        state.call(loop.now_ns)
        loop.timers.ran(state)
        self.is_callback = True
        self.dispatcher.execute(
            self, self.entity_id, self.node, TIMER, self._run, (), NO_EVENT, 0, digest
        )

    def _run(self) -> None:
        self.process.go_on_with(self.number, WakeReason.TIMER, b"")
        if not self.is_callback:
            self.process.was_no_callback()
        elif self.node is None and not self.destroyed:
            self.process.own(self)

    def trace_name(self) -> str:
        return self.name

    def describe(self) -> str:
        return super().describe() if self.node is not None else f"{self.process.name}: a timer"
