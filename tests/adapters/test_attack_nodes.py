"""Nodes that do strange things: none of it may break the run, or make it depend on anything."""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import UInt64

from rsltrace.errors import NodeError

pytestmark = pytest.mark.ros


class Ticker(Node):
    """Calls ``act`` every half second."""

    def __init__(self) -> None:
        super().__init__("ticker")
        self.publisher = self.create_publisher(UInt64, "ticks", 10)
        self.ticks = 0
        self.setup()
        self.create_timer(0.5, self.tick)

    def setup(self) -> None:
        pass

    def tick(self) -> None:
        self.ticks += 1
        self.publisher.publish(UInt64(data=self.ticks))
        self.act()

    def act(self) -> None:
        pass


class Unprintable(Exception):
    def __str__(self) -> str:
        raise ValueError("no text")


@pytest.mark.long
@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("a\ud800\udcff b"), "RuntimeError: a\\ud800\\udcff b"),
        (Unprintable(), "Unprintable: (its text could not be made)"),
    ],
)
def test_an_exception_may_say_anything(simulate: Any, error: Exception, said: str) -> None:
    class Raises(Ticker):
        def act(self) -> None:
            raise error

    with pytest.raises(NodeError, match=r"at simulated time 0\.5") as caught:
        simulate(Raises, duration=2)
    assert said in str(caught.value)
    str(caught.value).encode()
    caught.value.traceback_text.encode()


def test_two_hundred_callbacks_may_wait_at_once(simulate: Any) -> None:
    done: list[int] = []

    class Crowd(Ticker):
        def setup(self) -> None:
            group = ReentrantCallbackGroup()
            self.made = [
                self.create_timer(0.1, lambda i=i: self.wait(i), callback_group=group)
                for i in range(200)
            ]

        def wait(self, index: int) -> None:
            self.made[index].cancel()
            time.sleep(0.5 + index * 0.001)
            done.append(index)

    simulate(Crowd, duration=2)
    assert done == list(range(200))


def test_destroy_node_runs_to_its_end_although_it_sleeps(simulate: Any) -> None:
    class Tidy(Ticker):
        def destroy_node(self) -> None:
            time.sleep(1.0)
            self.publisher.publish(UInt64(data=99))
            self.get_logger().info("bye")
            super().destroy_node()

    recorded = simulate(Tidy, duration=1)
    assert recorded.logs() == ["bye"]
    assert recorded.kinds()[-1] == "shutdown"
    assert recorded.result.end_ns == 10**9


def test_a_destroy_node_that_waits_for_ever_ends(simulate: Any) -> None:
    class Endless(Ticker):
        def destroy_node(self) -> None:
            while True:
                time.sleep(0.1)

    assert simulate(Endless, duration=1).result.stop_reason.startswith("duration")


@pytest.mark.long
@pytest.mark.parametrize("group", [None, ReentrantCallbackGroup])
def test_who_swallows_the_end_of_the_run_is_left_behind(simulate: Any, group: Any) -> None:
    class Deaf(Ticker):
        def setup(self) -> None:
            made = None if group is None else group()
            self.create_timer(0.4, self.loop, callback_group=made)

        def loop(self) -> None:
            while True:
                try:
                    time.sleep(0.3)
                except BaseException:
                    self.ticks += 1

    digests = {simulate(Deaf, duration=1).result.digest for _ in range(2)}
    assert len(digests) == 1


def test_finalizers_and_stop_functions_that_sleep_make_no_events(simulate: Any) -> None:
    class Sleepy:
        def __init__(self) -> None:
            self.me = self  # only the collector finds it

        def __del__(self) -> None:
            time.sleep(0.0)

    class Leaves(Ticker):
        def act(self) -> None:
            Sleepy()

    def enough(progress: Any) -> bool:
        time.sleep(0.0)
        return bool(progress.now_ns >= 10**9)

    recorded = simulate(Leaves, function=enough)
    assert recorded.kinds() == ["construct", "timer", "timer", "shutdown"]


@pytest.mark.few(3)
@pytest.mark.parametrize(("status", "code"), [(4, 4), (None, 0), ("enough of it", 1)])
def test_a_stop_function_may_call_sys_exit(simulate: Any, status: Any, code: int) -> None:
    def enough(progress: Any) -> None:
        if progress.events > 2:
            sys.exit(status)

    recorded = simulate(Ticker, function=enough)
    assert recorded.result.exit_code == code
    if isinstance(status, str):
        assert status in recorded.result.stop_reason
    with recorded.trace() as trace:
        assert trace.complete


def test_the_text_of_sys_exit_is_told(simulate: Any) -> None:
    class NoHardware(Ticker):
        def setup(self) -> None:
            sys.exit("no hardware")

    result = simulate(NoHardware, duration=1).result
    assert result.stop_reason.endswith("raised SystemExit: no hardware")
    assert result.exit_code == 1


