"""Wait sets of user code, and ``wait_for_message``, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.wait_for_message import wait_for_message
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

pytestmark = pytest.mark.ros


class Counter(Node):
    def __init__(self) -> None:
        super().__init__("counter")
        self.publisher = self.create_publisher(UInt64, "count", 10)
        self.count = 0
        self.create_timer(1.0, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))


def seconds(node: Node) -> float:
    return float(node.get_clock().now().nanoseconds) / 1e9


def main_spec(function: Callable[[], None]) -> Any:
    from rsltrace import NodeSpec

    return NodeSpec(main=function)


def test_waiting_for_a_message_takes_simulated_time(simulate: Callable[..., Any]) -> None:
    seen: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("waiter")
        for topic, limit in (("count", -1), ("count", 5.0), ("nothing", 2.5), ("count", 0.0)):
            found, message = wait_for_message(UInt64, node, topic, time_to_wait=limit)
            seen.append((found, message.data if found else None, seconds(node)))
        seen.append(len(list(node.subscriptions)))

    simulate(Counter, main_spec(program), duration=10)
    assert seen == [(True, 1, 1.0), (True, 2, 2.0), (False, None, 4.5), (False, None, 4.5), 0]


def test_waiting_for_a_message_inside_a_callback(simulate: Callable[..., Any]) -> None:
    """The node's executor has the new subscription, too; who waits gets the message first."""
    seen: list[Any] = []

    class Waiter(Node):
        def __init__(self) -> None:
            super().__init__("waiter")
            self.once = self.create_timer(1.5, self.look)

        def look(self) -> None:
            self.once.cancel()
            found, message = wait_for_message(UInt64, self, "count", time_to_wait=5.0)
            seen.append((found, message.data, seconds(self)))

    simulate(Counter, Waiter, duration=4)
    assert seen == [(True, 2, 2.0)]


def test_a_message_that_never_comes_is_a_deadlock(simulate: Callable[..., Any]) -> None:
    from rsltrace.errors import DeadlockError

    def program() -> None:
        rclpy.init()
        wait_for_message(UInt64, Node("waiter"), "nothing")

    with pytest.raises(DeadlockError, match=r"a wait set of /waiter: subscription /nothing"):
        simulate(main_spec(program))


def test_a_wait_set_of_everything(simulate: Callable[..., Any]) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("all")
        real = rclpy_implementation
        subscription = node.create_subscription(UInt64, "count", lambda m: None, 10)
        client = node.create_client(Trigger, "there")
        service = node.create_service(Trigger, "here", lambda request, response: response)
        guard = node.create_guard_condition(lambda: None)
        timer = node.create_timer(0.25, lambda: None)
        wait_set = real.WaitSet(1, 1, 1, 1, 1, 0, node.context.handle)

        def look(limit_ns: int) -> list[str]:
            wait_set.clear_entities()
            kinds = {
                "subscription": wait_set.add_subscription(subscription.handle),
                "guard_condition": wait_set.add_guard_condition(guard.handle),
                "timer": wait_set.add_timer(timer.handle),
                "client": wait_set.add_client(client.handle),
                "service": wait_set.add_service(service.handle),
            }
            wait_set.wait(limit_ns)
            ready = [kind for kind, index in kinds.items() if wait_set.is_ready(kind, index)]
            assert ready == [kind for kind in kinds if wait_set.get_ready_entities(kind)]
            log.append((seconds(node), ready))
            return ready

        look(0)
        guard.trigger()
        look(-1)
        look(100_000_000)
        look(-1)
        timer.cancel()
        for _ in range(3):
            kinds = look(2_000_000_000)
            if "service" in kinds:
                _, header = service.handle.service_take_request(Trigger.Request)
                service.handle.service_send_response(Trigger.Response(), header.request_id)
            if "subscription" in kinds:
                subscription.handle.take_message(UInt64, False)
            if "service" in kinds:
                client.handle.send_request(Trigger.Request())
        assert client.handle.take_response(Trigger.Response)[1] is not None
        with pytest.raises(IndexError):
            wait_set.is_ready("timer", 1)

    class Other(Node):
        def __init__(self) -> None:
            super().__init__("other")
            self.create_service(Trigger, "there", lambda request, response: response)
            self.asker = self.create_client(Trigger, "here")
            self.once = self.create_timer(0.6, self.ask)

        def ask(self) -> None:
            self.once.cancel()
            self.asker.call_async(Trigger.Request())

    simulate(Counter, Other, main_spec(program), duration=10)
    assert log == [
        (0.0, []),
        (0.0, ["guard_condition"]),
        (0.1, []),
        (0.25, ["timer"]),
        (0.6, ["service"]),
        (0.6, ["client"]),
        (0.6, ["client"]),
    ]


