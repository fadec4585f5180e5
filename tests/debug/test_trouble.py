"""What goes wrong in a session is said, the session goes on where it can, nothing stays behind."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from rsltrace import DebugSession
from rsltrace.debug import tree
from rsltrace.debug.client import EditBranches
from rsltrace.debug.processes import Lost, SimProcess
from rsltrace.errors import DebugError, OutputError, RsltraceError
from rsltrace.line_protocol import Lines

pytestmark = pytest.mark.ros

CODE = """
import ctypes, os, socket, subprocess, sys, threading, time
from pathlib import Path
from rclpy.node import Node

class Ticks(Node):
    def __init__(self):
        super().__init__('ticks')
        self.n = 0
        self.kept = None
        self.create_timer(0.01, self.tick)

    def tick(self):
        self.n += 1
        if self.n == 50:
            self.at_50()
        if self.n == 100:
            self.at_100()

    def at_50(self):
        pass

    def at_100(self):
        pass

"""
JOB = "nodes: [{{node: 'ticks:{name}'}}]\nstop: {{duration: {duration}}}\n"
MARK = "RSLTRACE_TEST_MARK"


def marked() -> list[int]:
    """Return the processes below this one that a session has started."""
    mark = f"{MARK}={os.environ[MARK]}".encode()
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit() and int(name) != os.getpid():
            try:
                if mark in Path(f"/proc/{name}/environ").read_bytes().split(b"\0"):
                    found.append(int(name))
            except OSError:
                pass
    return found


def gone(pids: list[int]) -> bool:
    """Say whether processes are gone within ten minutes."""
    return eventually(lambda: not any(map(is_running, pids)))


def eventually(is_so: Callable[[], bool]) -> bool:
    """Say whether something comes true within ten minutes."""
    for _ in range(6000):
        if is_so():
            return True
        time.sleep(0.1)
    return False


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(autouse=True)
def nothing_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv(MARK, str(tmp_path))
    yield
    assert gone(marked()), marked()


@pytest.fixture
def job(tmp_path: Path) -> Callable[..., Path]:
    """Write a job with a node whose 50th and 100th ticks do what is given."""

    def write(at_50: str, at_100: str = "pass", duration: str = "2s") -> Path:
        code = f"class N(Ticks):\n    def at_50(self):\n        {at_50}\n"
        code += f"    def at_100(self):\n        {at_100}\n"
        (tmp_path / "ticks.py").write_text(CODE + code)
        path = tmp_path / "job.yaml"
        path.write_text(JOB.format(name="N", duration=duration))
        return path

    return write


def children_of(session: DebugSession) -> list[int]:
    pid = session._process.pid
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def mostly_long(value: str, *usual: str) -> Any:
    """Return a parameter, for the long tests unless it is a usual one."""
    return value if value in usual else pytest.param(value, marks=pytest.mark.long)


THREAD = "ctypes.CDLL(None).pthread_create(ctypes.byref(ctypes.c_ulong()), None, PAUSE, None)"
NOT_COPIED = {
    "real thread": (THREAD.replace("PAUSE", "ctypes.CDLL(None).pause"), None),
    "socket": (
        "self.kept = socket.socket(); self.kept.bind(('127.0.0.1', 0))",
        "self.kept.close()",
    ),
    "for reading and writing": (
        "self.kept = open(Path(__file__).with_name('x'), 'w+')",
        "self.kept.close()",
    ),
    "started a process": (
        "self.kept = subprocess.Popen(['sleep', '60'])",
        "(self.kept.kill(), self.kept.wait())",
    ),
    "shares memory": (
        "import mmap; self.kept = mmap.mmap(-1, 4096)",
        "self.kept.close()",
    ),
}


@pytest.mark.parametrize("why", [mostly_long(why, "real thread") for why in NOT_COPIED])
def test_what_cannot_be_copied_is_refused_and_one_goes_back_without(
    why: str, job: Callable[..., Path]
) -> None:
    at_50, at_100 = NOT_COPIED[why]
    notices: list[dict[str, Any]] = []
    with DebugSession(job(at_50, at_100 or "pass"), on_notice=notices.append) as session:
        session.run_to(40)
        session.run_to(80)
        assert session.evaluate("ticks.n") == 79
        stopped = session.reverse_step(5)  # from a checkpoint before the trouble
        assert (stopped.position.index, session.evaluate("ticks.n")) == (75, 74)
        refused = [one["text"] for one in notices if one["notice"] == "no checkpoints"]
        assert refused
        assert why in refused[0]
        session.run_to(150)
        if at_100 is not None:
            assert session.reverse_step().position.index == 149
            assert session.checkpoints()["indices"][-1] > 102


@pytest.mark.long
def test_without_checkpoints_going_back_is_running_again(folder: Path) -> None:
    notices: list[dict[str, Any]] = []
    trace = folder / "run.mcap"
    with DebugSession(trace, trust=True, checkpoints=0, on_notice=notices.append) as session:
        session.run_to(100)
        state = session.evaluate("filter.state")
        session.run_to(300)
        assert session.go_to(100).position.index == 100
        assert session.evaluate("filter.state") == state
        assert any(one["notice"] == "again" for one in notices)
        number = session.break_at("when filter.state > 1").number
        assert 0 < session.reverse_go_on().position.index < 100
        session.clear(number)
        assert eventually(lambda: len(list(filter(is_running, children_of(session)))) == 1)


@pytest.mark.long
def test_killed_children_are_noticed_and_made_again(folder: Path) -> None:
    with DebugSession(folder / "run.mcap", trust=True) as session:
        session.run_to(500)
        session.run_to(600)
        state = session.evaluate("filter.state")
        for pid in children_of(session):
            os.kill(pid, signal.SIGKILL)
        with pytest.raises(DebugError, match=r"killed by SIGKILL; the session is back at 600"):
            session.step()
        assert session.position.index == 600
        assert session.evaluate("filter.state") == state
        assert session.reverse_step().position.index == 599
        assert session.go_on().reason == "end"


CRASHES = {
    "SIGSEGV": "ctypes.string_at(0)",
    "exit status 7": "ctypes.CDLL(None)._exit(7)",
    "SIGABRT": "ctypes.CDLL(None).abort()",
}


@pytest.mark.parametrize("how", [mostly_long(how, "SIGSEGV") for how in CRASHES])
def test_a_node_that_ends_the_interpreter(how: str, job: Callable[..., Path]) -> None:
    with DebugSession(job(CRASHES[how])) as session:
        session.run_to(20)
        with pytest.raises(DebugError, match=rf"{how}; the session is back at 20"):
            session.go_on()
        assert session.run_to(50).position.index == 50
        with pytest.raises(DebugError, match=how):
            session.step(5)
        assert session.reverse_step().position.index == 49
        with pytest.raises(DebugError, match=how):
            session.evaluate("ticks.at_50()")
        assert session.position.index == 49


@pytest.mark.long
def test_checkpoints_keep_within_their_bounds(job: Callable[..., Path], tmp_path: Path) -> None:
    path = job("pass")
    with (tmp_path / "ticks.py").open("a") as file:
        file.write(
            "    def tick(self):\n        super().tick()\n"
            "        self.large = bytes([self.n % 256]) * (8 << 20)\n"
        )
    with DebugSession(path, checkpoints=100, memory_mib=200) as session:
        session.go_on()
        for index in range(200, 20, -10):
            assert session.go_to(index).position.index == index
        found = session.checkpoints()
        assert found["bytes"] <= 200 << 20
        assert len(found["indices"]) > 3
    with DebugSession(path, checkpoints=5) as session:
        session.go_on()
        for index in range(200, 20, -30):
            session.go_to(index)
        found = session.checkpoints()["indices"]
        assert len(found) <= 5
        assert found[0] == 0


BEGUN = "Path(__file__).with_name('begun').touch()\n        "


def paused_when_begun(session: DebugSession, folder: Path) -> threading.Thread:
    """Pause a session when its node has done ``BEGUN``."""

    def pause() -> None:
        assert eventually((folder / "begun").exists)
        session.pause()

    thread = threading.Thread(target=pause)
    thread.start()
    return thread


@pytest.mark.long
def test_a_callback_that_does_not_come_back(job: Callable[..., Path], tmp_path: Path) -> None:
    with DebugSession(job(f"{BEGUN}while True: pass")) as session:
        session.run_to(20)
        pausing = paused_when_begun(session, tmp_path)
        with pytest.raises(DebugError, match=r"did not come back.* back at 20"):
            session.go_on()
        pausing.join()
        assert session.step().position.index == 21


@pytest.mark.long
@pytest.mark.parametrize("presses", [False, True])
def test_an_endless_expression_ends_where_no_copy_can_be_made(
    presses: bool, job: Callable[..., Path]
) -> None:
    open_socket, _ = NOT_COPIED["socket"]
    with DebugSession(job(open_socket, "pass")) as session:
        session.run_to(80)
        stop = threading.Event()

        def keep_pressing() -> None:
            while presses and not stop.wait(0.001):
                session.pause()

        thread = threading.Thread(target=keep_pressing)
        thread.start()
        with pytest.raises(DebugError, match=r"did not come back.* back at 80"):
            session.evaluate("sum(iter(int, 1))")
        stop.set()
        thread.join()
        assert session.evaluate("ticks.n") == 79


@pytest.mark.long
def test_a_run_is_paused_and_goes_on(job: Callable[..., Path], tmp_path: Path) -> None:
    with DebugSession(job(f"{BEGUN}pass", duration="1000000s")) as session:
        pausing = paused_when_begun(session, tmp_path)
        stopped = session.go_on()
        pausing.join()
        assert stopped.reason == "paused"
        index = stopped.position.index
        assert session.step().position.index == index + 1
        assert session.reverse_step(2).position.index == index - 1


LIMIT = """
import resource
def limit():
    '''No more processes, for this one and what it forks. For root, that takes not being root.'''
    resource.setrlimit(resource.RLIMIT_NPROC, (1, 1))
    if os.getuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        head, caps = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        assert libc.capget(head, caps) == 0
        caps[0] &= ~(1 << 21 | 1 << 24)  # CAP_SYS_ADMIN, CAP_SYS_RESOURCE
        assert libc.setresuid(65534, 0, 0) == 0
        assert libc.capset(head, caps) == 0
