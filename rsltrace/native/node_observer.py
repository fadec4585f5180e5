"""Seeing nodes and their entities come into being: ``Node`` and the two ends of actions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any

from rsltrace.adapters.rclpy.arguments import RosArguments
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.adapters.rclpy.handles.logs import QOS_ROSOUT
from rsltrace.adapters.rclpy.handles.qos_profiles import qos_of
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import message_type, service_type
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.support import patched
from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.operation import NODE_SERVICES

_ROSOUT = "/rosout"


class NodeObserver:
    """Tells ``entities`` of what nodes create. ``entry`` is whose nodes this thread constructs."""

    def __init__(
        self, entities: ObservedEntities, gid_of: Callable[[Any], bytes] = lambda handle: b""
    ) -> None:
        self._entities = entities
        self._gid_of = gid_of
        self._local = threading.local()
        self.main: JobEntry | None = None
        """Whose nodes all others of this process are."""

    @contextmanager
    def constructing(self, entry: JobEntry) -> Iterator[None]:
        """Give the nodes that this thread makes the arguments of an entry."""
        self._local.entry = entry
        try:
            yield
        finally:
            self._local.entry = None

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Observe all nodes that are made meanwhile."""
        from rclpy.action.client import ActionClient
        from rclpy.action.server import ActionServer
        from rclpy.lifecycle.node import LifecycleNodeMixin
        from rclpy.node import Node

        made: dict[str, Callable[[ObservedEntity, Any], object]] = {
            "create_publisher": self._publisher,
            "create_subscription": self._subscription,
            "create_timer": self._timer,
            "create_client": self._client,
            "create_service": self._service,
            "create_guard_condition": self._guard_condition,
        }
        with ExitStack() as stack:
            stack.enter_context(patched(Node, "__init__", self._with_arguments))
            for name, tell in made.items():
                stack.enter_context(patched(Node, name, self._telling(tell)))
            stack.enter_context(patched(LifecycleNodeMixin, "__init__", self._with_states))
            stack.enter_context(patched(ActionServer, "__init__", self._action(True)))
            stack.enter_context(patched(ActionClient, "__init__", self._action(False)))
            yield

    def node(self, node: Any) -> ObservedEntity:
        """Return a node's entity, which is made when the node makes its first."""
        found = self._entities.find(node)
        if found is not None:
            return found
        kind = type(node)
        name = node.get_fully_qualified_name()
        entity = self._entities.add(
            (node,),
            None,
            EntityKind.NODE,
            name,
            f"{kind.__module__}:{kind.__qualname__}",
            runs=kind,
        )
        from rcl_interfaces.msg import Log

        type_name = message_type(Log).name
        rosout = self._entities.add(
            (), entity, EntityKind.PUBLISHER, _ROSOUT, type_name, qos=QOS_ROSOUT.summary()
        )
        self._entities.rosout.setdefault(node.get_logger().name, _with_types(rosout, Log))
        return entity

    def _with_arguments(self, original: Callable[..., None]) -> Callable[..., None]:
        """Wrap ``Node.__init__``: a node of an entry gets what ``ros2 run`` would give it."""

        @wraps(original)
        def construct(node: Any, node_name: str, *args: Any, **kwargs: Any) -> None:
            entry: JobEntry | None = getattr(self._local, "entry", None) or self.main
            if entry is not None and kwargs.get("use_global_arguments", True):
                kwargs = with_arguments(entry, node_name, kwargs)
            original(node, node_name, *args, **kwargs)
            self.node(node)
            for service in node.services:  # one that rclpy makes without create_service
                self.meet(node, service)

        return construct

    def meet(self, node: Any, made: Any) -> None:
        """Tell of what a node has if nobody did: it was made without the node's ``create_…``."""
        if self._entities.find(made) is not None:
            return
        from rclpy.client import Client
        from rclpy.service import Service
        from rclpy.subscription import Subscription

        tells = {Service: self._service, Client: self._client, Subscription: self._subscription}
        for kind, tell in tells.items():
            if isinstance(made, kind):
                tell(self.node(node), made)

    def _with_states(self, original: Callable[..., None]) -> Callable[..., None]:
        """Wrap the constructor of lifecycle nodes: rcl makes services, and says what changes."""

        @wraps(original)
        def construct(node: Any, *args: Any, **kwargs: Any) -> None:
            original(node, *args, **kwargs)
            for service in node.services:
                self.meet(node, service)
            if hasattr(node, "_service_change_state"):  # it is to communicate
                self._transitions(self.node(node), node)

        return construct

    def _transitions(self, owner: ObservedEntity, node: Any) -> None:
        from lifecycle_msgs.msg import TransitionEvent
        from rclpy.qos import QoSProfile

        topic = node.resolve_topic_name("~/transition_event")
        qos = qos_of(QoSProfile(depth=10).get_c_qos_profile())
        entity = self._entities.add(
            (node._state_machine,),
            owner,
            EntityKind.PUBLISHER,
            topic,
            message_type(TransitionEvent).name,
            qos=qos.summary(),
        )
        entity.qos_yaml = qos.to_yaml()
        _with_types(entity, TransitionEvent)

    def _telling(self, tell: Callable[[ObservedEntity, Any], object]) -> Callable[..., Any]:
        def wrapping(original: Callable[..., Any]) -> Callable[..., Any]:
            @wraps(original)
            def create(node: Any, *args: Any, **kwargs: Any) -> Any:
                owner = self.node(node)
                made = original(node, *args, **kwargs)
                tell(owner, made)
                return made

            return create

        return wrapping

    def _publisher(self, node: ObservedEntity, publisher: Any) -> None:
        qos = qos_of(publisher.qos_profile.get_c_qos_profile())
        with publisher.handle:
            topic = publisher.handle.get_topic_name()
            gid = self._gid_of(publisher.handle)
        entity = self._add(
            publisher, node, EntityKind.PUBLISHER, topic, publisher.msg_type, qos=qos.summary()
        )
        entity.qos_yaml, entity.gid = qos.to_yaml(), gid
        _with_types(entity, publisher.msg_type)

    def _subscription(self, node: ObservedEntity, subscription: Any) -> None:
        with subscription.handle:
            topic = subscription.handle.get_topic_name()
        qos = qos_of(subscription.qos_profile.get_c_qos_profile())
        kind = EntityKind.SUBSCRIPTION
        entity = self._add(
            subscription, node, kind, topic, subscription.msg_type, qos=qos.summary()
        )
        _with_types(entity, subscription.msg_type)

    def _add(
        self,
        wrapper: Any,
        node: ObservedEntity,
        kind: EntityKind,
        name: str,
        type: Any,
        **detail: object,
    ) -> ObservedEntity:
        keys, callback = (wrapper, wrapper.handle), getattr(wrapper, "callback", None)
        if callback is not None:
            detail["callback"] = callback_name(callback)
        named = service_type(type).name if hasattr(type, "Request") else message_type(type).name
        return self._entities.add(keys, node, kind, name, named, runs=callback, **detail)

    def _timer(self, node: ObservedEntity, timer: Any) -> None:
        self._entities.add(
            (timer, timer.handle),
            node,
            EntityKind.TIMER,
            callback_name(timer.callback) or "Rate",  # which gives its timer a callback later
            runs=timer.callback,
            period_ns=timer.timer_period_ns,
        )

    def _guard_condition(self, node: ObservedEntity, guard: Any) -> None:
        name, callback = callback_name(guard.callback), guard.callback
        self._entities.add((guard,), node, EntityKind.GUARD_CONDITION, name, runs=callback)

    def _client(self, node: ObservedEntity, client: Any) -> None:
        with client.handle:
            name = client.handle.service_name
        entity = self._add(client, node, EntityKind.CLIENT, name, client.srv_type)
        _with_types(entity, client.srv_type)

    def _service(self, node: ObservedEntity, service: Any) -> None:
        with service.handle:
            name = service.handle.name
        entity = self._add(service, node, EntityKind.SERVICE, name, service.srv_type)
        _with_types(entity, service.srv_type)

    # -- actions: three services and two topics, each an entity ---------------------------------

    def _action(self, is_server: bool) -> Callable[..., Any]:
        """Wrap the constructor of one end of an action."""

        def wrapping(original: Callable[..., None]) -> Callable[..., None]:
            @wraps(original)
            def construct(
                action: Any, node: Any, action_type: Any, action_name: str, *args: Any, **more: Any
            ) -> None:
                owner = self.node(node)
                original(action, node, action_type, action_name, *args, **more)
                name = node.resolve_topic_name(action_name)
                handle = action._handle if is_server else action._client_handle
                self._entities.parts[handle] = self._parts(owner, name, action_type.Impl, is_server)

            return construct

        return wrapping

    def _parts(
        self, node: ObservedEntity, name: str, impl: Any, is_server: bool
    ) -> dict[str, ObservedEntity]:
        services = {
            "send_goal": impl.SendGoalService,
            "cancel_goal": impl.CancelGoalService,
            "get_result": impl.GetResultService,
        }
        topics = {"feedback": impl.FeedbackMessage, "status": impl.GoalStatusMessage}
        parts = {}
        for part, type in (services | topics).items():
            if part in services:
                kind = EntityKind.SERVICE if is_server else EntityKind.CLIENT
                type_name = service_type(type).name
            else:
                kind = EntityKind.PUBLISHER if is_server else EntityKind.SUBSCRIPTION
                type_name = message_type(type).name
            path = f"{name}/_action/{part}"
            entity = self._entities.add((), node, kind, path, type_name, action=name)
            parts[part] = _with_types(entity, type)
        return parts


