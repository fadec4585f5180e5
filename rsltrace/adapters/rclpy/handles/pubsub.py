"""The handles of publishers, subscriptions and QoS events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NoReturn

from rsltrace.adapters.rclpy.concurrency.blocking_calls import wait
from rsltrace.adapters.rclpy.concurrency.code_lines import CallSites
from rsltrace.adapters.rclpy.concurrency.tasks import is_awaited, run_callback, start_callback
from rsltrace.adapters.rclpy.handles.entity_handle import (
    EVENTS,
    Alarm,
    EntityHandle,
    ReceiverHandle,
)
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.qos_profiles import qos_of
from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import message_type
from rsltrace.compiled import SubscriptionFields, core
from rsltrace.errors import UnsupportedError
from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.simulation.middleware.interface import callback_source
from rsltrace.simulation.middleware.participant import QosEvent
from rsltrace.simulation.middleware.publisher import Publisher
from rsltrace.simulation.middleware.qos.policies import Qos
from rsltrace.simulation.middleware.qos.timing import (
    DEADLINE_MISSED,
    INCOMPATIBLE,
    LIVELINESS_CHANGED,
    LIVELINESS_LOST,
    MATCHED,
    MESSAGE_LOST,
    IncompatibleQosStatus,
)
from rsltrace.simulation.middleware.subscription import (
    DATA,
    NUMBER,
    RECEIVED_NS,
    SENT_NS,
    SUBSCRIPTION,
    Delivery,
    Subscription,
)
from rsltrace.trace.model.event import EventKind

# Which callback stands behind a subscription of ROS's message_filters.


def filter_detail(callback: object) -> dict[str, object]:
    """Return the synchronizer's callback and how far apart stamps may be, if ``callback`` is that
    of a ``message_filters.Subscriber`` which is an input of a synchronizer."""
    subscriber = getattr(callback, "__self__", None)
    if type(subscriber).__module__.partition(".")[0] != "message_filters":
        return {}
    for add, *_ in getattr(subscriber, "callbacks", {}).values():
        synchronizer: Any = getattr(add, "__self__", None)
        if hasattr(synchronizer, "input_connections") and synchronizer.callbacks:
            function = next(iter(synchronizer.callbacks.values()))[0]
            slop_ns = getattr(getattr(synchronizer, "slop", None), "nanoseconds", 0)
            name, source = callback_name(function), callback_source(function)
            return {"filter": {"callback": name, "source": source, "slop_ns": slop_ns}}
    return {}


class PublisherHandle(EntityHandle, Publisher):
    """Stands in for ``_rclpy.Publisher``."""

    lists = "publishers"

    def __init__(self, node: NodeHandle, msg_type: Any, topic: str, qos: Any) -> None:
        resolved = node.resolve(topic, service=False)
        codec = codec_for(msg_type)
        self.msg_type = msg_type
        self.runtime = node.runtime
        self._serialize = codec.serialize
        self._canonical = codec.canonical
        profile = qos if isinstance(qos, Qos) else qos_of(qos)
        domain = node.runtime.domain
        Publisher.__init__(self, domain.transport, node, resolved, message_type(msg_type), profile)
        self._event = node.dispatcher.event
        self._sites = CallSites(node.dispatcher, self.entity_id)
        domain.graph.add_publisher(self)

    def publish_any(self, msg: Any) -> None:
        """Publish a message: a snapshot of it goes to every connected subscription."""
        serialize = self._serialize  # a local variable is called faster
        data = serialize(msg)
        sites = self._sites
        if self._count == sites.due or self._event.entity != sites.running:
            sites.look(self._count)
        self.send(data)

    if core is None or TYPE_CHECKING:
        publish = publish_any
        """The compiled one leaves to ``publish_any`` what is to be looked up, and to ``send_any``
        what that is for."""

    def publish_raw(self, data: bytes) -> None:
        """Publish a serialized message. Raises ValueError if it is not of this topic's type."""
        data = self._canonical(data)
        self._sites.look(self._count)
        self.send(data)

    def refuse(self, refusal: Callable[[object], NoReturn]) -> None:
        """Let every publication raise by ``refusal``, which replaces the serializer: so no
        publication has to check first."""
        self._serialize = self._canonical = refusal

    def get_topic_name(self) -> str:
        return self.topic

    def get_subscription_count(self) -> int:
        self.node.require_up("failed to get subscription count", "publisher")
        return len(self.subscriptions)

    def wait_for_all_acked(self, timeout: Any) -> bool:
        """Wait until all messages have reached every reliable subscription; return whether they
        have."""
        self.node.require_up("Failed to wait for all acknowledgements", "publisher")
        limit_ns: int = timeout.nanoseconds
        left_ns = self.acknowledged_ns() - self.runtime.loop.now_ns
        if left_ns <= 0 or limit_ns == 0:
            return left_ns <= 0
        acked = limit_ns < 0 or left_ns <= limit_ns
        wait(self.runtime, "its messages to be acknowledged", for_ns=left_ns if acked else limit_ns)
        return acked

    settle, trace_name = Publisher.settle, Publisher.trace_name