class Both(Waitable):
    """A waitable of a user's own: ready when a message has come, or its timer is due."""

    def __init__(self, node: Node, log: list[Any]) -> None:
        super().__init__(MutuallyExclusiveCallbackGroup())
        self.node, self.log = node, log
        real = rclpy_implementation
        qos = QoSProfile(depth=10).get_c_qos_profile()
        self.subscription = real.Subscription(node.handle, UInt64, "count", qos)
        self.clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.timer = real.Timer(self.clock.handle, node.context.handle, 400_000_000, True)
        self.found: list[str] = []

    def add_to_wait_set(self, wait_set: Any) -> None:
        self.indices = (
            wait_set.add_subscription(self.subscription),
            wait_set.add_timer(self.timer),
        )

    def is_ready(self, wait_set: Any) -> bool:
        kinds = zip(("subscription", "timer"), self.indices, strict=True)
        self.found = [kind for kind, index in kinds if wait_set.is_ready(kind, index)]
        return bool(self.found)

    def take_data(self) -> list[Any]:
        taken: list[Any] = []
        if "subscription" in self.found:
            taken.append(self.subscription.take_message(UInt64, False)[0].data)
        if "timer" in self.found:
            self.timer.call_timer()
            taken.append("timer")
        return taken

    async def execute(self, taken: list[Any]) -> None:
        self.log.append((seconds(self.node), taken))

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(1, 0, 1, 0, 0)


EXPECTED = [(0.4, ["timer"]), (0.8, ["timer"]), (1.0, [1]), (1.2, ["timer"]), (1.6, ["timer"])]


def test_a_waitable_of_a_users_own(simulate: Callable[..., Any]) -> None:
    log: list[Any] = []

    class Owner(Node):
        def __init__(self) -> None:
            super().__init__("owner")
            self.both = Both(self, log)
            self.add_waitable(self.both)
            self.once = self.create_timer(1.7, self.stop)

        def stop(self) -> None:
            self.once.cancel()
            self.remove_waitable(self.both)

    run = simulate(Counter, Owner, duration=4)
    assert log == EXPECTED
    kinds = [event.kind.label for event in run.events() if event.cause_event != 2**64 - 1]
    assert "subscription" in kinds


def test_a_waitable_that_an_executor_of_ones_own_runs(simulate: Callable[..., Any]) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("owner")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        both = Both(node, log)
        node.add_waitable(both)  # the executor has the node already
        executor.spin_until_future_complete(Future(), timeout_sec=1.7)
        node.remove_waitable(both)
        executor.spin_until_future_complete(Future(), timeout_sec=1.7)

    simulate(Counter, main_spec(program), duration=4)
    assert log == EXPECTED


def test_an_executor_of_ones_own_runs_actions(simulate: Callable[..., Any]) -> None:
    """One that has nothing of rclpy's executors: it waits for an action as for a waitable."""
    seen: list[Any] = []

    def serve() -> None:
        rclpy.init()
        node = Node("server")

        def execute(goal: Any) -> Any:
            goal.publish_feedback(Fibonacci.Feedback(sequence=[goal.request.order]))
            goal.succeed()
            return Fibonacci.Result(sequence=[1, 2])

        ActionServer(node, Fibonacci, "fib", execute)
        rclpy.spin(node)

    def ask() -> None:
        rclpy.init()
        node = Node("asker")
        client = ActionClient(node, Fibonacci, "fib")
        goal = client.send_goal_async(
            Fibonacci.Goal(order=7), lambda said: seen.append(list(said.feedback.sequence))
        )
        _turn(node, client, goal.done)
        result = goal.result().get_result_async()
        _turn(node, client, result.done)
        seen.append((goal.result().accepted, list(result.result().result.sequence)))

    simulate(main_spec(serve), main_spec(ask), duration=10)
    assert seen == [[7], (True, [1, 2])]


def _turn(node: Node, waitable: Any, until: Callable[[], bool]) -> None:
    while not until():
        count = waitable.get_num_entities()
        wait_set = rclpy_implementation.WaitSet(
            count.num_subscriptions, 0, 0, count.num_clients, 0, 0, node.context.handle
        )
        wait_set.clear_entities()
        waitable.add_to_wait_set(wait_set)
        wait_set.wait(100_000_000)
        if waitable.is_ready(wait_set):
            run = waitable.execute(waitable.take_data())
            with pytest.raises(StopIteration):
                run.send(None)
