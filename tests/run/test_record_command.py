"""``rsltrace record`` as a user runs it: output, exit status, bad input, signals, full disks."""

from __future__ import annotations

import array
import fcntl
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Trace
from rsltrace.job import load_job
from rsltrace.run import RunCallbacks, run
from rsltrace.simulation.loop.stop import Stop

pytestmark = pytest.mark.ros

BOTH = (
    "nodes: [{node: nodes_under_test:Talker}, {node: nodes_under_test:Listener}]\n"
    "stop: {duration: 3s}\n"
)
LAST_LINE = re.compile(r"digest [0-9a-f]{16}  events \d+  sim \d+\.\d{9}")


@pytest.mark.long
def test_the_last_line_of_stdout_is_for_scripts(rsltrace: Any, job_file: Any) -> None:
    job_file(BOTH)
    done = rsltrace("record", "job.yaml", "-o", "out.mcap")
    assert done.returncode == 0, done.stderr
    assert LAST_LINE.fullmatch(done.stdout.splitlines()[-1])
    assert "[INFO] [1.000000000] [listener]: total 1" in done.stderr
    quiet = rsltrace("record", "job.yaml", "-o", "quiet.mcap", "--quiet")
    assert quiet.stdout == done.stdout
    assert "listener" not in quiet.stderr


@pytest.mark.long
def test_json_output(rsltrace: Any, job_file: Any, tmp_path: Path) -> None:
    job_file(BOTH)
    done = rsltrace("record", "job.yaml", "--json", "-o", "out.mcap")
    values = json.loads(done.stdout)
    assert values["stop_reason"] == "duration of 3.000000000 s"
    assert values["end_ns"] == 3 * 10**9
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert (values["digest"], values["events"]) == (trace.digest, trace.event_count)


def test_seed_and_until_replace_the_jobs_own(rsltrace: Any, job_file: Any) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Dice}]\nstop: {duration: 100s}\nseed: 1\n",
        "import random\n"
        "class Dice(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('dice')\n"
        "        self.get_logger().info(f'drew {random.random()}')\n"
        "        self.create_timer(1.0, lambda: None)\n",
    )
    lines = {}
    for arguments in ((), ("--seed", "1"), ("--seed", "2"), ("--until", "4.5"), ("--until", "9s")):
        done = rsltrace("record", "job.yaml", "--force", *arguments)
        assert done.returncode == 0, done.stderr
        lines[arguments] = done.stdout
    assert lines[()] == lines["--seed", "1"] != lines["--seed", "2"]
    assert lines["--until", "4.5"].endswith("sim 4.000000000\n")
    assert lines["--until", "9s"].endswith("sim 9.000000000\n")


@pytest.mark.long
def test_an_existing_file_is_kept_without_force_and_what_is_no_trace_always(
    rsltrace: Any, job_file: Any, tmp_path: Path
) -> None:
    job_file(BOTH)
    out = tmp_path / "out.mcap"
    assert rsltrace("record", "job.yaml", "-o", "out.mcap").returncode == 0
    before = out.stat().st_mtime_ns
    done = rsltrace("record", "job.yaml", "-o", "out.mcap")
    assert done.returncode == 2
    assert "out.mcap" in done.stderr
    assert "--force" in done.stderr
    assert out.stat().st_mtime_ns == before
    assert rsltrace("record", "job.yaml", "-o", "out.mcap", "--force").returncode == 0
    assert out.stat().st_mtime_ns != before
    out.write_text("precious")
    assert rsltrace("record", "job.yaml", "-o", "out.mcap", "--force").returncode == 2
    assert out.read_text() == "precious"


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("nodes: [{node: nodes_under_test:Talker", ["job.yaml:1"]),
        ("nodes: [{node: nodes_under_test:Talker}]\nsead: 1\n", ["job.yaml:2:1", "sead", "seed"]),
        ("nodes: [{node: nodes_under_test:Talker}]\nseed: one\n", ["job.yaml:2:7", "integer"]),
        ("nodes: [{node: nodes:Talker}]\n", ["job.yaml:1:16: ", "no module 'nodes'"]),
        ("nodes: [{node: nodes_under_test:Walker}]\n", ["job.yaml:1:16: ", "has no 'Walker'"]),
    ],
)
def test_bad_jobs_are_explained(rsltrace: Any, job_file: Any, yaml: str, words: list[str]) -> None:
    job_file(yaml)
    done = rsltrace("record", "job.yaml")
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("rsltrace: error: ")
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


