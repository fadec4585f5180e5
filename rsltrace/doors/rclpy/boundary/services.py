"""Services and clients. A request and a response are serialized once, as messages are."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from rsltrace.doors.rclpy.boundary.callback_groups import begin
from rsltrace.doors.rclpy.boundary.entity_handle import Receiver, callback_name
from rsltrace.doors.rclpy.boundary.introspection import (
    REQUEST_RECEIVED,
    REQUEST_SENT,
    RESPONSE_RECEIVED,
    RESPONSE_SENT,
    ServiceEvents,
    reconfigured,
)
from rsltrace.doors.rclpy.stacks.mailbox import executor_of
from rsltrace.doors.rclpy.stacks.tasks import is_coroutine_function, start_coroutine
from rsltrace.doors.rclpy.wire.codec import codec_for
from rsltrace.doors.rclpy.wire.interfaces import schema_text
from rsltrace.doors.rclpy.wire.type_descriptions import answer
from rsltrace.middleware.qos import Qos
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import PREFIX_REQUEST, PREFIX_RESPONSE

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core

_SERVICE = int(EventKind.SERVICE)
_CLIENT = int(EventKind.CLIENT)
_REQUEST = int(OutputKind.REQUEST)
_RESPONSE = int(OutputKind.RESPONSE)


class RequestId:
    """Stands in for ``rmw_request_id_t``; remembers who asked."""

    __slots__ = ("client", "sequence_number")

    def __init__(self, client: ClientHandle, sequence_number: int) -> None:
        self.client = client
        self.sequence_number = sequence_number


class ServiceInfo:
    """Stands in for ``rmw_service_info_t``; stamps in nanoseconds."""

    __slots__ = ("received_timestamp", "request_id", "source_timestamp")

    def __init__(self, request_id: RequestId, stamp_ns: int) -> None:
        self.request_id = request_id
        self.source_timestamp = stamp_ns
        self.received_timestamp = stamp_ns


# On its way: canonical CDR, event index, output position, content hash, header.
Exchange = tuple[bytes, int, int, int, ServiceInfo]


class _End(Receiver):
    """What a client and a server have in common."""

    def __init__(self, core: Core, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> None:
        self.service = node.resolve(name, service=True)
        self._request = codec_for(srv_type.Request)
        self._response = codec_for(srv_type.Response)
        self.srv_type = srv_type
        self.type_name = self._request.type_name.removesuffix("_Request")
        self.profile = Qos.from_rmw(qos).resolved(publisher=True, peers=[])
        super().__init__(core, node)
        self.queue: deque[Exchange] = deque()
        self._channel: int | None = None
        self._events: ServiceEvents | None = None

    def _emit(self, kind: int, prefix: str, codec: Any, part: Any, data: bytes) -> tuple[int, int]:
        """Record an outgoing request or response; return its output position and hash."""
        core = self.core
        core.loop.activity_ns = core.loop.now_ns
        recorder = core.recorder
        if recorder is None:
            core.unrecorded += 1
            return 0, 0
        digest = hash64(data)
        if self._channel is None:
            self._channel = core.channel(
                prefix + self.service, codec.type_name, lambda: (schema_text(part), ""), ""
            )
        position = recorder.message(
            kind, self.entity_id, self._channel, core.loop.now_ns, data, digest
        )
        return position, digest

    def configure_introspection(self, clock: Any, qos: Any, state: Any) -> None:
        """Publish what is sent and received from now on, or no longer."""
        self._events = reconfigured(self._events, self, clock, qos, state)

    def _tell(self, event_type: int, request_id: RequestId, message: Any) -> None:
        """Publish a service event, if introspection is on."""
        if self._events is not None:
            self._events.publish(event_type, request_id, message)

    def _close(self) -> None:
        """Let go of what has arrived, and of the publisher of service events."""
        self.queue.clear()
        if self._events is not None:
            self._events.close()

    def trace_name(self) -> str:
        return self.service

    def trace_type(self) -> str:
        return self.type_name


class ServiceHandle(_End):
    """Stands in for ``_rclpy.Service``."""

    kind = EntityKind.SERVICE
    lists = "services"

    def __init__(self, core: Core, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> None:
        super().__init__(core, node, srv_type, name, qos)
        core.graph.add_service(self)

    @property
    def name(self) -> str:
        """The resolved service name."""
        return self.service

    @property
    def qos(self) -> dict[str, Any]:
        """The QoS profile as rclpy's lifecycle nodes ask for it."""
        return self.profile.to_dict()

    def dispatch(self) -> None:
        """Take the oldest request, run the callback and send what it returns."""
        if not self.may_run():
            return
        data, event, position, digest, header = self.queue.popleft()
        request = self._request.deserialize(data)
        core = self.core
        wrapper = self.wrapper
        if is_coroutine_function(wrapper.callback):
            begin(wrapper.callback_group, wrapper)
            start_coroutine(
                core, self, _SERVICE, self._serve_async, (request, header), event, position, digest
            )
            return
        core.execute(
            self,
            self.entity_id,
            self.node,
            _SERVICE,
            self._serve,
            (request, header),
            event,
            position,
            digest,
        )

    def _serve(self, request: Any, header: ServiceInfo) -> None:
        wrapper = self.wrapper
        if self._events is not None:
            self._tell(REQUEST_RECEIVED, header.request_id, request)
        response = wrapper.callback(request, self.srv_type.Response())
        wrapper.send_response(response, header)

    async def _serve_async(self, request: Any, header: ServiceInfo) -> None:
        wrapper = self.wrapper
        self._tell(REQUEST_RECEIVED, header.request_id, request)
        response = await wrapper.callback(request, self.srv_type.Response())
        wrapper.send_response(response, header)

    def service_take_request(self, request_type: Any) -> tuple[Any, Any]:
        """Take a request by hand; ``(None, None)`` if there is none."""
        if not self.queue:
            return None, None
        data, _, _, _, header = self.queue.popleft()
        request = self._request.deserialize(data)
        self._tell(REQUEST_RECEIVED, header.request_id, request)
        return request, header

    def service_send_response(self, response: Any, request_id: RequestId) -> None:
        """Send a response to the client that asked."""
        data = self._response.serialize(response)
        position, digest = self._emit(
            _RESPONSE, PREFIX_RESPONSE, self._response, self.srv_type.Response, data
        )
        client = request_id.client
        if not client.destroyed:
            info = ServiceInfo(request_id, self.core.loop.now_ns)
            exchange = (data, self.core.loop.events, position, digest, info)
            if self.core.network is None:
                client.deliver(exchange)
            else:
                self.core.network.response(client, self, exchange)
        if self._events is not None:
            self._tell(RESPONSE_SENT, request_id, response)

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(getattr(self.wrapper, "callback", None))}

    def _destroy(self) -> None:
        self.core.graph.remove_service(self)
        self._close()


