"""The handles of services and clients."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

from rsltrace.adapters.rclpy.concurrency.code_lines import CallSites, FunctionRecorder
from rsltrace.adapters.rclpy.concurrency.tasks import (
    executor_of,
    is_awaited,
    is_coroutine_function,
    start_coroutine,
)
from rsltrace.adapters.rclpy.handles.entity_handle import ReceiverHandle
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.handles.qos_profiles import profile_of, qos_of
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interface_classes import type_name
from rsltrace.adapters.rclpy.messages.interfaces import (
    installed_description,
    installed_file_text,
    service_type,
)
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.middleware.graph import Graph
from rsltrace.simulation.middleware.services import (
    CLIENT,
    SERVICE,
    Client,
    RequestId,
    Service,
    ServiceEndpoint,
    ServiceInfo,
)

# Descriptions of interfaces for ``~/get_type_description``.
#
# rosidl compiles them into the type support libraries, where rcl finds them, and installs them as
# files, which are read here.


@dataclass(frozen=True)
class TypeDescription:
    """The description of an interface: the types it is made of (itself first), each with the
    (name, type id, capacity, string capacity, nested type, default) of its fields, and the
    (type name, encoding, text) of its sources."""

    type_hash: str
    types: tuple[tuple[str, tuple[tuple[str, int, int, int, str, str], ...]], ...]
    sources: tuple[tuple[str, str, str], ...]

    def message(self) -> Any:
        """Return it as ``type_description_interfaces/msg/TypeDescription``."""
        from type_description_interfaces.msg import TypeDescription as Message

        first, *others = (_type_message(name, fields) for name, fields in self.types)
        return Message(type_description=first, referenced_type_descriptions=others)


def _type_message(name: str, fields: tuple[Any, ...]) -> Any:
    from type_description_interfaces.msg import Field, FieldType, IndividualTypeDescription

    return IndividualTypeDescription(
        type_name=name,
        fields=[
            Field(
                name=field,
                type=FieldType(
                    type_id=number,
                    capacity=capacity,
                    string_capacity=string_capacity,
                    nested_type_name=nested,
                ),
                default_value=default,
            )
            for field, number, capacity, string_capacity, nested, default in fields
        ],
    )


@cache
def type_description(interface: Any) -> TypeDescription | None:
    """Describe a message, service or action class; None if no description is installed."""
    name = type_name(interface)
    read = installed_description(name)
    if read is None:
        return None
    whole = read.type_description_msg
    types = {t.type_name: t for t in [whole.type_description, *whole.referenced_type_descriptions]}
    if name not in types:
        return None
    needed, found = {name}, [name]
    for each in found:  # grows
        for field in types[each].fields:
            nested = field.type.nested_type_name
            if nested and nested not in needed:
                needed.add(nested)
                found.append(nested)
    names = [name, *sorted(needed - {name})]
    return TypeDescription(
        type_hash=next(h.hash_string for h in read.type_hashes if h.type_name == name),
        types=tuple((each, tuple(map(_field, types[each].fields))) for each in names),
        sources=tuple(map(_source, names)),
    )


def _field(field: Any) -> tuple[str, int, int, int, str, str]:
    return (
        field.name,
        field.type.type_id,
        field.type.capacity,
        field.type.string_capacity,
        field.type.nested_type_name,
        field.default_value,
    )


def _source(name: str) -> tuple[str, str, str]:
    _, kind, type_ = name.split("/")
    if "_" in type_:  # a part of a service or an action
        return name, "implicit", ""
    text = installed_file_text(name) or ""
    # rosidl compiles a text with a NUL in place of its last character.
    return name, kind, f"{text[:-1]}\0" if text.endswith("\n") else text


def answer_request(request: Any, response_type: Any, interfaces: Iterable[Any]) -> Any:
    """Answer a GetTypeDescription request about a node's interfaces, as rcl does."""
    from type_description_interfaces.msg import TypeSource

    wanted = str(request.type_hash)
    if not wanted.startswith("RIHS") or len(wanted) != 71:
        return response_type(failure_reason="Failed to parse type hash")
    for interface in interfaces:
        found = type_description(interface)
        if found is not None and found.type_hash == wanted:
            response = response_type(successful=True, type_description=found.message())
            if request.include_type_sources:
                response.type_sources = [
                    TypeSource(type_name=name, encoding=encoding, raw_file_contents=text)
                    for name, encoding, text in found.sources
                ]
            return response
    return response_type(failure_reason="Type not currently in use by this node")


