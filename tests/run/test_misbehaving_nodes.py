"""Nodes that do harm to the process or to the trace: a named error or the right answer, and never
exit 0 with a digest and no whole file."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

OURS = f"{Path(str(find_spec('rsltrace').origin)).parent}/"  # type: ignore[union-attr]
JOB = """
nodes: [{node: nodes_under_test:Evil}]
stop: {duration: 2s}
record: {segment_events: 3}
"""
NODE = """
import ctypes, os, resource, signal, sys, time, rclpy

class Evil(Node):
    def __init__(self):
        super().__init__('evil')
        self.publisher = self.create_publisher(UInt64, 'numbers', 10)
        self.ticks = 0
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.ticks += 1
        self.publisher.publish(UInt64(data=self.ticks))
        if self.ticks == 8:
            self.evil()

    def evil(self):
        %s
"""
HARMLESS = {
    "closes all it can count to": "os.closerange(3, 1 << 16)",
    "closes all and opens own": (
        "os.closerange(3, 1 << 16); self.own = [open(f'own{n}', 'w') for n in range(9)]"
    ),
    "puts a file in the place of all": (
        "self.own = open('own', 'w'); "
        "[os.dup2(self.own.fileno(), n) for n in range(3, 5000) if n != self.own.fileno()]"
    ),
    "forks and goes on": "self.child = os.fork()",
    "forks where nobody sees it": "self.child = ctypes.CDLL(None).fork()",
    "forks and spins": "self.child = os.fork(); self.child or rclpy.spin_once(self)",
    "forks a daemon": (
        "self.child = os.fork(); "
        "self.child or (os.setsid(), os.closerange(0, 1 << 16), time.sleep(0.2), os._exit(0))"
    ),
    "goes to another folder": "os.mkdir('other'); os.chdir('other')",
    "may open nothing more": "resource.setrlimit(resource.RLIMIT_NOFILE, (3, 4096))",
    "has no more standard streams": "sys.stdout = sys.stderr = sys.__stdout__ = None",
    "closes its standard streams": "sys.stdout.close(); sys.stderr.close()",
    "turns standard streams elsewhere": (
        "self.own = open('own', 'w'); [os.dup2(self.own.fileno(), n) for n in (0, 1, 2)]"
    ),
    "sets an alarm": "signal.alarm(3600)",  # more than a busy machine takes to the end
    "sets a timer": "signal.setitimer(signal.ITIMER_REAL, 3600, 0.5)",
}
HARMFUL = {
    "deletes the trace": ("os.unlink('run.mcap')", "it was deleted"),
    "cuts the trace": ("os.truncate('run.mcap', 9)", "it has 9 bytes and should have"),
    "appends to it": ("open('run.mcap', 'ab').write(b'x')", "bytes and should have"),
    "writes into it": (
        "file = open('run.mcap', 'r+b'); file.seek(99); file.write(b'x'); file.close()",
        "its content is not what was written",
    ),
    "renames it": ("os.rename('run.mcap', 'away.mcap')", "it was renamed"),
    "puts another there": (
        "os.rename('run.mcap', 'away.mcap'); open('run.mcap', 'w').close()",
        "it was renamed, or another file has its name",
    ),
    "fills the disk": (
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))",
        "File too large (EFBIG)",
    ),
}


def whole(path: Path, digest: str) -> bool:
    with Trace.open(path) as trace:
        trace.check()
        return trace.complete and trace.digest == digest


def written(done: subprocess.CompletedProcess[str]) -> str:
    found = re.fullmatch(r"digest ([0-9a-f]{16})  events 22  sim 2\.0{9}\n", done.stdout)
    assert found is not None, done.stdout + done.stderr
    return found[1]


@pytest.mark.few(1)
@pytest.mark.parametrize("evil", HARMLESS.values(), ids=HARMLESS)
def test_the_trace_is_whole_in_spite_of_a_node_that(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, evil: str
) -> None:
    job_file(JOB, NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 0, done.stderr
    assert whole(tmp_path / "run.mcap", written(done))
    assert "Traceback" not in done.stderr or "forks" in evil or "spin" in evil
    if "own" in evil:
        assert all(b"rsltrace" not in own.read_bytes() for own in tmp_path.glob("own*"))


@pytest.mark.few(1)
@pytest.mark.parametrize(("evil", "said"), HARMFUL.values(), ids=HARMFUL)
def test_no_success_is_reported_of_a_trace_that_a_node(
    job_file: Callable[..., Path], rsltrace: Any, evil: str, said: str
) -> None:
    job_file(JOB, NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    error = next(line for line in done.stderr.splitlines() if line.startswith("rsltrace: error: "))
    assert "the trace run.mcap" in error
    assert said in error
    assert "Traceback" not in done.stderr


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("evil", "status"),
    [
        ("ctypes.CDLL(None).raise(signal.SIGSEGV)", -signal.SIGSEGV),
        ("ctypes.CDLL(None).raise(signal.SIGKILL)", -signal.SIGKILL),
        ("ctypes.CDLL(None)._exit(0)", 0),
        ("os.kill(os.getpid(), signal.SIGUSR1)", -signal.SIGUSR1),
    ],
)
def test_a_process_that_is_gone_has_promised_nothing(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, evil: str, status: int
) -> None:
    evil = evil.replace(".raise(", "['raise'](")
    job_file(JOB, NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == status, done.stderr
    assert done.stdout == ""
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert not trace.complete
        assert trace.event_count >= 6


def test_a_node_may_close_what_the_command_prints_to(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path
) -> None:
    job_file(JOB, NODE % "os.closerange(0, 1 << 16)")
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 2, "the digest could not be told"
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert trace.complete


# -- the trace that was there ---------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("code", "status", "complete"),
    [
        (NODE.replace("super()", "raise ValueError\n        super()", 1) % "pass", 3, True),
        (NODE % HARMFUL["fills the disk"][0], 2, False),
        (NODE % "ctypes.CDLL(None)['raise'](signal.SIGKILL)", -9, False),
        (NODE.replace("Evil(Node)", "Evil2(Node)") % "pass", 2, None),
    ],
    ids=["a constructor raises", "the disk is full", "it is killed", "the job is wrong"],
)
def test_force_keeps_the_old_trace_if(
    job_file: Callable[..., Path],
    rsltrace: Any,
    tmp_path: Path,
    code: str,
    status: int,
    complete: bool | None,
) -> None:
    out, beside = tmp_path / "run.mcap", tmp_path / "run.unfinished.mcap"
    job_file(JOB, NODE % "pass")
    digest = written(rsltrace("record", "job.yaml", "-o", "run.mcap", "-q"))
    job_file(JOB, code)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "--force", "-q")
    assert done.returncode == status, done.stderr
    assert whole(out, digest)
    assert beside.exists() == (complete is not None)
    if complete is not None:
        assert "run.mcap is replaced when this run is over; until then the trace is in " in (
            done.stderr
        )
        with Trace.open(beside) as trace:
            trace.check()
            assert trace.complete == complete
    if status == 3:
        assert "wrote run.unfinished.mcap (run.mcap is as it was): constructing" in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("evil", "status"), [("pass", 0), ("raise ValueError", 3), ("os.kill(os.getpid(), 15)", 143)]
)
def test_force_replaces_the_old_trace_by_one_that_is_whole(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, evil: str, status: int
) -> None:
    job_file(JOB.replace("2s", "1s"), NODE % "pass")
    assert rsltrace("record", "job.yaml", "-o", "run.mcap", "-q").returncode == 0
    job_file(JOB, NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "--force", "-q")
    assert done.returncode == status
    assert whole(tmp_path / "run.mcap", done.stdout.split()[1])
    assert not (tmp_path / "run.unfinished.mcap").exists()


# -- nodes that are none --------------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("pass", "has not called super().__init__(name)"),
        ("self.create_timer(1.0, print)", "must call super().__init__(name) first"),
        ("self.declare_parameter('x', 1)", "must call super().__init__(name) first"),
        ("import rclpy; rclpy.spin_once(self)", "must call super().__init__(name) first"),
    ],
)
def test_a_node_without_its_constructor(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, body: str, said: str
) -> None:
    code = f"class Evil(Node):\n    def __init__(self):\n        {body}\n"
    job_file(JOB, code)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 3, done.stderr
    error = next(line for line in done.stderr.splitlines() if line.startswith("rsltrace: error: "))
    line = (tmp_path / "nodes_under_test.py").read_text().splitlines().index("class Evil(Node):")
    assert f"Evil ({tmp_path}/nodes_under_test.py:{line + 2}) {said}" in error
    assert OURS not in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert trace.complete


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "evil",
    [
        "self.create_timer(-1.0, print)",
        "message = UInt64(); message._data = 'x'; self.publisher.publish(message)",
        "self.create_publisher(UInt64, 'bad name', 10)",
        "self.undeclare_parameter('x')",
        "self.create_subscription(UInt64, 'x', None, -1)",
        "rclpy.spin(self)",
    ],
)
def test_the_traceback_of_a_node_has_no_line_of_ours(
    job_file: Callable[..., Path], rsltrace: Any, evil: str
) -> None:
    job_file(JOB, (NODE % f"try:\n            {evil}\n").rstrip() + FROM)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 3, done.stderr
    frames = [line for line in done.stderr.splitlines() if line.startswith("  File ")]
    assert frames or "rsltrace: error: " in done.stderr
    assert not [line for line in frames if OURS in line or "<serialize" in line]


FROM = """
        except Exception as error:
            raise RuntimeError from error
