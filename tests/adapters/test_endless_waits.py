"""Callbacks that their own group holds back until the end are named, with what holds them."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
import rclpy
from click.testing import CliRunner
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from rsltrace.cli.main import cli
from rsltrace.trace.model.finding import decode_waits
from tests.adapters.test_mains import main_spec

pytestmark = pytest.mark.ros


class Robot(Node):
    """Calls its own service, from a callback of the group that the service is in."""

    def __init__(self, *, apart: bool = False) -> None:
        super().__init__("robot")
        group = MutuallyExclusiveCallbackGroup() if apart else None
        self.done = threading.Event()
        self.future: Any = Future()
        self.start = self.create_timer(1.0, self.begin)
        self.create_timer(1.0, self.watch)
        self.create_service(Trigger, "ask", self.answer, callback_group=group)
        self.create_timer(0.5, lambda: None, callback_group=ReentrantCallbackGroup())
        self.client = self.create_client(
            Trigger, "ask", callback_group=MutuallyExclusiveCallbackGroup()
        )

    def begin(self) -> None:
        self.start.cancel()
        self.client.call(Trigger.Request())

    def watch(self) -> None: ...

    def answer(self, request: Any, response: Any) -> Any:
        return response


class Waiting(Robot):
    def begin(self) -> None:
        self.done.wait()

    def watch(self) -> None:
        self.done.set()


class Awaiting(Robot):
    async def begin(self) -> None:
        self.start.cancel()
        await self.future

    def watch(self) -> None:
        self.future.set_result(None)


class Asleep(Robot):
    def begin(self) -> None:
        time.sleep(100.0)


def notes(recorded: Any) -> list[str]:
    return [note for note in recorded.result.notes if "held back" in note]


def test_a_service_that_is_called_from_its_own_group(simulate: Any) -> None:
    (note,) = notes(simulate(Robot, duration=10))
    assert note.startswith("held back for 9 s until the end")
    assert "/robot: timer Robot.watch (since 1.000000000 s)" in note
    assert "/robot: service /ask (since 1.000000000 s)" in note
    assert "/robot: timer Robot.begin waits for the response to a service call, of /ask" in note
    assert "callback group of its own" in note
    assert f"at {__file__}:" in note


def test_with_a_group_of_its_own_nothing_is_held_back(simulate: Any) -> None:
    assert notes(simulate(lambda: Robot(apart=True), duration=10)) == []


@pytest.mark.parametrize("kind", [Waiting, Awaiting])
def test_what_only_the_same_group_can_bring(simulate: Any, kind: Any) -> None:
    (note,) = notes(simulate(kind, duration=10))
    assert "/robot: timer" in note
    assert f"{kind.__name__}.watch (since 1.000000000 s)" in note
    assert f"{kind.__name__}.begin waits" in note
    assert f"{__file__}:" in note


def test_who_sleeps_will_wake_and_a_short_wait_may_be_over_soon(simulate: Any) -> None:
    assert notes(simulate(Asleep, duration=10)) == []
    assert notes(simulate(Waiting, duration=1.5)) == []


def test_in_an_executor_of_ones_own(simulate: Any) -> None:
    def main() -> None:
        rclpy.init()
        executor = MultiThreadedExecutor(4)
        executor.add_node(Robot())
        executor.spin()

    (note,) = notes(simulate(main_spec(main), duration=10))
    assert "Robot.watch" in note
    assert "/robot: service /ask" in note


class Other(Node):
    """Has nothing to do with the robot, but for the executor that they share."""

    def __init__(self) -> None:
        super().__init__("other")
        self.create_timer(2.0, self.tick)

    def tick(self) -> None: ...


SHARED = {"nodes": ["/robot", "/other"], "workers": 1}


class Ahead(Robot):
    """Waits for ever; what it waits for is in another group, and in the same executor."""

    def __init__(self) -> None:
        super().__init__(apart=True)


def test_an_executor_that_a_callback_keeps_busy(simulate: Any) -> None:
    class Beside(Node):
        def __init__(self) -> None:
            super().__init__("beside")
            self.create_timer(1.0, lambda: None)

    recorded = simulate(Ahead, Other, Beside, duration=10, job={"executors": [SHARED]})
    (note,) = notes(recorded)
    assert note.startswith("held back for 9 s until the end, by a callback that keeps their exec")
    assert "/robot: service /ask" in note
    assert "/other: timer Other.tick" in note
    assert "Beside" not in note
    with recorded.trace() as trace:
        (wait,) = decode_waits(trace.result)
        names = {trace.entities[one].name for one in wait.held}
    assert wait.since_ns == 1_000_000_000
    line = Robot.begin.__code__.co_firstlineno + 2
    assert wait.text.endswith(f"of /ask (1 server) at test_endless_waits.py:{line} in begin")
    assert names >= {"/ask", "Other.tick"}
    told = CliRunner().invoke(cli, ["info", str(recorded.path)]).output
    assert f"waiting    since 1.000000000 s: {wait.text}" in told
    assert "/robot: timer Robot.begin waits for the response to a service call, of /ask" in note
    assert notes(simulate(Ahead, Other, Beside, duration=10)) == []


@pytest.mark.parametrize("policy", ["fifo", "rclpy", "permutation"])
def test_a_main_that_waits_for_ever_is_told(simulate: Any, policy: str) -> None:
    def main() -> None:
        rclpy.init()
        threading.Event().wait()

    class Beside(Node):
        def __init__(self) -> None:
            super().__init__("beside")
            self.create_timer(1.0, lambda: None)

    recorded = simulate(main_spec(main), Beside, duration=10, job={"policy": policy})
    (note,) = (note for note in recorded.result.notes if note.startswith("waited for 10 s until"))
    assert f"at {__file__}:" in note


def test_a_call_that_keeps_nobody_waiting_is_told_alone(simulate: Any) -> None:
    class Alone(Robot):
        def __init__(self) -> None:
            super().__init__(apart=True)
            self.destroy_timer(self.start)
            alone = MutuallyExclusiveCallbackGroup()
            self.start = self.create_timer(1.0, self.begin, callback_group=alone)

        def begin(self) -> None:
            self.start.cancel()
            self.done.wait()

    recorded = simulate(Alone, duration=10)
    assert notes(recorded) == []
    (note,) = (note for note in recorded.result.notes if note.startswith("waited for 9 s until"))
    assert "Alone.begin waits" in note
    assert f"at {__file__}:" in note
