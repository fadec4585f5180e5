"""Calls that block: simulated time passes, others run, and what can never come is named."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import SetBool, Trigger

import rsltrace
from rsltrace.adapters.rclpy.concurrency import blocking_calls as simulated_waiting
from rsltrace.errors import DeadlockError, NodeError
from rsltrace.run import run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros


class Server(Node):
    def __init__(self) -> None:
        super().__init__("server")
        self.create_service(Trigger, "ask", self.answer)

    def answer(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = f"at {seconds(self)}"
        return response


def seconds(node: Node) -> float:
    return float(node.get_clock().now().nanoseconds) / 1e9


@contextmanager
def no_real_sleep() -> Iterator[None]:
    """Fail if anything sleeps in real time. (What waits for a real lock here never returns.)"""
    with mock.patch.object(
        simulated_waiting, "_real_sleep", side_effect=AssertionError("a real sleep")
    ):
        yield


def test_modules_that_come_with_a_star_import_of_rclpy_are_whole(
    simulate: Callable[..., Any],
) -> None:
    """``from rclpy.executors import *`` also brings rclpy's ``os`` and ``time``."""
    log: list[Any] = []

    def node() -> Node:
        names: dict[str, Any] = {}
        exec("from rclpy.node import *; from rclpy.executors import *", names)
        exec("from rclpy.client import *; from rclpy.timer import *", names)
        node = Node("star")
        names["time"].sleep(0.25)
        names["threading"].Thread(
            target=lambda: log.append(names["os"].path.join("a", "b"))
        ).start()
        log.append((seconds(node), names["time"].monotonic()))
        return node

    simulate(node, duration=1)
    assert log == ["a/b", (0.25, 0.25)]


@pytest.mark.long
def test_a_constructor_may_wait_for_a_server_that_is_made_later(simulate: Any) -> None:
    log: list[Any] = []

    class Asker(Node):
        """The client of the ROS 2 tutorials."""

        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(Trigger, "ask")
            while not self.client.wait_for_service(timeout_sec=1.0):
                log.append("not yet")
            log.append(("ready", seconds(self)))
            future = self.client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(self, future)
            log.append(future.result().message)
            self.create_timer(1.0, lambda: log.append(("tick", seconds(self))))

    recorded = simulate(Asker, Server, duration=2)
    assert log == [("ready", 0.25), "at 0.25", ("tick", 1.25)]
    kinds = [kind for kind in recorded.kinds() if kind != "shutdown"]
    assert kinds == ["construct", "construct", "resume", "service", "client", "resume", "timer"]


@pytest.mark.long
def test_waiting_for_a_service_times_out_in_simulated_time(simulate: Any) -> None:
    log: list[Any] = []

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            client = self.create_client(Trigger, "nobody")
            log.append((client.wait_for_service(timeout_sec=10.0), seconds(self)))
            log.append((self.wait_for_node("/nobody", 5.0), seconds(self)))

    with no_real_sleep():
        simulate(Asker)
    assert log == [(False, 10.0), (False, pytest.approx(15.0))]


@pytest.mark.long
def test_blocking_service_calls_inside_callbacks_two_deep(simulate: Any) -> None:
    log: list[Any] = []

    class Middle(Node):
        def __init__(self) -> None:
            super().__init__("middle")
            group = MutuallyExclusiveCallbackGroup()
            self.client = self.create_client(Trigger, "ask", callback_group=group)
            self.create_service(SetBool, "relay", self.relay)

        def relay(self, request: Any, response: Any) -> Any:
            time.sleep(0.1)
            response.message = "relayed " + self.client.call(Trigger.Request()).message
            return response

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(
                SetBool, "relay", callback_group=MutuallyExclusiveCallbackGroup()
            )
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            log.append((seconds(self), self.client.call(SetBool.Request()).message, seconds(self)))

    first = simulate(Server, Middle, Asker, duration=2.5)
    assert log == [(1.0, "relayed at 1.1", 1.1), (2.0, "relayed at 2.1", 2.1)]
    second = simulate(Server, Middle, Asker, duration=2.5)
    assert first.result.digest == second.result.digest


def test_a_blocking_call_whose_answer_cannot_get_in_is_explained(simulate: Any) -> None:
    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(Trigger, "ask")  # of the timer's own group
            self.timer = self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            self.timer.cancel()
            self.client.call(Trigger.Request())

    with pytest.raises(DeadlockError) as error, no_real_sleep():
        simulate(Server, Asker)
    for word in ("/asker: timer", "the response to a service call", "callback group", __file__):
        assert word in str(error.value)


def test_two_callbacks_that_wait_for_each_other_are_both_named(simulate: Any) -> None:
    class Half(Node):
        def __init__(self, name: str, own: str, other: str) -> None:
            super().__init__(name)
            self.create_service(Trigger, own, self.serve)
            group = MutuallyExclusiveCallbackGroup()
            self.client = self.create_client(Trigger, other, callback_group=group)
            if name == "left":
                self.timer = self.create_timer(1.0, self.start)

        def start(self) -> None:
            self.timer.cancel()
            self.client.call(Trigger.Request())

        def serve(self, request: Any, response: Any) -> Any:
            return self.client.call(Trigger.Request())

    def both() -> list[Node]:
        return [Half("left", "l", "r"), Half("right", "r", "l")]

    with pytest.raises(DeadlockError) as error:
        simulate(both)
    assert "/left: timer" in str(error.value)
    assert "/right: service /r" in str(error.value)


