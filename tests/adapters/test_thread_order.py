"""Who runs first when a thread is started or woken: as in CPython, which runs the same program."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

from rsltrace import NodeSpec

pytestmark = pytest.mark.ros

TAKEN_AGAIN = ["parent", "parent again", "parent again", "child"]
MOST_OFTEN = {
    "lock_taken_again": [*TAKEN_AGAIN, *TAKEN_AGAIN],
    "start_after_waking_a_sleeper": ["child", "sleeper", "parent"],
    "start_in_a_thread_just_started": ["inner", "parent", "outer"],
    "lock_held_while_sleeping": ["holder 0", "holder 1", "child", "holder 2"],
}
"""What happens in most rounds natively (two processors, Python 3.11): the kernel decides."""

PROGRAM = Path(__file__).with_name("thread_order_program.py")


@pytest.fixture
def as_it_was() -> Iterator[None]:
    """What the program sets for its process it sets for this one, too, which has more to test."""
    interval, hook = sys.getswitchinterval(), threading.excepthook
    yield
    sys.setswitchinterval(interval)
    threading.excepthook = hook


def run_natively(rounds: int) -> Any:
    command = [sys.executable, PROGRAM, str(rounds)]
    text = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout
    return json.loads(text)


@pytest.mark.usefixtures("as_it_was")
def test_threads_take_turns_as_natively(simulate: Any, capfd: Any) -> None:
    simulate(NodeSpec(script=PROGRAM, arguments=["1"]))
    here, races = json.loads(capfd.readouterr().out)
    assert {name: order for name, (order,) in races.items()} == MOST_OFTEN
    assert len(here) == 22
    assert here["start"] == ["child", "parent"]
    assert here["start_new_thread"] == ["parent", "child"]
    left = dict(here)
    for _ in range(10):  # a machine that stands still for a moment lets sleeps go by
        natively, _ = run_natively(1)
        left = {name: order for name, order in left.items() if natively[name] != order}
        if not left:
            return
    pytest.fail(f"natively this is otherwise: {left}, for example {natively}")


@pytest.mark.native  # on a busy machine the kernel may decide otherwise for minutes
def test_what_the_kernel_decides_happens_natively() -> None:
    left = dict(MOST_OFTEN)
    for _ in range(30):
        _, rounds = run_natively(40)
        left = {name: order for name, order in left.items() if order not in rounds[name]}
        if not left:
            return
    pytest.fail(f"natively this does not happen: {left}")


def test_a_thread_that_is_started_in_a_callback(simulate: Any) -> None:
    log: list[Any] = []

    class Starts(Node):
        def __init__(self) -> None:
            super().__init__("starts")
            self.create_timer(1.0, self.tick)
            self.create_timer(1.0, lambda: log.append("other timer"))

        def tick(self) -> None:
            self.ready = False
            threading.Thread(target=self.work).start()
            assert self.ready
            log.append("callback")
            self.get_logger().info("callback")

        def work(self) -> None:
            self.ready = True
            log.append("thread")
            self.get_logger().info("thread")
            threading.Event().wait(0.5)
            log.append("thread later")

    recorded = simulate(Starts, duration=1.6)
    assert log == ["thread", "callback", "other timer", "thread later"]
    ticks = [e for e in recorded.events() if e.stamp_ns == 1_000_000_000]
    assert [e.kind.label for e in ticks] == ["timer", "task", "resume", "timer"]
    assert ticks[1].cause_event == ticks[0].index
    assert recorded.logs() == ["thread", "callback"]


@pytest.mark.long
def test_threads_that_start_each_other_for_ever_do_not_nest(simulate: Any) -> None:
    log: list[int] = []

    def program() -> None:
        def run(number: int) -> None:
            log.append(number)
            if number < 2000:
                next_one = threading.Thread(target=run, args=(number + 1,))
                next_one.start()
                next_one.join()

        def tick(left: int) -> None:
            if left:
                threading.Timer(0.01, tick, (left - 1,)).start()
            else:
                log.append(-1)

        tick(2000)
        run(0)

    simulate(NodeSpec(main=program))
    assert log == [*range(2001), -1]


def test_a_thread_that_is_started_under_asyncio_has_no_event_loop(simulate: Any) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()

        async def work() -> None:
            log.append("own loop")

        async def main() -> None:
            loop = asyncio.get_running_loop()
            thread = threading.Thread(target=lambda: asyncio.run(work()))
            thread.start()
            assert asyncio.get_running_loop() is loop
            log.append(await asyncio.to_thread(threading.current_thread))
            thread.join()

        asyncio.run(main())

    simulate(NodeSpec(main=program))
    assert log[0] == "own loop"
    assert log[1].name.startswith("asyncio")
