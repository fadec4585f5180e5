"""Functions of rclpy that user code replaces are called, or the run says that they are not."""

from __future__ import annotations

from functools import wraps
from typing import Any
from unittest import mock

import pytest
import rclpy
import rclpy.executors
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace.adapters.rclpy.executors import user_executors
from tests.adapters.test_mains import main_spec

pytestmark = pytest.mark.ros


class Busy(Node):
    """A timer whose callback makes the three others ready."""

    def __init__(self, done: list[str]) -> None:
        super().__init__("busy")
        self.done = done
        self.publisher = self.create_publisher(UInt64, "numbers", 10)
        self.create_subscription(UInt64, "numbers", self.heard, 10)
        self.create_service(Trigger, "ask", self.answer)
        self.client = self.create_client(Trigger, "ask")
        self.guard_condition = self.create_guard_condition(self.guarded)
        self.create_timer(1.0, self.tick)

    def tick(self) -> None:
        self.done.append("tick")
        self.publisher.publish(UInt64(data=1))
        self.client.call_async(Trigger.Request())
        self.guard_condition.trigger()

    def heard(self, _: UInt64) -> None:
        self.done.append("heard")

    async def guarded(self) -> None:
        self.done.append("guarded")

    def answer(self, _: Any, response: Any) -> Any:
        self.done.append("answer")
        return response


def told(recorded: Any) -> list[str]:
    return [note for note in recorded.result.notes if " called" in note]


ALL = {"tick", "heard", "answer", "guarded"}


@pytest.fixture
def monitored() -> Any:
    """A function that monitors callbacks as libraries do, and the names of those it has seen."""
    real = rclpy.executors.await_or_execute
    seen: list[str] = []

    @wraps(real)
    async def monitor(callback: Any, *args: Any) -> Any:
        seen.append(callback.__name__)
        return await real(callback, *args)

    return monitor, seen


def test_callbacks_run_through_what_replaces_await_or_execute(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, monitored: Any
) -> None:
    monitor, seen = monitored
    monkeypatch.setattr(rclpy.executors, "await_or_execute", monitor)
    done: list[str] = []
    recorded = simulate(lambda: Busy(done), duration=1.5)
    assert set(done) == ALL
    assert seen == done
    assert told(recorded) == []
    assert simulate(lambda: Busy([]), duration=1.5).result.digest == recorded.result.digest


def test_it_may_be_replaced_while_the_run_goes_on_and_put_back(
    simulate: Any, monitored: Any
) -> None:
    """Each time for the callbacks that follow, of entities whose callbacks have run before."""
    monitor, seen = monitored
    done: list[str] = []
    real = rclpy.executors.await_or_execute

    def program() -> None:
        rclpy.init()
        node = Busy(done)
        for replacement in (real, monitor, real):
            rclpy.executors.await_or_execute = replacement
            while done.count("tick") == len(counted):
                rclpy.spin_once(node)
            counted.append(replacement)
            for _ in range(8):
                rclpy.spin_once(node, timeout_sec=0.01)

    counted: list[Any] = []
    simulate(main_spec(program), duration=10.0)
    assert set(seen) == ALL
    assert len(seen) == 4
    assert len(done) == 12
    assert type(rclpy.executors).__name__ == "module"


def test_what_it_raises_comes_out_of_the_spin(simulate: Any, monitored: Any) -> None:
    caught: list[str] = []

    async def refuse(callback: Any, *args: Any) -> Any:
        raise RuntimeError(f"no {callback.__name__}")

    def program() -> None:
        rclpy.init()
        node = Busy([])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        with mock.patch("rclpy.executors.await_or_execute", refuse):
            try:
                executor.spin_once()
            except RuntimeError as error:
                caught.append(str(error))

    simulate(main_spec(program), duration=10.0)
    assert caught == ["no tick"]


def test_others_that_are_replaced_are_told(simulate: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Executor._take_timer

    @wraps(real)
    def take(self: Executor, timer: Any) -> Any:
        return real(self, timer)

    monkeypatch.setattr(Executor, "_take_timer", take)
    (note,) = told(simulate(lambda: Busy([]), duration=1.5))
    line = take.__code__.co_firstlineno
    assert note.startswith(
        f"tests/adapters/test_replaced_functions.py:{line}: Executor._take_timer"
    )
    assert "is never called" in note
    assert "await_or_execute" in note


def test_one_that_was_put_back_is_told_all_the_same(simulate: Any) -> None:
    def program() -> None:
        rclpy.init()
        with mock.patch.object(Executor, "_take_service"):
            rclpy.spin_once(Busy([]))

    (note,) = told(simulate(main_spec(program), duration=3.0))
    assert note.startswith("a MagicMock: Executor._take_service is never called")


def test_an_executor_that_overrides_one_is_told(simulate: Any) -> None:
    class Careful(SingleThreadedExecutor):
        def can_execute(self, entity: Any) -> bool:
            return False

    def program() -> None:
        rclpy.init()
        executor = Careful()
        executor.add_node(Busy([]))
        executor.spin_once()

    (note,) = told(simulate(main_spec(program), duration=3.0))
    assert "Careful.can_execute is never called" in note


def test_a_replaced_wait_is_told_where_nobody_spins(simulate: Any) -> None:
    """A node that the job constructs is run by the loop; who spins in a main asks the function."""
    asked: list[int] = []

    def replace() -> None:
        real = Executor.wait_for_ready_callbacks

        @wraps(real)
        def wait(self: Any, *args: Any, **kwargs: Any) -> Any:
            asked.append(1)
            return real(self, *args, **kwargs)

        Executor.wait_for_ready_callbacks = wait

    def made() -> Node:
        replace()
        return Busy([])

    def program() -> None:
        rclpy.init()
        replace()
        rclpy.spin_once(Busy([]))

    (note,) = told(simulate(made, duration=1.5))
    assert "Executor.wait_for_ready_callbacks is not called for nodes that the job" in note
    assert not asked
    assert told(simulate(main_spec(program), duration=1.5)) == []
    assert asked


def test_who_spins_a_node_again_and_again_looks_once(
    simulate: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``spin_once`` adds its node each time; to look takes longer than all the rest of it."""
    looks: list[Any] = []
    monkeypatch.setattr(user_executors, "note_replaced_functions", lambda *args: looks.append(args))

    def program() -> None:
        rclpy.init()
        node = Busy([])
        for _ in range(50):
            rclpy.spin_once(node, timeout_sec=0.1)

    simulate(main_spec(program), duration=10.0)
    assert len(looks) == 3  # the run's own executor, the global one, the node
