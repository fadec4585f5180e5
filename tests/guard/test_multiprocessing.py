"""Processes that a node starts and talks to: real ones, whose helper threads are simulated."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest

from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

MODULE = """
def square(x): return x * x
def answer(asked, answers):
    for _ in range(3): answers.put(asked.get(timeout=300) * 2)
def queues():
    asked, answers = multiprocessing.Queue(), multiprocessing.Queue()
    process = multiprocessing.Process(target=answer, args=(asked, answers))
    process.start()
    for number in range(3): asked.put(number)
    found = [answers.get(timeout=300) for _ in range(3)]
    process.join()
    return found, process.exitcode
def pool():
    with multiprocessing.Pool(2) as workers: return workers.map(square, range(5))
def executor():
    with ProcessPoolExecutor(2) as workers: return list(workers.map(square, range(5)))
def pipe():
    near, far = multiprocessing.Pipe()
    pid = os.fork()
    if pid == 0:
        far.send(time.sleep(0.01))
        os._exit(3)
    return near.recv(), os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
def locks():
    lock = threading.Condition()
    pid = os.fork()
    if pid == 0:
        told = []
        def work():
            for _ in range(100):
                with lock: told.append(0); lock.notify_all()
        for _ in range(2): threading.Thread(target=work).start()
        with lock: done = lock.wait_for(lambda: len(told) == 200, 30)
        os._exit(4 if done else 5)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
"""
EXPECTED: dict[str, Any] = {
    "queues": [[0, 2, 4], 0],
    "pool": [0, 1, 4, 9, 16],
    "executor": [0, 1, 4, 9, 16],
    "pipe": [None, 3],
    "locks": 4,
}


@pytest.mark.few(2)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # fork, where a library has threads
@pytest.mark.parametrize("what", EXPECTED)
@pytest.mark.parametrize("place", ["callback", "thread"])
def test_processes_work(said: Callable[..., list[Any]], what: str, place: str) -> None:
    if sys.version_info >= (3, 14):
        pytest.skip("processes are not forked by default any more")
    tell = f"self.say({what}())"
    tick = tell if place == "callback" else f"threading.Thread(target=lambda: {tell}).start()"
    code = node_code(
        f"self.timer.cancel()\n{tick}",
        imports="import multiprocessing, os, threading, time\n"
        "from concurrent.futures import ProcessPoolExecutor",
        module=MODULE,
        init="self.timer = self.create_timer(0.1, self.tick)",
    )
    job = "nodes: [{node: 'm:N'}]\nstart: 0"
    assert said(code.replace("self.create_timer(0.5, self.tick)", ""), job=job) == [
        [EXPECTED[what]]
    ]