class SubscriptionHandle(ReceiverHandle, Subscription, SubscriptionFields):
    """Stands in for ``_rclpy.Subscription``."""

    lists = "subscriptions"

    def __init__(
        self,
        node: NodeHandle,
        msg_type: Any,
        topic: str,
        qos: Any,
        content_filter: Any = None,
    ) -> None:
        resolved = node.resolve(topic, service=False)
        if content_filter is not None:
            self._refuse_filter(resolved, content_filter[0])
        self._deserialize = codec_for(msg_type).deserialize
        self.msg_type = msg_type
        self.runtime = node.runtime
        self._real = node.real
        self._callback: Any = None
        self._coroutine = False
        self._with_info = False
        graph = node.runtime.domain.graph
        profile = graph.settled_request(resolved, qos_of(qos))
        Subscription.__init__(
            self, node.dispatcher, node, resolved, message_type(msg_type), profile
        )
        graph.add_subscription(self)

    def dispatch_any(self) -> None:
        """Run the callback for the oldest arrival, if it may run."""
        if not self.may_run():
            return
        wrapper = self.wrapper
        # A ``Delivery``, unpacked by its positions: the fastest way.
        _, _, _, _, data, event, position, digest, _, _ = delivery = self.queue.popleft()
        callback = wrapper._callback
        if callback is not self._callback:
            self._learn(wrapper)
        deserialize = self._as_received if wrapper.raw else self._deserialize
        message = deserialize(data)
        args = (message, _message_info(delivery)) if self._with_info else (message,)
        if self._coroutine:
            start_callback(
                self.runtime, self, SUBSCRIPTION, callback, args, event, position, digest
            )
            return
        self.dispatcher.execute(
            self, self.entity_id, self.node, SUBSCRIPTION, callback, args, event, position, digest
        )

    if core is None or TYPE_CHECKING:
        dispatch = dispatch_any
    else:
        dispatch = core.SubscriptionFields.dispatch
        """Does the usual case, a free group and a plain function that gets the message alone, and
        leaves the others to ``dispatch_any``."""

    def _as_received(self, data: bytes) -> bytes:
        """Return the bytes as Fast DDS does: padded to a multiple of four between processes.

        Each entry of a job stands for a process.
        """
        own = self.node
        if self.publishers and all(
            other.node.process is own.process
            and getattr(other.node, "entry_key", None) == own.entry_key
            for other in self.publishers
        ):
            return data
        return data + bytes(-len(data) % 4)

    def _learn(self, wrapper: Any) -> None:
        """Look up how to run a new callback; user code may replace it at any time."""
        self._callback = wrapper._callback
        self._coroutine = is_awaited(self.runtime, wrapper._callback)
        kind = getattr(wrapper, "_callback_type", None)  # from Iron on
        self._with_info = getattr(kind, "name", "MessageOnly") != "MessageOnly"

    def forget_callback(self) -> None:
        """Look up how to run the callback again."""
        self._callback = None

    def take_message(self, msg_type: Any, raw: bool) -> Any:
        """Take a message by hand, as a wait set would; None if there is none."""
        if not self.queue:
            return None
        delivery = self.queue.popleft()
        data = delivery[DATA]
        message = self._as_received(data) if raw else codec_for(msg_type).deserialize(data)
        return message, _message_info(delivery)

    def get_topic_name(self) -> str:
        return self.topic

    def is_cft_enabled(self) -> bool:
        return False

    def set_content_filter(self, expression: str, parameters: list[str]) -> None:
        self._refuse_filter(self.topic, expression)

    def _refuse_filter(self, topic: str, expression: str) -> None:
        raise UnsupportedError(
            f"the subscription of {topic} has a content filter ({expression!r}), which rsltrace "
            "cannot simulate: compare in the callback instead"
        )

    def get_content_filter(self) -> Any:
        raise self._real.RCLError("content filter topic is not enabled")

    def get_publisher_count(self) -> int:
        return len(self.publishers)

    trace_name = Subscription.trace_name

    def trace_detail(self) -> dict[str, object]:
        return {**Subscription.trace_detail(self), **filter_detail(self.user_callback())}