def test_sleeping_lets_others_run_and_keeps_the_group_busy(simulate: Any) -> None:
    log: list[Any] = []

    class Sleeper(Node):
        def __init__(self, method: str) -> None:
            super().__init__("sleeper")
            self.method = method
            self.create_timer(1.0, self.work)
            self.create_timer(0.4, lambda: log.append(("same", seconds(self))))
            own = MutuallyExclusiveCallbackGroup()
            self.create_timer(0.4, lambda: log.append(("other", seconds(self))), callback_group=own)
            self.rate = self.create_rate(1 / 1.5)

        def work(self) -> None:
            log.append(("begin", seconds(self)))
            if self.method == "time":
                time.sleep(0.5)
            elif self.method == "clock":
                assert self.get_clock().sleep_for(Duration(seconds=0.5))
            else:
                self.rate.sleep()  # its first period ends at 1.5 s
            log.append(("end", seconds(self)))

    for method in ("time", "clock", "rate"):
        log.clear()
        simulate(lambda method=method: Sleeper(method), duration=1.7)
        assert log == [
            ("same", 0.4),
            ("other", 0.4),
            ("same", 0.8),
            ("other", 0.8),
            ("begin", 1.0),
            ("other", 1.2),
            ("end", 1.5),
            ("same", 1.5),  # overdue since 1.2
            ("same", 1.6),
            ("other", 1.6),
        ], method


@pytest.mark.long
def test_what_a_woken_callback_does_is_caused_by_who_woke_it(simulate: Any) -> None:
    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            group = ReentrantCallbackGroup()
            self.client = self.create_client(Trigger, "ask", callback_group=group)
            self.publisher = self.create_publisher(UInt64, "n", 1)
            self.create_timer(1.0, self.tick, callback_group=group)

        def tick(self) -> None:
            self.client.call(Trigger.Request())
            self.publisher.publish(UInt64())

    events = {event.kind.label: event for event in simulate(Server, Asker, duration=1).events()}
    timer, client, resume = events["timer"], events["client"], events["resume"]
    assert int(timer.flags) == 2
    assert resume.entity == timer.entity
    assert resume.cause_event == client.index
    assert resume.input_hash == client.input_hash


@pytest.mark.long
def test_exceptions_after_a_wait_are_the_callbacks_own(simulate: Any) -> None:
    class Faulty(Node):
        def __init__(self) -> None:
            super().__init__("faulty")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            time.sleep(0.5)
            raise ValueError("late")

    with pytest.raises(NodeError, match=r"/faulty: timer .*1\.500000000 s raised ValueError: late"):
        simulate(Faulty)


@pytest.mark.long
def test_whoever_is_blocked_at_the_end_is_unwound(simulate: Any) -> None:
    log: list[str] = []

    class Waiting(Node):
        def __init__(self, name: str) -> None:
            super().__init__(name)
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            try:
                log.append(f"{self.get_name()} sleeps")
                time.sleep(100.0)
                log.append("never")
            finally:
                log.append(f"{self.get_name()} cleans up")
                self.get_logger().info("cleaned up")

    def three() -> list[Node]:
        return [Waiting(name) for name in "abc"]

    recorded = simulate(three, duration=2)
    names = ("a", "b", "c")
    assert log == [f"{n} sleeps" for n in names] + [f"{n} cleans up" for n in names]
    assert recorded.logs() == ["cleaned up"] * 3


def test_spin_once_in_a_constructor_lets_others_run(simulate: Any) -> None:
    log: list[Any] = []

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            client = self.create_client(Trigger, "ask")
            client.wait_for_service()
            future = client.call_async(Trigger.Request())
            while rclpy.ok() and not future.done():
                rclpy.spin_once(self, timeout_sec=0.1)
            log.append(future.result().message)

    simulate(Server, Asker, duration=5)
    assert log == ["at 0.0"]


def test_an_executor_of_ones_own_in_a_callback_waits_for_its_own_callback_group(
    simulate: Any,
) -> None:
    from rclpy.executors import SingleThreadedExecutor

    class Spinner(Node):
        def __init__(self) -> None:
            super().__init__("spinner")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            executor = SingleThreadedExecutor()
            executor.add_node(self)
            executor.spin_once()

    with pytest.raises(DeadlockError, match=r"/spinner: timer .*waits for work for its executor"):
        simulate(Spinner)


def test_sleep_is_real_again_after_a_run(simulate: Any) -> None:
    real = time.sleep
    simulate(Server, duration=1)
    assert time.sleep is real


@pytest.mark.long
@pytest.mark.parametrize("policy", [{}, {"policy": {"order": "permutation"}}])
def test_a_callback_that_polls_a_clock_for_long_is_no_livelock(simulate: Any, policy: Any) -> None:
    class Poller(Node):
        def __init__(self) -> None:
            super().__init__("poller")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            until = time.monotonic() + 0.05
            while time.monotonic() < until:
                pass
            self.get_logger().info(f"{seconds(self):.3f}")

    recorded = simulate(Poller, duration=2.5, job={"livelock_limit": 300, **policy})
    assert len(recorded.events()) > 600
    assert recorded.logs() == ["1.050", "2.050"]


def test_the_timer_of_a_rate_is_named_after_it(tmp_path: Path) -> None:
    """As natively; the line of code is not of the event that stands in for rclpy's."""
    (tmp_path / "rated.py").write_text(
        "from rclpy.node import Node\n\n\ndef make():\n"
        "    node = Node('rated')\n    node.rate = node.create_rate(5.0)\n    return node\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: rated:make}]\nstop: {duration: 1s}\n")
    run(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        (timer,) = [one for one in trace.entities.values() if one.kind is EntityKind.TIMER]
    assert (timer.name, timer.source) == ("Rate", "")