"""


@pytest.mark.long
def test_a_fork_that_fails(job: Callable[..., Path], tmp_path: Path) -> None:
    path = job("limit()")
    with (tmp_path / "ticks.py").open("a") as file:
        file.write(LIMIT)
    notices: list[dict[str, Any]] = []
    with DebugSession(path, on_notice=notices.append) as session:
        session.run_to(40)
        session.run_to(80)
        refused = [one["text"] for one in notices if one["notice"] == "no checkpoints"]
        assert "no process can be made for a checkpoint" in refused[0]
        assert session.evaluate("ticks.n") == 79  # in place, for want of a copy
        assert session.reverse_step().position.index == 79
        assert session.evaluate("ticks.n") == 78


@pytest.mark.long
def test_a_trace_whose_job_does_not_load_any_more(tmp_path: Path, folder: Path) -> None:
    for name in ("job.yaml", "run.mcap", "nodes_of_debug.py"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "nodes_of_debug.py").write_text("from rclpy.node import Nod\n")
    with pytest.raises(RsltraceError, match="Nod"):
        DebugSession(tmp_path / "run.mcap", trust=True)
    (tmp_path / "job.yaml").unlink()
    with pytest.raises(RsltraceError, match="looked for"):
        DebugSession(tmp_path / "run.mcap", trust=True)
    with pytest.raises(RsltraceError, match="nothing"):
        DebugSession(tmp_path / "nothing.mcap")


@pytest.mark.long
def test_a_run_that_is_not_what_the_trace_says_stops_there(tmp_path: Path, folder: Path) -> None:
    for name in ("job.yaml", "run.mcap", "nodes_of_debug.py"):
        shutil.copy(folder / name, tmp_path)
    code = (tmp_path / "nodes_of_debug.py").read_text()
    changed = code.replace("1.5 * self.count", "(1.5 if self.count < 50 else 2.0) * self.count")
    (tmp_path / "nodes_of_debug.py").write_text(changed)
    with DebugSession(tmp_path / "run.mcap", trust=True) as session:
        assert any("nodes_of_debug has changed" in note for note in session.notes)
        stopped = session.go_on()
        assert stopped.reason == "diverged"
        assert session.evaluate("source.count") == 50
        assert session.step().reason == "diverged"
        index = stopped.position.index
        assert session.reverse_step().position.index == index - 1
        assert session.evaluate("source.count") == 49
        assert session.step().reason == "diverged"


@pytest.mark.long
def test_a_client_that_disconnects_in_the_middle(job: Callable[..., Path]) -> None:
    session = DebugSession(job("pass", duration="3600s"))
    failed = []

    def run() -> None:
        try:
            session.go_on()
        except (DebugError, OSError, ValueError) as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert eventually(lambda: len(marked()) > 2)
    pids = marked()
    session._lines._end.shutdown(socket.SHUT_RDWR)
    thread.join()
    assert failed
    assert gone(pids)
    session.close()


@pytest.mark.long
def test_a_client_that_is_killed(job: Callable[..., Path]) -> None:
    path = job("subprocess.Popen(['sleep', '600'], start_new_session=True)", duration="3600s")
    script = f"import rsltrace\nrsltrace.DebugSession({str(path)!r}).go_on()\n"
    client = subprocess.Popen([sys.executable, "-c", script])
    pids: list[int] = []

    def has_begun() -> bool:
        pids[:] = marked()
        return len(pids) > 4 and any(_command(pid) == "sleep" for pid in pids)

    try:
        assert eventually(has_begun)
    finally:
        client.kill()
        client.wait()
    assert gone(pids)


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


STALLS = """
import itertools, os
from rsltrace.debug import processes

