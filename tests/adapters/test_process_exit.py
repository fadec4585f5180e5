"""``os._exit`` and the like end a node's process, not ours: the trace is whole and says who."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.node import Node

import rsltrace
from rsltrace.errors import UnsupportedError
from tests.adapters.test_mains import main_spec

pytestmark = pytest.mark.ros

ENDS: list[tuple[Callable[[], None], int, str]] = [
    (lambda: os._exit(7), 7, "os._exit(7)"),
    (lambda: os.abort(), 134, "os.abort()"),
    (lambda: os.kill(os.getpid(), signal.SIGKILL), 137, "SIGKILL"),
]


def dying(log: list[str], end: Callable[[], None]) -> Node:
    node = Node("dying")

    def tick() -> None:
        log.append(f"tick at {node.get_clock().now().nanoseconds / 1e9}")
        if len(log) == 3:
            try:
                end()
            finally:
                log.append("finally")

    node.create_timer(0.5, tick)
    return node


class Quiet(Node):
    def __init__(self) -> None:
        super().__init__("quiet")
        self.create_timer(0.5, lambda: None)


@pytest.mark.parametrize("guard", [True, False])
@pytest.mark.parametrize(("end", "status", "call"), ENDS)
def test_a_node_of_the_job_that_ends_its_process_ends_the_run(
    simulate: Any, end: Callable[[], None], status: int, call: str, guard: bool
) -> None:
    log: list[str] = []
    recorded = simulate(lambda: dying(log, end), Quiet, duration=5, job={"guard": guard})
    assert log == ["tick at 0.5", "tick at 1.0", "tick at 1.5"], "no finally block runs"
    assert recorded.result.exit_code == status
    assert recorded.result.end_ns == 1_500_000_000
    assert "/dying: timer" in recorded.result.stop_reason
    assert call in recorded.result.stop_reason
    with recorded.trace() as trace:
        assert trace.complete
        last = trace.event(trace.ended_after - 1)
        assert last.kind.label == "timer"
        assert "shutdown" in [output.kind.label for output in trace.outputs_of(last.index)]
    first = recorded.result.digest
    log.clear()
    again = simulate(lambda: dying(log, end), Quiet, duration=5, job={"guard": guard})
    assert again.result.digest == first


def test_a_main_that_ends_its_process_ends_itself_alone_with_its_threads(simulate: Any) -> None:
    log: list[str] = []

    def main() -> None:
        rclpy.init()
        node = Node("main_node")
        node.create_timer(0.5, lambda: log.append("tick"))

        def work() -> None:
            time.sleep(1.2)
            os._exit(9)

        threading.Thread(target=work).start()
        try:
            rclpy.spin(node)
        finally:
            log.append("finally")

    recorded = simulate(main_spec(main), Quiet, duration=3)
    assert log == ["tick", "tick"]
    assert recorded.result.exit_code == 9
    assert recorded.result.end_ns == 3_000_000_000, "the others go on"
    assert any("os._exit(9)" in note for note in recorded.result.notes)
    assert any("exited with 9 at 1.2" in note for note in recorded.result.notes)


def test_the_last_main_ends_the_run_so(simulate: Any) -> None:
    def main() -> None:
        rclpy.init()
        os._exit(0)

    assert simulate(main_spec(main)).result.stop_reason == "every main has ended"


def test_a_constructor_may_do_it(simulate: Any) -> None:
    class Hopeless(Node):
        def __init__(self) -> None:
            super().__init__("hopeless")
            os._exit(4)

    result = simulate(Hopeless, Quiet, duration=1).result
    assert (result.exit_code, result.events) == (4, 1)


def test_a_forked_child_really_exits(simulate: Any) -> None:
    statuses: list[int] = []

    class Forking(Node):
        def __init__(self) -> None:
            super().__init__("forking")
            child = os.fork()
            if child == 0:
                os._exit(5)
            statuses.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
            child = os.fork()
            if child == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            statuses.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))

    simulate(Forking, duration=1)
    assert statuses == [5, -signal.SIGKILL]


def test_after_the_run_python_ends_as_ever(simulate: Any) -> None:
    before = os._exit, os.kill
    simulate(Quiet, duration=1)
    assert (os._exit, os.kill) == before
    done = subprocess.run([sys.executable, "-c", "import os; os._exit(3)"], check=False)
    assert done.returncode == 3
    child = os.fork()
    if child == 0:
        os._exit(6)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 6


def test_no_other_program_takes_the_place_of_the_run(simulate: Any) -> None:
    class Changeling(Node):
        def __init__(self) -> None:
            super().__init__("changeling")
            os.execv(sys.executable, [sys.executable, "-c", ""])

    with pytest.raises(UnsupportedError, match="subprocess"):
        simulate(Changeling, duration=1)


@pytest.mark.long
def test_a_crash_prints_the_line_and_the_file_says_that_it_was_cut_off(tmp_path: Path) -> None:
    (tmp_path / "crash_node.py").write_text(
        "import ctypes\n"
        "from rclpy.node import Node\n"
        "class Crash(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('crash')\n"
        "        self.count = 0\n"
        "        self.create_timer(1.0, self.tick)\n"
        "    def tick(self):\n"
        "        self.count += 1\n"
        "        if self.count == 3:\n"
        "            ctypes.string_at(0)\n"
    )
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'crash_node:Crash'}]\nstop: {duration: 3s}\n"
    )

    def command(*words: str) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", "rsltrace", *words]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)

    done = command("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == -signal.SIGSEGV
    assert "Segmentation fault" in done.stderr
    assert 'crash_node.py", line 11 in tick' in done.stderr
    info = command("info", "run.mcap")
    assert info.returncode == 0
    assert "truncated: the run was killed" in info.stdout
    assert "--set record.segment_events=1" in info.stdout
    with rsltrace.Trace.open(tmp_path / "run.mcap") as trace:
        assert (trace.complete, trace.event_count) == (False, 0)
    again = command("record", "job.yaml", "-o", "all.mcap", "--set", "record.segment_events=1")
    assert again.returncode == -signal.SIGSEGV
    with rsltrace.Trace.open(tmp_path / "all.mcap") as trace:
        assert trace.event_count == 3, "construction and two ticks, up to the one that crashed"
