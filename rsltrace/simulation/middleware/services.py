"""Services and clients. A request or response is recorded when it is sent, as messages are."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.entity import Receiver, callback_name
from rsltrace.simulation.middleware.interface import MessageType, ServiceType
from rsltrace.simulation.middleware.publisher import Transport
from rsltrace.simulation.middleware.qos.policies import Qos
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import PREFIX_REQUEST, PREFIX_RESPONSE
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind

SERVICE = int(EventKind.SERVICE)
CLIENT = int(EventKind.CLIENT)
_REQUEST = int(OutputKind.REQUEST)
_RESPONSE = int(OutputKind.RESPONSE)


@dataclass(eq=False, slots=True)
class RequestId:
    """A request by its client and number (``rmw_request_id_t``)."""

    client: Client
    sequence_number: int


class ServiceInfo:
    """What comes with a request or response (``rmw_service_info_t``); stamps in nanoseconds."""

    __slots__ = ("received_timestamp", "request_id", "source_timestamp")

    def __init__(self, request_id: RequestId, stamp_ns: int) -> None:
        self.request_id = request_id
        self.source_timestamp = stamp_ns
        self.received_timestamp = stamp_ns


# On its way: canonical CDR, event index, output position, content hash, header.
Exchange = tuple[bytes, int, int, int, ServiceInfo]


class ServiceEndpoint(Receiver):
    def __init__(
        self, transport: Transport, node: Any, service: str, type: ServiceType, qos: Qos
    ) -> None:
        super().__init__(transport.dispatcher, node)
        self._transport = transport
        self.service = service
        self.type = type
        self.profile = qos.resolved(publisher=True, peers=[])
        self.keep = None if self.dispatcher.loop.keeps_all else self.profile.keep
        self.queue: deque[Exchange] = deque(maxlen=self.keep)
        self._channel: int | None = None

    @property
    def type_name(self) -> str:
        return self.type.name

    def _emit(self, kind: int, prefix: str, type: MessageType, data: bytes) -> tuple[int, int]:
        """Record an outgoing request or response; return its output position and hash."""
        dispatcher = self.dispatcher
        loop = dispatcher.loop
        loop.activity_ns = loop.now_ns
        recorder = dispatcher.recorder
        if recorder is None:
            dispatcher.unrecorded += 1
            return 0, 0
        digest = hash64(data)
        if self._channel is None:
            self._channel = self._transport.channel(prefix + self.service, type)
        position = recorder.message(kind, self.entity_id, self._channel, loop.now_ns, data, digest)
        return position, digest

    def trace_name(self) -> str:
        return self.service

    def trace_type(self) -> str:
        return self.type.name

    def _destroy(self) -> None:
        super()._destroy()
        self.queue.clear()


class Service(ServiceEndpoint):
    """Serves; ``callback`` is called with a request's bytes and returns the response's."""

    kind = EntityKind.SERVICE

    def __init__(
        self,
        transport: Transport,
        node: Any,
        service: str,
        type: ServiceType,
        qos: Qos,
        callback: Callable[[bytes], bytes] | None = None,
    ) -> None:
        super().__init__(transport, node, service, type, qos)
        self.callback = callback

    def dispatch(self) -> None:
        if not self.may_run():
            return
        data, *cause, info = self.queue.popleft()
        args = (data, info)
        self.dispatcher.execute(
            self, self.entity_id, self.node, SERVICE, self._answer, args, *cause
        )

    def _answer(self, data: bytes, info: ServiceInfo) -> None:
        assert self.callback is not None
        self.respond(self.callback(data), info.request_id)

    def respond(self, data: bytes, request_id: RequestId) -> None:
        position, digest = self._emit(_RESPONSE, PREFIX_RESPONSE, self.type.response, data)
        client = request_id.client
        if client.destroyed:
            return
        loop = self.dispatcher.loop
        info = ServiceInfo(request_id, loop.now_ns)
        exchange = (data, loop.events, position, digest, info)
        network = self._transport.network
        if network is None:
            client.deliver(exchange)
        else:
            network.response(self.service, client, self, exchange)

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(self.user_callback())}


class Client(ServiceEndpoint):
    """Calls a service; each request's ``callback`` is called with the response's bytes."""

    kind = EntityKind.CLIENT

    def __init__(
        self, transport: Transport, node: Any, service: str, type: ServiceType, qos: Qos
    ) -> None:
        super().__init__(transport, node, service, type, qos)
        self._sequence = 0
        self._pending: dict[int, Callable[[bytes], object]] = {}

    def servers(self) -> list[Service]:
        return [] if self.graph is None else self.graph.services(self.service)

    def call(self, data: bytes, callback: Callable[[bytes], object]) -> None:
        """Send a request; ``callback`` gets the first response."""
        self._pending[self.request(data).sequence_number] = callback

    def has_asked(self, sequence: int) -> bool:
        """Whether it has sent a request of that number."""
        return sequence <= self._sequence

    def request(self, data: bytes) -> RequestId:
        """Send a request to every server of the service; without one it is lost, as in DDS."""
        self._sequence += 1
        position, digest = self._emit(_REQUEST, PREFIX_REQUEST, self.type.request, data)
        loop = self.dispatcher.loop
        info = ServiceInfo(RequestId(self, self._sequence), loop.now_ns)
        exchange = (data, loop.events, position, digest, info)
        network = self._transport.network
        for server in self.servers():
            if network is None:
                server.deliver(exchange)
            else:
                network.request(self.service, self, server, exchange)
        return info.request_id

    def dispatch(self) -> None:
        if not self.may_run():
            return
        data, *cause, info = self.queue.popleft()
        args = (data, info)
        self.dispatcher.execute(self, self.entity_id, self.node, CLIENT, self._take, args, *cause)

    def _take(self, data: bytes, info: ServiceInfo) -> None:
        callback = self._pending.pop(info.request_id.sequence_number, None)
        if callback is not None:  # else another server was faster
            callback(data)
