"""Callbacks that run on a stack in ``rclpy.spin`` at once: nothing of a run may change by it."""

from __future__ import annotations

import decimal
import random
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace import NodeSpec
from rsltrace.adapters.rclpy.executors import executor_driver as driver
from rsltrace.adapters.rclpy.executors.standby import Standby
from rsltrace.errors import LivelockError

pytestmark = pytest.mark.ros


class Restless(Node):
    """Does something else in each callback, as its own generator of numbers says."""

    def __init__(self, seed: int, log: list[Any], tame: bool) -> None:
        super().__init__(f"restless_{seed}")
        self.chance = random.Random(seed)
        self.log = log
        self.done = Future()
        self.seen = 0
        self.several = ReentrantCallbackGroup()
        self.one = MutuallyExclusiveCallbackGroup()
        self.lock = threading.RLock()
        self.out = self.create_publisher(UInt64, "numbers", 10)
        self.client = self.create_client(Trigger, "help", callback_group=self.several)
        self.guard = self.create_guard_condition(lambda: self.do("guard"))
        self.create_subscription(UInt64, "numbers", lambda m: self.do(m.data), 10)
        self.create_service(Trigger, "help", self.help, callback_group=self.one)
        self.create_timer(0.01 * (1 + seed % 3), lambda: self.do("tick"))
        self.create_timer(0.05, self.wander, callback_group=self.several)
        self.tame = tame

    def help(self, request: Any, response: Any) -> Any:
        self.note("help")
        if not self.chance.randrange(3):
            time.sleep(0.004)
        return response

    async def wander(self) -> None:
        self.note("async")
        await self.client.call_async(Trigger.Request())
        self.note("answered")

    def note(self, what: Any) -> None:
        thread = threading.current_thread().name
        precision = decimal.getcontext().prec
        now = self.get_clock().now().nanoseconds
        self.log.append((self.get_name(), what, now, thread, precision, tuple(sys.argv)))

    def do(self, why: Any) -> None:
        self.seen += 1
        with self.lock:
            self.note(why)
        choices: list[Callable[[], Any]] = [
            lambda: self.out.publish(UInt64(data=self.seen)) if self.seen < 400 else None,
            lambda: None,
            lambda: self.client.call_async(Trigger.Request()),
        ]
        if not self.tame:
            choices += [
                lambda: time.sleep(0.003),
                lambda: self.executor.create_task(self.note, "task"),
                self.guard.trigger,
                self.add,
                self.fail,
                lambda: threading.Thread(target=self.note, args=("thread",)).start(),
                lambda: self.executor.wake(),
                lambda: setattr(decimal.getcontext(), "prec", self.chance.randrange(5, 30)),
                lambda: self.seen > 60 and self.done.set_result(None),
                lambda: self.seen > 90 and rclpy.try_shutdown(),
                lambda: rclpy.timer.Timer(None, None, 1_000_000, self.get_clock()),
            ]
        self.chance.choice(choices)()

    def add(self) -> None:
        timer = self.create_timer(0.007, lambda: (timer.cancel(), self.note("once")))

    def fail(self) -> None:
        raise ValueError(self.seen)


def program(seed: int, log: list[Any], tame: bool) -> Callable[[], None]:
    """Return a main that spins in one of the ways there are."""

    def ways(node: Restless) -> None:
        way = 0 if tame else seed % 6
        if way == 0:
            rclpy.spin(node)
        elif way == 1:
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            executor.spin()
        elif way == 2:
            limit = None if seed % 4 else 0.3
            rclpy.spin_until_future_complete(node, node.done, timeout_sec=limit)
        elif way == 3:
            turns = (None, 0.02, 0.0, 0.005)
            while rclpy.ok():
                rclpy.spin_once(node, timeout_sec=node.chance.choice(turns))
                if not node.chance.randrange(4):
                    node.note("between")
                    node.out.publish(UInt64(data=1000))
        elif way == 4:
            with node.lock:
                rclpy.spin(node)
        else:
            several = MultiThreadedExecutor(2)
            several.add_node(node)
            thread = threading.Thread(target=lambda: spin_on(several, log), daemon=True)
            thread.start()
            thread.join(0.5)

    def main() -> None:
        decimal.getcontext().prec = 40 + seed % 7
        sys.argv = [f"main {seed}"]
        rclpy.init()
        node = Restless(seed, log, tame)
        for _ in range(20):
            try:
                ways(node)
                break
            except ValueError as error:
                log.append((node.get_name(), "caught", str(error)))
            except (KeyboardInterrupt, ExternalShutdownException) as error:
                log.append((node.get_name(), type(error).__name__))
                break

    return main


