"""Exit statuses where what the command prints to is full, or nobody reads it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

A = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback" / "a.mcap"
B = A.with_name("b.mcap")
pytestmark = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has /dev/full")

FULL = ">/dev/full"
CLOSED_PIPE = "; exit $?"  # to a pipe whose reader is gone
NO_STDOUT = ">&-"
NO_STDERR = "2>&-"
FULL_STDERR = "2>/dev/full"


def run(words: str, redirect: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    words = words.replace("A", str(A)).replace("B", str(B))
    reading, writing = os.pipe()
    os.close(reading)
    try:
        return subprocess.run(
            ["bash", "-c", f"{sys.executable} -m rsltrace {words} {redirect}"],
            stdout=writing if redirect == CLOSED_PIPE else subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            check=False,
            cwd=cwd,
        )
    finally:
        os.close(writing)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("words", "status"),
    [("info A", 0), ("diff A B", 1), ("diff A no.mcap", 2), ("--help", 0), ("diff --no", 2)],
)
def test_the_status_is_that_of_the_command_or_says_that_it_could_not_print(
    words: str, status: int
) -> None:
    for redirect in (NO_STDOUT, NO_STDERR, FULL_STDERR, f"{NO_STDERR} {NO_STDOUT}"):
        assert run(words, redirect).returncode == status, redirect
    done = run(words, FULL)
    assert done.returncode == 2
    if status != 2:
        assert done.stderr == ("rsltrace: error: No space left on device: standard output\n")
    assert run(words, f"{FULL} {FULL_STDERR}").returncode == 2
    done = run(words, CLOSED_PIPE)
    assert done.returncode == (2 if status == 2 else 141), "never 1: that says that runs differ"
    assert "Traceback" not in done.stderr


_INTERRUPTED = """
import importlib.abc, os, signal, sys

class Interrupts(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

from rsltrace.cli.start import main
sys.meta_path.insert(0, Interrupts())
sys.argv = ["rsltrace", "info", {trace!r}]
main()
"""


@pytest.mark.parametrize(
    ("module", "status"),
    [("rsltrace.guard.pin", -signal.SIGINT), ("click", -signal.SIGINT), ("rsltrace.cli.info", 130)],
)
def test_ctrl_c_while_the_command_is_loaded_is_no_traceback(module: str, status: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED.format(module=module, trace=str(A))],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr.strip()) == (status, "", "")


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.parametrize(("body", "status"), [("pass", 0), ("1 / 0", 3)])
def test_a_run_has_its_own_status_first(tmp_path: Path, body: str, status: int) -> None:
    (tmp_path / "nodes.py").write_text(
        "from rclpy.node import Node\n"
        "class Any(Node):\n    def __init__(self):\n        super().__init__('any')\n"
        "        self.create_timer(0.5, self.tick)\n"
        f"    def tick(self):\n        self.get_logger().info('x')\n        {body}\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: nodes:Any}]\nstop: {duration: 1s}\n")
    for redirect in (NO_STDOUT, FULL_STDERR if status else NO_STDERR):
        done = run("record job.yaml --force", redirect, tmp_path)
        assert done.returncode == status, done.stderr
    assert run("record job.yaml --force", FULL, tmp_path).returncode == (status or 2)
    if not status:
        assert run("record job.yaml --force", CLOSED_PIPE, tmp_path).returncode == 141