def _message_info(delivery: Delivery) -> dict[str, int | None]:
    """Return the MessageInfo of rclpy 7."""
    return {
        "source_timestamp": delivery[SENT_NS],
        "received_timestamp": delivery[RECEIVED_NS],
        "publication_sequence_number": delivery[NUMBER],
        "reception_sequence_number": None,
    }


_QOS_EVENT = int(EventKind.QOS_EVENT)


_NAMES = {
    "MATCHED": MATCHED,
    "INCOMPATIBLE_QOS": INCOMPATIBLE,
    "DEADLINE_MISSED": DEADLINE_MISSED,
    "LIVELINESS_CHANGED": LIVELINESS_CHANGED,
    "LIVELINESS_LOST": LIVELINESS_LOST,
    "MESSAGE_LOST": MESSAGE_LOST,
}


def _event_name(event_type: Any) -> str:
    name: str = event_type.name
    for ending, ours in _NAMES.items():
        if name.endswith(ending):
            return ours
    return name.lower()


class EventHandle(QosEvent, EntityHandle):
    """Stands in for ``_rclpy.EventHandle``; its wrapper is rclpy's EventHandler waitable. Each
    trigger calls the ``alarms``. ``policies`` is the enumeration ``rmw_qos_policy_kind_t``."""

    lists = "waitables"
    alarms: tuple[Alarm, ...] = ()

    def __init__(
        self, parent: PublisherHandle | SubscriptionHandle, event_type: Any, policies: type
    ) -> None:
        self.runtime = parent.runtime
        super().__init__(parent.dispatcher, parent.node)
        self.policies = policies
        self.listen(parent, _event_name(event_type))

    def _listed_by(self, node: Any) -> Iterator[tuple[Any, Any]]:
        for waitable in node.waitables:
            for name in EVENTS:
                handle = getattr(waitable, name, None)
                if handle is not None:
                    yield handle, waitable

    def take_event(self) -> Any:
        status = super().take_event()
        if isinstance(status, IncompatibleQosStatus):
            status.last_policy_kind = self.policies(status.last_policy_kind)
        return status

    def activate(self) -> None:
        self.trigger()

    def trigger(self) -> None:
        super().trigger()
        for alarm in self.alarms:
            alarm()

    def dispatch(self) -> None:
        if self.mailbox_keeps():
            return
        wrapper = self.wrapper
        if wrapper is None or self.destroyed:
            return
        if not self.has_news():
            self.is_queued = False
            return
        if self.runtime.groups.must_wait(self, wrapper):
            return
        self.is_queued = False
        args = (self.take_event(),)
        run_callback(self.runtime, self, _QOS_EVENT, wrapper.callback, args, *self.cause, 0)

    def settle(self) -> bool:
        self.find_wrapper()
        return True

    def trace_detail(self) -> dict[str, object]:
        return {"callback": callback_name(self.user_callback())}