# Numbers of service_msgs/msg/ServiceEventInfo.
REQUEST_SENT, REQUEST_RECEIVED, RESPONSE_SENT, RESPONSE_RECEIVED = 0, 1, 2, 3
_OFF, _CONTENTS = 0, 2


class ServiceEvents:
    """Service introspection: publishes the requests and responses of a service or client on
    ``<service>/_service_event``, with or without contents, as rcl does."""

    def __init__(self, node: NodeHandle, srv_type: Any, service: str, clock: Any, qos: Any) -> None:
        self._type = srv_type.Event
        self._clock = clock
        self._contents = False
        self.publisher = PublisherHandle(node, self._type, f"{service}/_service_event", qos)

    def set_state(self, state: int) -> None:
        self._contents = state == _CONTENTS

    def publish(self, event_type: int, request_id: RequestId, message: Any) -> None:
        from builtin_interfaces.msg import Time
        from service_msgs.msg import ServiceEventInfo

        seconds, nanoseconds = divmod(self._clock.get_now().nanoseconds, 1_000_000_000)
        event = self._type(
            info=ServiceEventInfo(
                event_type=event_type,
                stamp=Time(sec=seconds, nanosec=nanoseconds),
                client_gid=list(request_id.client.entity_id.to_bytes(16, "big")),
                sequence_number=request_id.sequence_number,
            )
        )
        if self._contents:
            answers = event_type in (RESPONSE_SENT, RESPONSE_RECEIVED)
            setattr(event, "response" if answers else "request", [message])
        self.publisher.publish(event)

    def close(self) -> None:
        if not self.publisher.destroyed:
            self.publisher.destroy_when_not_in_use()


def updated_service_events(
    events: ServiceEvents | None, end: Any, clock: Any, qos: Any, state: Any
) -> Any:
    """Return the ``ServiceEvents`` of ``end`` (a service or client) for a state; None for off.

    As in rcl, an existing publisher keeps its clock and QoS; switching off destroys it.
    """
    if int(state) == _OFF:
        if events is not None:
            events.close()
        return None
    if events is None:
        events = ServiceEvents(end.node, end.srv_type, end.service, clock, qos)
    events.set_state(int(state))
    return events