class ClientHandle(_End):
    """Stands in for ``_rclpy.Client``."""

    kind = EntityKind.CLIENT
    lists = "clients"

    def __init__(self, core: Core, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> None:
        super().__init__(core, node, srv_type, name, qos)
        self._sequence = 0
        core.graph.add_client(self)

    @property
    def service_name(self) -> str:
        """The resolved service name."""
        return self.service

    def service_server_is_available(self) -> bool:
        """Return whether a server is there now."""
        return bool(self.core.graph.services(self.service))

    def send_request(self, request: Any) -> int:
        """Send a request to every server of that name; without one it is lost, as in DDS."""
        data = self._request.serialize(request)
        self._sequence += 1
        position, digest = self._emit(
            _REQUEST, PREFIX_REQUEST, self._request, self.srv_type.Request, data
        )
        header = ServiceInfo(RequestId(self, self._sequence), self.core.loop.now_ns)
        exchange = (data, self.core.loop.events, position, digest, header)
        network = self.core.network
        for server in self.core.graph.services(self.service):
            if network is None:
                server.deliver(exchange)
            else:
                network.request(self, server, exchange)
        if self._events is not None:
            self._tell(REQUEST_SENT, header.request_id, request)
        return self._sequence

    def take_response(self, response_type: Any) -> tuple[Any, Any]:
        """Take a response by hand; ``(None, None)`` if there is none."""
        if not self.queue:
            return None, None
        data, _, _, _, header = self.queue.popleft()
        response = self._response.deserialize(data)
        self._tell(RESPONSE_RECEIVED, header.request_id, response)
        return header, response

    def dispatch(self) -> None:
        """Take the oldest response and complete its future."""
        if not self.may_run():
            return
        data, event, position, digest, header = self.queue.popleft()
        self.core.execute(
            self,
            self.entity_id,
            self.node,
            _CLIENT,
            self._complete,
            (self._response.deserialize(data), header.request_id),
            event,
            position,
            digest,
        )

    def _complete(self, response: Any, request_id: RequestId) -> None:
        """Set the result; plain done callbacks belong to this event, coroutines become tasks."""
        if self._events is not None:
            self._tell(RESPONSE_RECEIVED, request_id, response)
        try:
            future = self.wrapper.get_pending_request(request_id.sequence_number)
        except KeyError:
            return  # cancelled, or another server was faster
        executor = executor_of(self.core, self)
        future._set_executor(executor)
        with future._lock:
            callbacks, future._callbacks = future._callbacks, []
        future.set_result(response)
        for callback in callbacks:
            if is_coroutine_function(callback):
                executor.create_task(callback, future)
            else:
                callback(future)

    def _destroy(self) -> None:
        self.core.graph.remove_client(self)
        self._close()


class TypeDescriptionServiceHandle:
    """Stands in for ``_rclpy.TypeDescriptionService``."""

    def __init__(self, core: Core, node: NodeHandle) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation as boundary
        from type_description_interfaces.srv import GetTypeDescription

        profile = boundary.rmw_qos_profile_t.predefined("qos_profile_services_default")
        self._core = core
        self.impl = ServiceHandle(core, node, GetTypeDescription, "~/get_type_description", profile)

    def handle_request(self, request: Any, response_type: Any, node: Any) -> Any:
        """Describe an interface that one of the node's endpoints uses."""
        return answer(request, response_type, self._core.graph.interfaces_of(node))

    def destroy_when_not_in_use(self) -> None:
        """Destroy the service, unless the node has done so already."""
        self.impl.destroy_when_not_in_use()
