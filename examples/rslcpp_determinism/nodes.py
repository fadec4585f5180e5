"""RSLCPP's determinism network, as plain rclpy nodes.

Four nodes exchange messages and service calls at colliding rates. Every callback mixes its own
seed, the time and its input into a 64-bit state, so the states at the end depend on the order of
every single callback: one swap anywhere and the combined hash is another one. RSLCPP, the C++
simulator this network comes from, publishes what they have to be.

Nothing here knows that it is being recorded. The nodes only say their final state when they are
destroyed, so that it ends up in the log.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import UInt8, UInt64
from std_srvs.srv import Trigger

QOS = QoSProfile(depth=1)
COMBINED_START = 505510631

EXECUTED: list[int] = []
"""Seeds of the callbacks in the order they ran, of nodes made with ``keep_order=True``."""

NETWORK: list[MixingNode] = []
"""The nodes of the run in the order they were made: the monitor combines their states."""


def mix(h1: int, h2: int) -> int:
    """Return the 64-bit hash of two unsigned 64-bit integers (CityHash's pair, then splitmix64).

    Most of a callback's own time goes into this, hence the constants in place.
    """
    a = ((h1 ^ h2) * 0x9DDFEA08EB382D69) & 0xFFFFFFFFFFFFFFFF
    b = ((h2 ^ a ^ (a >> 47)) * 0x9DDFEA08EB382D69) & 0xFFFFFFFFFFFFFFFF
    x = ((b ^ (b >> 47)) * 0x9DDFEA08EB382D69 + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return x ^ (x >> 31)


class MixingNode(Node):
    """A node whose whole behaviour is one 64-bit state.

    ``keep_order`` appends the seed of each callback to :data:`EXECUTED`.
    """

    def __init__(self, name: str, state: int, *, keep_order: bool = False) -> None:
        super().__init__(name)
        self.state = state
        self._keep_order = keep_order
        self._destroyed = False
        NETWORK.append(self)

    def step(self, seed: int, value: int | None = None) -> int:
        """Mix ``seed``, the time and the callback's input into the state; return the new state."""
        if self._keep_order:
            EXECUTED.append(seed)
        state = mix(mix(self.state, seed), self.get_clock().now().nanoseconds)
        if value is not None:
            state = mix(state, value)
        self.state = state
        return state

    def destroy_node(self) -> None:
        """Log the final state, once, while the node can still log."""
        if not self._destroyed:
            self._destroyed = True
            self.get_logger().info(f"final state {self.state}")
        super().destroy_node()


class NodeA(MixingNode):
    """The source of /t1 and /t2. It is the first of a network, so it begins a new one."""

    def __init__(self, *, keep_order: bool = False) -> None:
        NETWORK.clear()
        EXECUTED.clear()
        super().__init__("node_a", 55272744, keep_order=keep_order)
        self._t1 = self.create_publisher(UInt64, "/t1", QOS)
        self._t2 = self.create_publisher(UInt64, "/t2", QOS)
        self.create_timer(0.1, self._on_slow_timer)
        self.create_timer(0.05, self._on_fast_timer)
        self.create_subscription(UInt64, "/t5", self._on_t5, QOS)

    def _on_slow_timer(self) -> None:
        self._t1.publish(UInt64(data=self.step(11162456753)))

    def _on_fast_timer(self) -> None:
        self._t2.publish(UInt64(data=self.step(11151784617)))

    def _on_t5(self, message: UInt64) -> None:
        self.step(22255799981, message.data)


class NodeB(MixingNode):
    """Turns /t2 into /t3, and feeds /t5 at a rate of its own."""

    def __init__(self, *, keep_order: bool = False) -> None:
        super().__init__("node_b", 34983402, keep_order=keep_order)
        self._t3 = self.create_publisher(UInt64, "/t3", QOS)
        self._t5 = self.create_publisher(UInt64, "/t5", QOS)
        self.create_subscription(UInt64, "/t2", self._on_t2, QOS)
        self.create_timer(0.04, self._on_timer)

    def _on_t2(self, message: UInt64) -> None:
        self._t3.publish(UInt64(data=self.step(22229447589, message.data)))

    def _on_timer(self) -> None:
        self._t5.publish(UInt64(data=self.step(11111071799)))


class NodeC(MixingNode):
    """Asks NodeD's service about each /t1, and turns /t3 into /t4."""

    def __init__(self, *, keep_order: bool = False) -> None:
        super().__init__("node_c", 87997653, keep_order=keep_order)
        self._t4 = self.create_publisher(UInt64, "/t4", QOS)
        self._s1 = self.create_client(Trigger, "/s1", qos_profile=QOS)
        self.create_subscription(UInt64, "/t1", self._on_t1, QOS)
        self.create_subscription(UInt64, "/t3", self._on_t3, QOS)

    def _on_t1(self, message: UInt64) -> None:
        self.step(22295316797, message.data)
        self._s1.call_async(Trigger.Request()).add_done_callback(self._on_response)

    def _on_response(self, future: Future) -> None:
        self.step(44442759714, int(future.result().message))

    def _on_t3(self, message: UInt64) -> None:
        self._t4.publish(UInt64(data=self.step(22227118361, message.data)))


class NodeD(MixingNode):
    """Closes the loop from /t4 to /t5, and serves /s1."""

    def __init__(self, *, keep_order: bool = False) -> None:
        super().__init__("node_d", 11380831, keep_order=keep_order)
        self._t5 = self.create_publisher(UInt64, "/t5", QOS)
        self.create_subscription(UInt64, "/t4", self._on_t4, QOS)
        self.create_service(Trigger, "/s1", self._on_s1, qos_profile=QOS)

    def _on_t4(self, message: UInt64) -> None:
        self._t5.publish(UInt64(data=self.step(2227672095, message.data)))

    def _on_s1(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = str(self.step(33396054244))
        return response


class Monitor(Node):
    """Ends the run: publishes an exit code once ``seconds`` have passed since its first tick."""

    def __init__(self, *, seconds: int = 100) -> None:
        super().__init__("monitor")
        self._length_ns = seconds * 1_000_000_000
        self._first_tick_ns: int | None = None
        self._done = False
        self._destroyed = False
        self._error_code = self.create_publisher(UInt8, "/rslcpp/error_code", QOS)
        self.create_timer(1.0, self._on_timer)

    def _on_timer(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        if self._first_tick_ns is None:
            self._first_tick_ns = now_ns
        if not self._done and now_ns - self._first_tick_ns >= self._length_ns:
            self._done = True
            self._error_code.publish(UInt8(data=0))

    def destroy_node(self) -> None:
        """Log the hash over the states of all nodes, once: it is the last to be destroyed."""
        if not self._destroyed:
            self._destroyed = True
            self.get_logger().info(f"combined hash {combined_hash()}")
        super().destroy_node()


def combined_hash() -> int:
    """Return the hash over the states of :data:`NETWORK` in the order the nodes were made."""
    combined = COMBINED_START
    for node in NETWORK:
        combined = mix(combined, node.state)
    return combined