class ServiceEndHandle(ReceiverHandle, ServiceEndpoint):
    """Base class of the handles of services and clients."""

    def _prepare(self, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> tuple[Any, ...]:
        """Set the attributes of rclpy's side; return the middleware's constructor arguments."""
        service = node.resolve(name, service=True)
        self._request = codec_for(srv_type.Request)
        self._response = codec_for(srv_type.Response)
        self.srv_type = srv_type
        self.runtime = node.runtime
        self._service_events: ServiceEvents | None = None
        return node.runtime.domain.transport, node, service, service_type(srv_type), qos_of(qos)

    def configure_introspection(self, clock: Any, qos: Any, state: Any) -> None:
        self._service_events = updated_service_events(self._service_events, self, clock, qos, state)

    def _tell(self, event_type: int, request_id: RequestId, message: Any) -> None:
        """Publish a service event, if introspection is on."""
        if self._service_events is not None:
            self._service_events.publish(event_type, request_id, message)

    trace_name = ServiceEndpoint.trace_name

    def _destroy(self) -> None:
        super()._destroy()
        if self._service_events is not None:
            self._service_events.close()


class ServiceHandle(ServiceEndHandle, Service):
    """Stands in for ``_rclpy.Service``."""

    lists = "services"

    def __init__(self, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> None:
        Service.__init__(self, *self._prepare(node, srv_type, name, qos))
        node.runtime.domain.graph.add_service(self)

    @property
    def name(self) -> str:
        return self.service

    @property
    def qos(self) -> dict[str, Any]:
        return profile_of(self.profile)

    def dispatch(self) -> None:
        if not self.may_run():
            return
        data, event, position, digest, header = self.queue.popleft()
        args = self._request.deserialize(data), header
        if is_awaited(self.runtime, self.wrapper.callback):
            serve = self._serve_async
            start_coroutine(self.runtime, self, SERVICE, serve, args, event, position, digest)
        else:
            execute = self.dispatcher.execute
            serve_now = self._serve
            execute(
                self, self.entity_id, self.node, SERVICE, serve_now, args, event, position, digest
            )

    def _serve(self, request: Any, header: ServiceInfo) -> None:
        wrapper = self.wrapper
        if self._service_events is not None:
            self._tell(REQUEST_RECEIVED, header.request_id, request)
        response = wrapper.callback(request, self.srv_type.Response())
        wrapper.send_response(response, header)

    async def _serve_async(self, request: Any, header: ServiceInfo) -> None:
        from rclpy import executors

        wrapper = self.wrapper
        self._tell(REQUEST_RECEIVED, header.request_id, request)
        empty = self.srv_type.Response()
        response = await executors.await_or_execute(wrapper.callback, request, empty)
        wrapper.send_response(response, header)

    def service_take_request(self, request_type: Any) -> tuple[Any, Any]:
        """Take a request outside of a callback; ``(None, None)`` if there is none."""
        if not self.queue:
            return None, None
        data, _, _, _, header = self.queue.popleft()
        request = self._request.deserialize(data)
        self._tell(REQUEST_RECEIVED, header.request_id, request)
        return request, header

    def service_send_response(self, response: Any, request_id: RequestId) -> None:
        self.respond(self._response.serialize(response), request_id)
        if self._service_events is not None:
            self._tell(RESPONSE_SENT, request_id, response)


class ClientHandle(ServiceEndHandle, Client):
    """Stands in for ``_rclpy.Client``."""

    lists = "clients"

    def __init__(self, node: NodeHandle, srv_type: Any, name: str, qos: Any) -> None:
        Client.__init__(self, *self._prepare(node, srv_type, name, qos))
        self._sites = CallSites(node.dispatcher, self.entity_id)
        self._functions = FunctionRecorder(node.dispatcher)
        node.runtime.domain.graph.add_client(self)

    @property
    def service_name(self) -> str:
        return self.service

    def service_server_is_available(self) -> bool:
        self.node.require_up("failed to check service availability")
        return bool(self.servers())

    def send_request(self, request: Any) -> int:
        """Send a request to every server; without one it is lost, as in DDS."""
        data = self._request.serialize(request)
        sites = self._sites
        if self._sequence == sites.due or self.dispatcher.event.entity != sites.running:
            sites.look(self._sequence)
        request_id = self.request(data)
        if self._service_events is not None:
            self._tell(REQUEST_SENT, request_id, request)
        return request_id.sequence_number

    def take_response(self, response_type: Any) -> tuple[Any, Any]:
        """Take a response outside of a callback; ``(None, None)`` if there is none."""
        if not self.queue:
            return None, None
        data, _, _, _, header = self.queue.popleft()
        response = self._response.deserialize(data)
        self._tell(RESPONSE_RECEIVED, header.request_id, response)
        return header, response

    def dispatch(self) -> None:
        if not self.may_run():
            return
        data, event, position, digest, header = self.queue.popleft()
        args = self._response.deserialize(data), header.request_id
        execute = self.dispatcher.execute
        execute(
            self, self.entity_id, self.node, CLIENT, self._complete, args, event, position, digest
        )

    def _complete(self, response: Any, request_id: RequestId) -> None:
        """Set the future's result. Plain done callbacks belong to this event, coroutines become
        tasks; if executors poll, all become tasks, as in rclpy."""
        if self._service_events is not None:
            self._tell(RESPONSE_RECEIVED, request_id, response)
        try:
            future = self.wrapper.get_pending_request(request_id.sequence_number)
        except KeyError:
            return  # cancelled, or answered by another server
        executor = executor_of(self.runtime, self)
        future._set_executor(executor)
        if self.runtime.loop.polls:
            future.set_result(response)  # done callbacks are tasks
            return
        with future._lock:
            callbacks, future._callbacks = future._callbacks, []
        future.set_result(response)
        for callback in callbacks:
            self._functions.run(self.entity_id, callback)
            if is_coroutine_function(callback):
                executor.create_task(callback, future)
            else:
                callback(future)


class TypeDescriptionServiceHandle:
    """Stands in for ``_rclpy.TypeDescriptionService``."""

    def __init__(self, node: NodeHandle) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation as boundary
        from type_description_interfaces.srv import GetTypeDescription

        profile = boundary.rmw_qos_profile_t.predefined("qos_profile_services_default")
        self._graph = node.runtime.domain.graph
        self.impl = ServiceHandle(node, GetTypeDescription, "~/get_type_description", profile)

    def handle_request(self, request: Any, response_type: Any, node: Any) -> Any:
        return answer_request(request, response_type, _interfaces_of(self._graph, node))

    def destroy_when_not_in_use(self) -> None:
        self.impl.destroy_when_not_in_use()


def _interfaces_of(graph: Graph, node: Any) -> Iterator[Any]:
    """Yield the message, service and action classes that a node uses."""
    for end in graph.endpoints_of(node):
        if isinstance(end, PublisherHandle | SubscriptionHandle):
            yield end.msg_type
        elif isinstance(end, ServiceEndHandle):
            yield end.srv_type
    yield from (action.action_type for action in node.actions)
