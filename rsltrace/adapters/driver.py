"""What somebody outside does to a running world: publish, call, listen.

Whoever drives a simulation step by step stands outside of all nodes. What they do becomes events of
a kind of its own (OUTSIDE, caused by no event), so that a trace tells it from what the nodes did.
Who only listens leaves no mark.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.world import World
from rsltrace.errors import RunError
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind

NODE_NAME = "outside"
_OUTSIDE = EventKind.OUTSIDE
_RAISED = int(EventFlag.RAISED)


class Call:
    """A function that is called from outside; it may wait in simulated time."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function
        self.done = False
        self._value: Any = None
        self._error: Exception | None = None

    def run(self) -> bool:
        """Run the function; return whether it raised."""
        try:
            self._value = self._function()
        except Exception as error:
            self._error = error
        self.done = True
        return self._error is not None

    def result(self) -> Any:
        """Return what the function returned, or raise what it raised."""
        if self._error is not None:
            raise self._error
        return self._value


class Outside:
    """The outside of one world. Its node, ``/outside``, is made when it first publishes."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._domain = world.domain
        self._node: Any = None
        self._publishers: dict[str, Any] = {}

    def enter(self) -> None:
        """Stand outside: what is done to nodes from now on is nobody's callback."""
        event = self._domain.event
        event.handle = event.node = None
        event.entity = 0

    def leave(self) -> None:
        """Go on with the run. What was done to nodes directly becomes one event."""
        recorder = self._domain.dispatcher.recorder
        if self._domain.entities.pending or (recorder is not None and recorder.outputs):
            self._world.run_outside("the outside", _OUTSIDE, lambda: None)

    def publish(self, topic: str, message: Any, qos: Any) -> int:
        """Publish a message now; return to how many subscriptions it goes.

        :raises RunError: if the topic has another type.
        """
        self.leave()
        dispatcher = self._domain.dispatcher
        message_type: Any = type(message)
        codec = codec_for(message_type)
        self._check_type(topic, codec.type_name)
        data = codec.serialize(message)
        publisher = self._publishers.get(topic)
        if publisher is None:
            self._world.run_outside(
                f"publishing {topic} from outside",
                _OUTSIDE,
                lambda: self._create_publisher(topic, message_type, qos),
            )
            publisher = self._publishers[topic]
        digest = hash64(data) if dispatcher.recorder is not None else 0
        dispatcher.execute(
            publisher,
            publisher.entity_id,
            publisher.node,
            _OUTSIDE,
            publisher.send,
            (data,),
            NO_EVENT,
            0,
            digest,
        )
        self.enter()
        return len(publisher.subscriptions)

    def _check_type(self, topic: str, type_name: str) -> None:
        graph = self._domain.graph
        endpoints: list[Any] = [*graph.publishers(topic), *graph.subscriptions(topic)]
        for endpoint in endpoints:
            if endpoint.type_name != type_name:
                raise RunError(f"{topic} carries {endpoint.type_name}, not {type_name}")

    def _create_publisher(self, topic: str, message_type: Any, qos: Any) -> None:
        if self._node is None:
            from rclpy.node import Node

            self._node = Node(
                NODE_NAME,
                start_parameter_services=False,
                enable_rosout=False,
                use_global_arguments=False,
            )
            self._world.keep(self._node)
        self._publishers[topic] = self._node.create_publisher(message_type, topic, qos).handle

    def call(self, function: Callable[[], Any]) -> Call:
        """Call ``function`` as one event and return how it went; it may be waiting by now."""
        self.leave()
        runners, event = self._world.runtime.runners, self._domain.event
        call = Call(function)
        name = f"{getattr(function, '__qualname__', 'a function')}, called from outside"

        def run() -> None:
            if call.run():
                event.flags |= _RAISED  # the caller gets the error, the run goes on

        def body() -> None:
            self._world.run_outside(name, _OUTSIDE, run)
            # Whoever switched here goes on: the caller, or the loop's runner after a wait.
            runners.step_aside()

        runners.waiting.append(getcurrent())
        greenlet(body).switch()
        self.enter()
        return call