@pytest.mark.long
def test_a_job_that_cannot_start_leaves_no_trace_behind(
    rsltrace: Any, job_file: Any, tmp_path: Path
) -> None:
    job_file("nodes: [{node: nodes:Talker}]\n")
    assert rsltrace("record", "job.yaml", "-o", "out.mcap").returncode == 2
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.long
def test_a_missing_job_says_so(rsltrace: Any) -> None:
    done = rsltrace("record", "nothing.yaml")
    assert done.returncode == 2
    assert "nothing.yaml" in done.stderr


@pytest.mark.long
def test_outputs_that_cannot_be_written(rsltrace: Any, job_file: Any, tmp_path: Path) -> None:
    job_file(BOTH)
    (tmp_path / "folder").mkdir()
    for output in ("no/such/folder/out.mcap", "folder", "/proc/out.mcap"):
        done = rsltrace("record", "job.yaml", "-o", output)
        assert done.returncode == 2, done.stderr
        assert output in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.long
def test_an_exception_shows_the_users_traceback_and_exits_3(
    rsltrace: Any, job_file: Any, tmp_path: Path
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Faulty}]\n",
        "class Faulty(Talker):\n    def tick(self):\n        raise KeyError('wheel')\n",
    )
    done = rsltrace("record", "job.yaml", "-o", "out.mcap")
    assert done.returncode == 3
    assert "raise KeyError('wheel')" in done.stderr
    assert "/talker: timer Faulty.tick" in done.stderr
    assert "rsltrace/adapters" not in done.stderr
    assert LAST_LINE.fullmatch(done.stdout.splitlines()[-1])


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Start a recording of ``job.yaml``, which does not outlive the test."""
    with ExitStack() as stack:

        def record() -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "out.mcap"],
                cwd=tmp_path,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield record


@pytest.fixture
def interrupted(start: Any) -> Callable[[], subprocess.Popen[str]]:
    """Start a run whose callback hangs and prints ``stuck``, and interrupt it once."""

    def interrupt() -> subprocess.Popen[str]:
        process: subprocess.Popen[str] = start()
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "stuck\n"
        process.send_signal(signal.SIGINT)
        assert any("closing the trace" in line for line in process.stderr), "the first one has come"
        return process

    return interrupt


ENDLESS = "nodes: [{node: nodes_under_test:Talker, arguments: {period: 0.0001}}]\n"
NO_WATCHDOG = (
    "from rsltrace.run import watchdog\n"
    "watchdog._LOOKS_BEFORE_END = 10**9  # it is the second signal that ends the callback\n"
)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_closes_its_file_and_says_so(
    job_file: Any, tmp_path: Path, start: Any, number: int, code: int
) -> None:
    job_file(ENDLESS)
    process = start()
    _wait_for_bytes(tmp_path / "out.mcap", 300_000)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == code, stderr
    assert "closing the trace" in stderr
    assert LAST_LINE.fullmatch(stdout.splitlines()[-1])
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert trace.complete
        assert trace.digest in stdout


@pytest.mark.long
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_run_that_is_ended_before_it_begins_has_the_status_of_its_signal(
    rsltrace: Any, job_file: Any, tmp_path: Path, name: str, code: int
) -> None:
    job_file(ENDLESS, f"import os, signal\nos.kill(os.getpid(), signal.{name})\n")
    unignored = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)  # nohup may have started us
    done = rsltrace("record", "job.yaml", "-o", "out.mcap", preexec_fn=unignored)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_a_trace_is_closed_that_was_interrupted_while_it_was_opened(
    job_file: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_file(ENDLESS)
    monkeypatch.chdir(tmp_path)
    ends: list[Any] = []

    def write_job(*given: Any) -> None:
        write(*given)
        ends[0](Stop("interrupted", 130))

    module = importlib.import_module("rsltrace.run.session")
    write = module.write_job
    monkeypatch.setattr(module, "write_job", write_job)
    observer = RunCallbacks(interrupt=ends.append)
    result = run(load_job("job.yaml"), "out.mcap", observer=observer)
    assert result.exit_code == 130
    with Trace.open("out.mcap") as trace:
        assert trace.complete
        assert trace.result["exit_code"] == "130"


def test_a_killed_run_leaves_a_file_that_reads(job_file: Any, tmp_path: Path, start: Any) -> None:
    job_file(ENDLESS)
    process = start()
    _wait_for_bytes(tmp_path / "out.mcap", 300_000)
    process.kill()
    process.communicate(timeout=300)
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert not trace.complete
        assert trace.event_count >= 4096
        assert trace.event(4095).index == 4095


@pytest.mark.long
def test_a_node_that_catches_signals_does_not_keep_a_run_from_ending(
    job_file: Any, tmp_path: Path, start: Any
) -> None:
    job_file(
        ENDLESS.replace("Talker", "Deaf"),
        "import signal\n"
        "class Deaf(Talker):\n"
        "    def __init__(self, period=1.0):\n"
        "        super().__init__(period)\n"
        "        signal.signal(signal.SIGINT, lambda number, frame: print('caught'))\n",
    )
    process = start()
    _wait_for_bytes(tmp_path / "out.mcap", 10_000)
    process.send_signal(signal.SIGINT)
    stdout, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "caught" not in stdout
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert trace.complete


@pytest.mark.long
def test_a_callback_that_hangs_is_left_by_a_second_interrupt(
    job_file: Any, tmp_path: Path, interrupted: Any
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Stuck}]\n",
        NO_WATCHDOG + "class Stuck(Talker):\n"
        "    def tick(self):\n"
        "        print('stuck', flush=True)\n"
        "        while True: pass\n",
    )
    process = interrupted()
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 130
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert trace.complete


def test_a_second_interrupt_ends_an_endless_recursion(
    job_file: Any, tmp_path: Path, interrupted: Any
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Stuck}]\n",
        NO_WATCHDOG + "class Stuck(Talker):\n"
        "    def tick(self):\n"
        "        import sys\n"
        "        sys.setrecursionlimit(10**9)\n"
        "        self.f(0)\n"
        "    def f(self, n):\n"
        "        if n == 200_000: print('stuck', flush=True)\n"
        "        if n > 200_000: sum(range(10_000))  # or it takes all memory of a slow machine\n"
        "        self.f(n + 1)\n",
    )
    process = interrupted()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 130
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert trace.complete


@pytest.mark.long
def test_a_third_interrupt_ends_a_process_that_swallows_the_second(
    job_file: Any, tmp_path: Path, interrupted: Any
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Stuck}]\n",
        # A print that is interrupted may come again.
        NO_WATCHDOG + "import os\n"
        "class Stuck(Talker):\n"
        "    def tick(self):\n"
        "        while True:\n"
        "            try: self.work()\n"
        "            except KeyboardInterrupt: os.write(1, b'swallowed\\n')\n"
        # Not in the try itself: what Python 3.11 raises where a loop jumps back to the first
        # instruction of a try, it raises outside of it.
        "    def work(self):\n"
        "        os.write(1, b'stuck\\n')\n"
        "        while True: sum(range(9))\n",
    )
    process = interrupted()
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "swallowed\n"
    assert process.stdout.readline() == "stuck\n"
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGINT
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert not trace.complete


@pytest.mark.long
def test_a_third_interrupt_ends_a_recursion_that_leaves_no_room_for_handlers(
    job_file: Any, tmp_path: Path, start: Any
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Stuck}]\n",
        # Each handler that fails ends a loop, and the one above it has a level more.
        NO_WATCHDOG + "def f():\n"
        "    try: f()\n"
        "    except RecursionError:\n"
        "        while True: sum(range(9))\n"
        "class Stuck(Talker):\n"
        "    def tick(self):\n"
        "        print('stuck', flush=True)\n"
        "        f()\n",
    )
    process = start()
    assert process.stdout is not None
    assert process.stdout.readline() == "stuck\n"
    for _ in range(3):
        _let_it_run(process, 0.2)  # signals of one kind that wait are one
        process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode in (130, -signal.SIGINT)  # by the thread, or by the kernel
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert not trace.complete


@pytest.mark.long
def test_an_interrupt_in_the_middle_of_a_log_ends_the_run_properly(
    job_file: Any, tmp_path: Path, start: Any
) -> None:
    job_file(
        "nodes: [{node: nodes_under_test:Loud}]\n",
        "class Loud(Talker):\n"
        "    def __init__(self):\n"
        "        super().__init__(0.001)\n"
        "    def tick(self):\n"
        "        self.get_logger().info('x' * 1000)\n",
    )
    process = start()
    status = Path(f"/proc/{process.pid}/stat")
    still = 0
    while still < 20:  # nobody reads what it says: sooner or later it waits in a write
        assert process.poll() is None
        time.sleep(0.05)
        waits = status.read_text().rsplit(")", 1)[1].split()[0] == "S"
        still = still + 1 if waits and _unread(process.stderr) > 40_000 else 0
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr[-2000:]
    assert "closing the trace" in stderr
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert trace.complete
        assert not any(flag for part in trace.events() for flag in part["flags"].tolist())


def _unread(pipe: Any) -> int:
    """Return how many bytes wait in a pipe."""
    waiting = array.array("i", [0])
    fcntl.ioctl(pipe.fileno(), termios.FIONREAD, waiting)
    return waiting[0]


@pytest.mark.long
def test_a_full_disk_ends_the_run_with_a_readable_file(job_file: Any, tmp_path: Path) -> None:
    job_file(ENDLESS)
    code = (
        "import resource, runpy, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))\n"
        "sys.argv = ['rsltrace', 'record', 'job.yaml', '-o', 'out.mcap', '-q']\n"
        "runpy.run_module('rsltrace', run_name='__main__')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "out.mcap" in done.stderr
    assert "Traceback" not in done.stderr
    with Trace.open(tmp_path / "out.mcap") as trace:
        assert not trace.complete
        assert trace.event_count >= 4096


def _let_it_run(process: subprocess.Popen[str], seconds: float) -> None:
    """Wait until a busy process has had so much time of the processor."""

    def spent_s() -> float:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    until = spent_s() + seconds
    while spent_s() < until:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def _wait_for_bytes(path: Path, size: int) -> None:
    deadline = time.monotonic() + 600
    while not path.exists() or path.stat().st_size < size:
        assert time.monotonic() < deadline, "the run wrote nothing"
        time.sleep(0.05)


@pytest.mark.long
def test_the_trace_has_the_job_as_it_ran(rsltrace: Any, job_file: Any, tmp_path: Path) -> None:
    """What an override changed is in the trace's job, which loads as the job that ran."""
    job_file("nodes: [{node: nodes_under_test:Talker, name: a}]\nstop: {duration: 9s}\n")
    command = ("record", "job.yaml", "-o", "run.mcap", "--seed", "4", "--until", "3")
    done = rsltrace(*command, "--set", "nodes.a.arguments.period=0.5")
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        text, resolved = trace.job_text, json.loads(trace.job["resolved"])
    assert (resolved["seed"], resolved["stop"]["duration_ns"]) == (4, 3 * 10**9)
    assert text.startswith(
        "# The effective job of job.yaml\n"
        "#   with --set nodes.a.arguments.period=0.5\n"
        "#   with --seed seed=4\n"
        '#   with --until stop.duration="3s"\n'
    )
    (tmp_path / "again.yaml").write_text(text)
    again = rsltrace("record", "again.yaml", "-o", "again.mcap")
    assert again.stdout == done.stdout  # the same digest


def test_the_working_directory_is_no_trace(rsltrace: Any, job_file: Any) -> None:
    job_file(BOTH)
    for words in ((), ("--force",)):
        done = rsltrace("record", "job.yaml", "-o", ".", *words)
        assert done.returncode == 2
        assert done.stderr.endswith("trace .: it is a folder; name a file with -o\n")


def test_a_run_whose_node_breaks_open_is_reported(rsltrace: Any, tmp_path: Path) -> None:
    (tmp_path / "breaks.py").write_text(
        "import builtins\n"
        "from rclpy.node import Node\n"
        "class Breaks(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('breaks')\n"
        "        self.create_timer(0.5, self.tick)\n"
        "    def tick(self):\n"
        "        builtins.open = None\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'breaks:Breaks'}]\nstop: {duration: 1s}\n")
    done = rsltrace("record", "job.yaml")
    assert "Traceback" not in done.stderr
    assert LAST_LINE.fullmatch(done.stdout.splitlines()[-1])
