"""Processes do the same however slow the machine is, and whatever rsltrace was started from."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from rsltrace.adapters.processes.child import Life, ProcessHandle, has_memory
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.search.perturb import (
    ADDRESSES,
    HEAP,
    can_fix_addresses,
    perturbation,
    record_perturbed,
)
from rsltrace.trace.reader import Trace

JOB = """
nodes: [{script: node.py, isolated: true}]
stop: {duration: 1s}
"""
PRINTS = """
import rclpy

rclpy.init()
node = rclpy.create_node('prints')

def tick():
    print('x' * 200_000, flush=True)
    node.get_logger().info('printed')

node.create_timer(0.3, tick)
rclpy.spin(node)
"""
SAYS_BYE = """
import rclpy

rclpy.init()
node = rclpy.create_node('says_bye')
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    print('bye')
"""


def _logs(path: Path) -> list[tuple[int, str]]:
    with Trace.open(path) as trace:
        records = [(s, trace.decode("/rosout", d)) for s, _, d in trace.messages("/rosout")]
    return [(stamp // 1_000_000, record.msg) for stamp, record in records]  # type: ignore[attr-defined]


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.skipif(not can_fix_addresses(), reason="needs setarch, and a kernel that allows it")
@pytest.mark.parametrize("pins", [[], ["--no-pin"]], ids=["pinned", "not"])
def test_addresses_and_heap_of_processes_are_perturbed_and_else_the_same(
    compiled: Callable[[str], Path], tmp_path: Path, pins: list[str]
) -> None:
    """What the system does not fix (another machine, another build) must not decide."""
    (tmp_path / "job.yaml").write_text(f"""
nodes: [{{program: {compiled("counter.c")}, arguments: ["100", address]}}]
stop: {{duration: 1s}}
""")
    job = str(tmp_path / "job.yaml")
    first = perturbation(1)
    ways = [perturbation(0), first.only(ADDRESSES), first.only(HEAP)]
    digests = [record_perturbed(way, [job, *pins], tmp_path).digest for way in ways]
    assert "" not in digests
    assert len(set(digests)) == len(ways)
    assert record_perturbed(ways[0], [job, *pins], tmp_path).digest == digests[0]


@pytest.mark.ros
@pytest.mark.long
def test_time_stands_while_nobody_reads_what_a_process_prints(
    compiled: object, tmp_path: Path
) -> None:
    (tmp_path / "node.py").write_text(PRINTS)
    (tmp_path / "job.yaml").write_text(JOB)
    command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "t.mcap"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as started:
        assert started.stdout is not None
        printed = 0
        while part := os.read(started.stdout.fileno(), 1 << 16):
            printed += part.count(b"x")
            time.sleep(0.4)
        assert started.stderr is not None
        assert b"blocks outside" not in started.stderr.read()
    assert printed == 600_000
    assert _logs(tmp_path / "t.mcap") == [(300, "printed"), (600, "printed"), (900, "printed")]


@pytest.mark.ros
def test_a_process_ends_in_the_background_as_in_the_foreground(
    compiled: object, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A shell starts what is in its background with SIGINT ignored."""
    (tmp_path / "node.py").write_text(SAYS_BYE)
    (tmp_path / "job.yaml").write_text(JOB)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error is None
    finally:
        signal.signal(signal.SIGINT, before)
    assert capfd.readouterr().out == "bye\n"


SEES = """
import os
import rclpy

rclpy.init()
node = rclpy.create_node('sees')
mine = [os.open('/dev/null', os.O_RDONLY) for _ in range(3)]
given = os.stat('/proc/self/environ').st_size or len(open('/proc/self/environ', 'rb').read())
node.get_logger().info(f'{mine} {given} {hash("seen")} {os.environ["OMP_NUM_THREADS"]}')
rclpy.spin(node)
"""


@pytest.mark.ros
@pytest.mark.long
def test_what_rsltrace_has_open_changes_nothing_nor_that_it_is_not_pinned(
    compiled: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hash seed and threads of libraries are those of the command, in a run from Python, too."""
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    (tmp_path / "node.py").write_text(SEES)
    (tmp_path / "job.yaml").write_text(JOB)
    digests = []
    with ExitStack() as stack:
        for name in ("few.mcap", "many.mcap"):
            result = run(load_job(tmp_path / "job.yaml"), tmp_path / name)
            digests.append(result.digest)
            for _ in range(100):
                stack.enter_context(open(os.devnull))
    assert _logs(tmp_path / "few.mcap") == _logs(tmp_path / "many.mcap") != []
    assert digests[0] == digests[1]


def _waits_until_it_is(pid: int, state: str) -> None:
    deadline = time.monotonic() + 600
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != state:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_process_that_was_stopped_is_not_given_up() -> None:
    with subprocess.Popen(["/bin/sleep", "600"]) as sleeper:
        _waits_until_it_is(sleeper.pid, "S")
        life = Life(sleeper.pid)
        assert life.goes_on()
        sleeper.send_signal(signal.SIGSTOP)
        _waits_until_it_is(sleeper.pid, "T")
        assert not life.goes_on()
        assert has_memory(sleeper.pid)
        sleeper.kill()
        _waits_until_it_is(sleeper.pid, "Z")
        assert not has_memory(sleeper.pid)


def test_a_process_that_goes_in_circles_is_given_up() -> None:
    child = ProcessHandle([sys.executable, "-c", "while True: pass"], {}, None, "circles")
    child.give_up_after(0.2)
    assert child.receive() is None
    assert child.reap().said == "was killed by SIGKILL"