def _with_types(entity: ObservedEntity, type: Any) -> ObservedEntity:
    """Say of what types are the messages that an entity sends and takes."""
    if entity.kind is EntityKind.PUBLISHER:
        entity.sends_type = type
    elif entity.kind is EntityKind.SUBSCRIPTION:
        entity.takes_type = type
    elif entity.kind is EntityKind.SERVICE:
        entity.sends_type, entity.takes_type = type.Response, type.Request
    else:
        entity.sends_type, entity.takes_type = type.Request, type.Response
    if entity.sends_type is not None:
        entity.sends = message_type(entity.sends_type)
    if not _is_parameter_service(entity):  # hardly ever used
        make_codecs(entity)
    return entity


def make_codecs(entity: ObservedEntity) -> None:
    """Generate what reads and writes its messages now: the first callback would take longer."""
    for type in (entity.sends_type, entity.takes_type):
        if type is not None:
            _ = codec_for(type).serialize


def _is_parameter_service(entity: ObservedEntity) -> bool:
    name = entity.name.rpartition("/")[2]
    return entity.kind is EntityKind.SERVICE and name in NODE_SERVICES


def with_arguments(entry: JobEntry, node_name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments of a node to which those of its entry are added.

    Its parameters are looked up here: rclpy has no list of arguments in which those of the job win
    over those of a file.
    """
    from rclpy.parameter import Parameter

    own = list(given.get("cli_args") or ())
    inner = RosArguments(["--ros-args", *own] if own else [])
    outer = entry.arguments[0] if entry.arguments else None
    name = inner.remap_node_name(node_name, outer)
    space = inner.remap_namespace(given.get("namespace") or "/", node_name, outer).strip("/")
    full = f"/{space}/{name}" if space else f"/{name}"
    values: dict[str, Any] = {}
    for arguments in (*entry.arguments, inner):
        values.update(arguments.parameters(full))
    overrides = {one: Parameter(one, value=value) for one, value in values.items()}
    overrides.update({one.name: one for one in given.get("parameter_overrides") or ()})
    words = list(outer.arguments) if outer is not None else []
    return {
        **given,
        "cli_args": [*own, *words] or None,
        "parameter_overrides": list(overrides.values()) or None,
    }