family = processes.Family()
pid = os.posix_spawn("/bin/sh", ["sh", "-c", "kill -9 $$"], {})
os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
processes.time.monotonic = itertools.count(0, 60).__next__
print(family.how_ended(processes.SimProcess(None, pid)))
"""


def test_a_machine_that_stands_still_does_not_hide_how_a_process_ended() -> None:
    done = subprocess.run([sys.executable, "-c", STALLS], capture_output=True, text=True)
    assert done.stdout == "its process was killed by SIGKILL\n", done.stderr


@pytest.mark.parametrize("prints_endlessly", [False, True])
def test_a_machine_that_stands_still_does_not_end_a_callback(
    prints_endlessly: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tree, "Family", MagicMock)
    monkeypatch.setattr(tree, "_PAUSE_LIMIT_S", 0.25)
    monkeypatch.setattr(tree, "_LOOK_S", 0.0625)
    with ExitStack() as stack:
        client, asked, process, _far = (
            stack.enter_context(one) for _ in range(2) for one in socket.socketpair()
        )
        made = tree.CheckpointTree({"checkpoints": 1, "memory_mib": 1}, Lines(asked), deque())
        stack.callback(os.close, made._output)
        stack.callback(os.close, made._output_end)
        if prints_endlessly:
            stack.callback(os.close, endless := os.open("/dev/zero", os.O_RDONLY))
            made._output, made._is_quiet = endless, True
        simulation = SimProcess(Lines(process), 0)
        client.sendall(b'{"do": "pause"}\n')
        made._wait_for(simulation, None)
        monkeypatch.setattr(time, "monotonic", count(0, 60).__next__)
        for _ in range(3):
            made._wait_for(simulation, None)
        with pytest.raises(Lost, match="did not come back"):
            made._wait_for(simulation, None)


@pytest.mark.long
def test_requests_that_are_none_are_answered(folder: Path) -> None:
    with DebugSession(folder / "run.mcap", trust=True) as session:
        for request in ({}, {"do": "fly"}, {"do": "step", "count": "x"}, {"do": "event"}):
            with pytest.raises(DebugError, match=r"no request|not a request"):
                session._ask(**{"do": "", **request})  # type: ignore[arg-type]
        with pytest.raises(DebugError, match="no breakpoint 7"):
            session.clear(7)
        with pytest.raises(DebugError, match="at least one event"):
            session.step(0)
        with pytest.raises(DebugError, match="no event 100000"):
            session.event(100_000)
        assert session.step().position.index == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_branch_replaces_no_pipe_and_no_device(tmp_path: Path) -> None:
    branches = EditBranches(tmp_path / "run.mcap", None, ())
    branches.path = tmp_path / "branch.mcap"
    branches.path.write_bytes(b"branch")
    place = tmp_path / "kept.mcap"
    os.mkfifo(place)
    with pytest.raises(OutputError, match=r"kept\.mcap is a named pipe"):
        branches.keep(place, force=True)
    assert place.is_fifo()
    place.unlink()
    assert branches.keep(place, force=True).read_bytes() == b"branch"