def spin_on(executor: Any, log: list[Any]) -> None:
    while True:
        try:
            executor.spin()
            return
        except ValueError as error:
            log.append(("thread caught", str(error)))


class Steady(Node):
    """A node of the job's own between the mains."""

    def __init__(self, log: list[Any]) -> None:
        super().__init__("steady")
        self.log = log
        self.create_subscription(UInt64, "numbers", self.hear, 10)

    def hear(self, message: UInt64) -> None:
        name = threading.current_thread().name
        self.log.append(("steady", message.data, name, decimal.getcontext().prec, sys.argv[:1]))


def run(simulate: Any, seed: int, *, tame: bool, job: Any) -> tuple[Any, ...]:
    log: list[Any] = []

    def steady() -> Node:
        return Steady(log)

    specs = [NodeSpec(main=program(seed + at, log, tame), name=f"m{at}") for at in range(2)]
    try:
        result = simulate(*specs, steady, duration=1, job={"seed": seed, **job}).result
    except Exception as error:
        return type(error), str(error), log
    return result.digest, result.events, result.notes, log


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count what ran at once."""
    count = [0]
    runs, following = Standby.runs, Standby._following

    def counted(self: Standby, *what: Any) -> bool:
        ran = runs(self, *what)
        count[0] += ran
        return ran

    def counted_following(self: Standby) -> Any:
        found = following(self)
        count[0] += found is not None
        return found

    monkeypatch.setattr(Standby, "runs", counted)
    monkeypatch.setattr(Standby, "_following", counted_following)
    return count


def compare(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, seed: int, *, tame: bool, **job: Any
) -> int:
    """Run the same with and without standing by; return how much was logged."""
    at_once = run(simulate, seed, tame=tame, job=job)
    with monkeypatch.context() as patch:
        patch.setattr(driver, "standby_of", lambda *_, **__: None)
        usual = run(simulate, seed, tame=tame, job=job)
    assert at_once == usual
    return len(at_once[-1])


def test_a_main_that_only_spins_runs_everything_at_once(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, served: list[int]
) -> None:
    logged = compare(simulate, monkeypatch, 0, tame=True)
    assert served[0] > 200, f"{served} of {logged}"


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [2, 3, 6, 12])
def test_whatever_callbacks_do_the_run_is_the_same(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    assert compare(simulate, monkeypatch, seed, tame=False) > 100


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_it_is_the_same_with_delays(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, served: list[int], seed: int
) -> None:
    delay = {"default": {"uniform": {"min": "0us", "max": "2ms"}}}
    logged = compare(simulate, monkeypatch, seed, tame=seed == 0, delay=delay)
    assert logged > 50
    assert served[0] > 20, f"{served} of {logged}"


def test_mains_that_keep_each_other_going_are_stopped_where_they_ever_were(
    simulate: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However one hands over to the other, the loop counts what happens at one instant."""
    limit, heard = 500, [0]

    def main(own: str, other: str) -> Callable[[], None]:
        def program() -> None:
            rclpy.init()
            node = Node(f"to_{other}")
            out = node.create_publisher(UInt64, other, 10)

            def hear(message: UInt64) -> None:
                heard[0] += 1
                assert heard[0] < 20 * limit, "nobody counts"
                out.publish(message)

            node.create_subscription(UInt64, own, hear, 10)
            first = node.create_timer(0.1, lambda: (first.cancel(), out.publish(UInt64())))
            rclpy.spin(node)

        return program

    def stopped() -> tuple[str, int]:
        heard[0] = 0
        mains = (NodeSpec(main=main("a", "b"), name="m0"), NodeSpec(main=main("b", "a"), name="m1"))
        with pytest.raises(LivelockError) as caught:
            simulate(*mains, duration=1, job={"livelock_limit": limit})
        return str(caught.value), heard[0]

    at_once = stopped()
    monkeypatch.setattr(Standby, "_following", lambda self: None)
    assert stopped() == at_once


@pytest.mark.long
@pytest.mark.parametrize("seed", range(100, 160))
def test_many_runs_are_the_same(simulate: Any, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    compare(simulate, monkeypatch, seed, tame=False)