def _nap() -> None:
    time.sleep(0.01)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_worker_really_sleeps(simulate: Any) -> None:
    codes: list[Any] = []

    class Forks(Ticker):
        def act(self) -> None:
            worker = multiprocessing.get_context("fork").Process(target=_nap)
            worker.start()
            worker.join(20)
            codes.append(worker.exitcode)

    recorded = simulate(Forks, duration=3)
    assert len(codes) >= 2
    assert set(codes) == {0}
    # Its helpers may have to go on meanwhile, so the callback waits in simulated time.
    assert set(recorded.kinds()) == {"construct", "timer", "resume", "shutdown"}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_that_exits_does_not_go_on_with_the_run(simulate: Any) -> None:
    codes: list[int] = []
    here = os.getpid()

    class Forks(Ticker):
        def act(self) -> None:
            child = os.fork()
            if child == 0:
                sys.exit(7)
            codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))

    recorded = simulate(Forks, duration=1)
    if os.getpid() != here:  # what went wrong: two processes in this test
        os._exit(0)
    assert codes == [7, 7]
    with recorded.trace() as trace:
        assert trace.complete
        assert trace.event_count == 4


@pytest.mark.long
def test_a_cancelled_task_waits_for_nothing(simulate: Any) -> None:
    class Cancels(Node):
        def __init__(self) -> None:
            super().__init__("cancels")
            self.timer = self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.timer.cancel()
            self.executor.create_task(self.never, Future()).cancel()
            self.task = self.executor.create_task(self.never, Future())
            self.executor.create_task(self.stop)

        async def never(self, future: Any) -> None:
            await future

        def stop(self) -> None:
            self.task.cancel()

    assert simulate(Cancels).result.error is None


def test_a_timer_that_waits_for_its_group_may_lose_its_node(simulate: Any) -> None:
    class Leaves(Ticker):
        def setup(self) -> None:
            self.create_timer(0.1, lambda: time.sleep(0.6))
            self.create_timer(0.3, lambda: None)
            self.create_timer(
                0.35, lambda: self.executor.remove_node(self), callback_group=self.free
            )

        free = ReentrantCallbackGroup()

    assert simulate(Leaves, duration=2).result.error is None


def test_constructors_that_wait_are_unwound_when_another_one_fails(simulate: Any) -> None:
    log: list[str] = []

    class Waits(Node):
        def __init__(self) -> None:
            super().__init__("waits")
            try:
                time.sleep(5.0)
            finally:
                log.append("cleaned up")

    class Fails(Node):
        def __init__(self) -> None:
            super().__init__("fails")
            raise RuntimeError("no")

    with pytest.raises(NodeError, match="no"):
        simulate(Waits, Fails, duration=1)
    assert log == ["cleaned up"]


@pytest.mark.long
def test_a_module_that_keeps_sleep_sleeps_in_every_run(
    simulate: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "keeps_sleep_for_ever.py").write_text(
        "from time import sleep\n"
        "from rclpy.node import Node\n"
        "class Keeps(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('keeps')\n"
        "        sleep(0.25)\n"
        "        self.get_logger().info(str(self.get_clock().now().nanoseconds))\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    job = {"search_path": ()}
    for _ in range(2):
        recorded = simulate("keeps_sleep_for_ever:Keeps", duration=1, job=job)
        assert recorded.logs() == ["250000000"]
    module = sys.modules.pop("keeps_sleep_for_ever")
    began = time.monotonic()
    module.sleep(0.01)  # between runs it is the real one
    assert time.monotonic() - began >= 0.01


def test_a_run_with_blocked_calls_leaves_no_world_behind(simulate: Any) -> None:
    from rsltrace.adapters.rclpy.concurrency.runtime import Runtime

    class Waits(Ticker):
        def act(self) -> None:
            time.sleep(0.7)

    def worlds() -> int:
        gc.unfreeze()
        gc.collect()
        return sum(isinstance(thing, Runtime) for thing in gc.get_objects())

    before = worlds()  # of other tests, held by what they keep
    simulate(Waits, duration=2)
    assert worlds() == before


@pytest.mark.long
def test_a_closed_terminal_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rsltrace import Job, NodeSpec, StopSpec, record

    class Says(Ticker):
        def act(self) -> None:
            self.get_logger().info("tick")

    class Gone:
        def write(self, text: str) -> int:
            raise BrokenPipeError

    job = Job(nodes=[NodeSpec(node=Says)], stop=StopSpec(duration=1))
    quiet = record(job, tmp_path / "quiet.mcap")
    for stream in (Gone(), None):
        monkeypatch.setattr(sys, "stderr", stream)
        assert record(job, tmp_path / "run.mcap", force=True, echo=True).digest == quiet.digest


class Rude:
    """A callback that refuses to be looked at."""

    def __call__(self, message: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name in ("func", "__qualname__"):
            raise RuntimeError(name)
        raise AttributeError(name)


@pytest.mark.long
@pytest.mark.parametrize("callback", [MagicMock(), Rude()])
def test_a_callback_may_be_any_callable(simulate: Any, callback: Any) -> None:
    class Odd(Ticker):
        def setup(self) -> None:
            self.create_subscription(UInt64, "ticks", callback, 1)

    recorded = simulate(Odd, duration=1)
    with recorded.trace() as trace:
        details = [str(entity.detail) for entity in trace.entities.values()]
    assert any(type(callback).__qualname__ in detail for detail in details)


def test_a_finalizer_may_log_after_the_run(simulate: Any) -> None:
    heard: list[object] = []

    class Late(Ticker):
        def destroy_node(self) -> None:
            pass

        def __del__(self) -> None:
            try:
                self.get_logger().info("too late")
                self.publisher.publish(UInt64())
            except BaseException as error:
                heard.append(error)
            else:
                heard.append("fine")

    recorded = simulate(Late, duration=1)
    gc.collect()
    assert len(heard) == 1
    assert not any("cannot go on writing" in str(item) for item in heard)
    assert recorded.logs() == []
