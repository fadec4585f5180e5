"""A synthetic robot of eight nodes, for measuring: many callbacks that each do almost nothing.

The shape is that of a small robot (sensors at 1 kHz down to 50 Hz, a filter, a controller, a
planner that asks a map, a watchdog), the content is none: each node holds one 64-bit xorshift*
state that every input is mixed into, so that a lost, repeated or reordered callback changes what
is published from then on.

    imu 1 kHz ───► filter ──► controller 100 Hz ──► watchdog 10 Hz
    wheels 500 Hz ─►  │ └───► planner 50 Hz ──► controller, watchdog
    camera 200 Hz ─► filter, map      └── service query ──► map

:func:`make_nodes` builds it as often as asked, each copy in a namespace of its own: 25 groups are
200 nodes.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

QOS = QoSProfile(depth=10)


def xorshift(state: int) -> int:
    """Return the next state of a 64-bit xorshift generator. ``state`` must not be 0."""
    state ^= state >> 12
    state ^= (state << 25) & 0xFFFFFFFFFFFFFFFF
    return state ^ (state >> 27)


def scramble(state: int) -> int:
    """Return the output of xorshift64* for ``state``: what a node publishes of it."""
    return (state * 0x2545F4914F6CDD1D) & 0xFFFFFFFFFFFFFFFF


class MixingNode(Node):
    """A node whose behaviour is its state. ``callbacks`` counts what it has run.

    ``period`` in seconds, if given, is that of all its timers, whatever rate they have by name.
    """

    def __init__(self, name: str, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__(name, namespace=namespace)
        self._period = period
        self.state = xorshift(xorshift(seed))
        self.callbacks = 0

    def step(self, value: int = 0) -> int:
        """Count a callback, mix ``value`` in, and return what may be shown of the new state."""
        self.callbacks += 1
        # A state of 0 would stay 0 for ever.
        self.state = xorshift((self.state ^ value) or 1)
        return scramble(self.state)

    def every(self, seconds: float, callback: object) -> None:
        """Make a timer of ``seconds``, or of the period that all timers have."""
        self.create_timer(self._period or seconds, callback)


class Sensor(MixingNode):
    """Publishes its state at a fixed rate."""

    def __init__(
        self, name: str, namespace: str, topic: str, rate: int, *, seed: int, period: float | None
    ) -> None:
        super().__init__(name, namespace, seed=seed, period=period)
        self._publisher = self.create_publisher(UInt64, topic, QOS)
        self.every(1 / rate, self._on_timer)

    def _on_timer(self) -> None:
        self._publisher.publish(UInt64(data=self.step()))


class Filter(MixingNode):
    """Takes every sensor in; answers each wheel message with a pose."""

    def __init__(self, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__("filter", namespace, seed=seed, period=period)
        self._pose = self.create_publisher(UInt64, "pose", QOS)
        self.create_subscription(UInt64, "imu", self._on_input, QOS)
        self.create_subscription(UInt64, "image", self._on_input, QOS)
        self.create_subscription(UInt64, "wheels", self._on_wheels, QOS)

    def _on_input(self, message: UInt64) -> None:
        self.step(message.data)

    def _on_wheels(self, message: UInt64) -> None:
        self._pose.publish(UInt64(data=self.step(message.data)))


class Map(MixingNode):
    """Takes images in and answers queries."""

    def __init__(self, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__("map", namespace, seed=seed, period=period)
        self.create_subscription(UInt64, "image", self._on_image, QOS)
        self.create_service(Trigger, "query", self._on_query)

    def _on_image(self, message: UInt64) -> None:
        self.step(message.data)

    def _on_query(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = str(self.step())
        return response


class Planner(MixingNode):
    """Asks the map at 50 Hz and publishes a plan with each answer; one query at a time."""

    def __init__(self, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__("planner", namespace, seed=seed, period=period)
        self._plan = self.create_publisher(UInt64, "plan", QOS)
        self._query = self.create_client(Trigger, "query")
        self._pending = False
        self.create_subscription(UInt64, "pose", self._on_pose, QOS)
        self.every(1 / 50, self._on_timer)

    def _on_pose(self, message: UInt64) -> None:
        self.step(message.data)

    def _on_timer(self) -> None:
        self.step()
        if not self._pending and self._query.service_is_ready():
            self._pending = True
            self._query.call_async(Trigger.Request()).add_done_callback(self._on_answer)

    def _on_answer(self, future: Future) -> None:
        self._pending = False
        self._plan.publish(UInt64(data=self.step(int(future.result().message))))


class Controller(MixingNode):
    """Follows pose and plan; commands at 100 Hz."""

    def __init__(self, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__("controller", namespace, seed=seed, period=period)
        self._command = self.create_publisher(UInt64, "command", QOS)
        self.create_subscription(UInt64, "pose", self._on_input, QOS)
        self.create_subscription(UInt64, "plan", self._on_input, QOS)
        self.every(1 / 100, self._on_timer)

    def _on_input(self, message: UInt64) -> None:
        self.step(message.data)

    def _on_timer(self) -> None:
        self._command.publish(UInt64(data=self.step()))


class Watchdog(MixingNode):
    """Watches commands and plans; publishes a digest of them at 10 Hz."""

    def __init__(self, namespace: str, *, seed: int, period: float | None) -> None:
        super().__init__("watchdog", namespace, seed=seed, period=period)
        self._health = self.create_publisher(UInt64, "health", QOS)
        self.create_subscription(UInt64, "command", self._on_input, QOS)
        self.create_subscription(UInt64, "plan", self._on_input, QOS)
        self.every(1 / 10, self._on_timer)

    def _on_input(self, message: UInt64) -> None:
        self.step(message.data)

    def _on_timer(self) -> None:
        self._health.publish(UInt64(data=self.step()))


def make_nodes(groups: int = 1, period: float | None = None, seed: int = 1) -> list[MixingNode]:
    """Return ``groups`` copies of the graph, eight nodes each, in namespaces /g0, /g1, ...

    ``period`` in seconds replaces the period of every timer: one that is too short for any
    executor saturates it, with the same mix of callbacks as any other. ``seed`` (1 or more) starts
    the states. Raises ValueError for values that make no sense.
    """
    if groups < 1 or seed < 1 or (period is not None and not period > 0):
        raise ValueError(
            f"groups and seed must be at least 1 and period above 0, "
            f"are {groups}, {seed} and {period}"
        )
    nodes: list[MixingNode] = []
    for group in range(groups):
        namespace = f"/g{group}"
        first = seed + 8 * group
        nodes += [
            Sensor("imu", namespace, "imu", 1000, seed=first, period=period),
            Sensor("wheels", namespace, "wheels", 500, seed=first + 1, period=period),
            Sensor("camera", namespace, "image", 200, seed=first + 2, period=period),
            Filter(namespace, seed=first + 3, period=period),
            Map(namespace, seed=first + 4, period=period),
            Planner(namespace, seed=first + 5, period=period),
            Controller(namespace, seed=first + 6, period=period),
            Watchdog(namespace, seed=first + 7, period=period),
        ]
    return nodes