"""


# -- signals --------------------------------------------------------------------------------------


def test_a_handler_that_raises_while_no_node_runs_ends_the_run(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path
) -> None:
    evil = (
        "signal.signal(signal.SIGALRM, self.late); "
        "signal.setitimer(signal.ITIMER_REAL, 1e-3, 1e-3)\n"
        "    def late(self, number, frame):\n        raise TimeoutError('late')"
    )
    job_file(JOB.replace("2s", "100s"), NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "-q")
    assert done.returncode == 3, done.stderr
    assert "raised TimeoutError: late" in done.stderr
    assert OURS not in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert trace.complete


@pytest.mark.long
@pytest.mark.parametrize("ignored", [False, True])
def test_a_hang_up_closes_the_trace_unless_it_is_ignored(
    job_file: Callable[..., Path], tmp_path: Path, ignored: bool
) -> None:
    wait = "open('waits', 'w').close()\n        while not os.path.exists('go'): sum(range(100_000))"
    job_file(JOB, NODE % wait)
    wanted = signal.SIG_IGN if ignored else signal.SIG_DFL
    command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "run.mcap", "-q"]
    out = tmp_path / "run.mcap"
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGHUP, wanted),  # nohup may have started us
    ) as process:
        while not (tmp_path / "waits").exists():
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)
        process.send_signal(signal.SIGHUP)
        (tmp_path / "go").touch()
        output, errors = process.communicate(timeout=240)
    assert process.returncode == (0 if ignored else 129), errors
    assert ("hung up, closing the trace" in errors) is not ignored
    with Trace.open(out) as trace:
        trace.check()
        assert trace.complete
        assert trace.digest == output.split()[1]


def test_a_child_that_a_node_has_forked_ends_when_it_is_told_to(
    job_file: Callable[..., Path], rsltrace: Any
) -> None:
    evil = (
        "ready, begun = os.pipe()\n"
        "        self.child = os.fork()\n"
        "        self.child or os.write(begun, b'.')\n"  # a signal before that may be lost
        "        while not self.child:\n            time.sleep(0.01)\n"
        "        os.read(ready, 1)\n"
        "        os.kill(self.child, signal.SIGTERM)\n"
        "        status = os.waitpid(self.child, 0)[1]\n"
        "        self.get_logger().info(f'ended by {os.waitstatus_to_exitcode(status)}')"
    )
    job_file(JOB, NODE % evil)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap")
    assert "ended by -15" in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr


_LOCKS_AT_EXIT = """
import atexit, logging, threading

class Kept:
    def __init__(self):
        self.locks = [threading.Lock(), threading.RLock(), threading.Condition()]
        self.held = threading.RLock()
        threading.Thread(target=self.hold, daemon=True).start()
    def hold(self):
        with self.held:
            threading.Event().wait()
    def close(self):
        for lock in [*self.locks, self.held]:
            with lock:
                pass
        with self.locks[2]:
            self.locks[2].notify_all()
    def __del__(self):
        self.close()

kept = Kept.__new__(Kept)

class Locks(Node):
    def __init__(self):
        super().__init__('locks')
        kept.__init__()
        logging.getLogger('kept').addHandler(logging.StreamHandler())
        logging.getLogger('kept').warning('said')
"""


@pytest.mark.long
def test_locks_of_a_run_are_free_when_python_ends(
    rsltrace: Callable[..., Any], job_file: Callable[..., Path]
) -> None:
    path = job_file("nodes: [{node: 'nodes_under_test:Locks'}]\nstop: {time: 1s}", _LOCKS_AT_EXIT)
    done = rsltrace("record", path, stdin=subprocess.DEVNULL)
    assert done.returncode == 0
    assert "said" in done.stderr
    assert "Traceback" not in done.stderr
    assert "final" not in done.stderr
