"""Built-in functions that a tool (a profiler, a mock, ``coverage``) has replaced before the run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

_TOOL = """
import importlib, runpy, sys
name, sys.argv = sys.argv[1], ["rsltrace", *sys.argv[2:]]
module = importlib.import_module(name.rpartition(".")[0])
real = getattr(module, name.rpartition(".")[2])
def replaced(*words, **named):
    return real(*words, **named)
replaced.__name__ = real.__name__
setattr(module, real.__name__, replaced)
runpy.run_module("rsltrace", run_name="__main__")
"""
_JOB = """
nodes: [{script: node.py}]
stop: {duration: 1s}
"""


@pytest.mark.parametrize("name", ["os._exit", "os.abort", "os.urandom", "time.monotonic"])
def test_some_may_be_replaced(tmp_path: Path, name: str) -> None:
    done = _run(tmp_path, name)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.mcap").is_file()


@pytest.mark.parametrize("name", ["os.kill", "time.sleep", "_signal.signal", "builtins.hash"])
def test_others_are_an_error_that_says_by_whom(tmp_path: Path, name: str) -> None:
    done = _run(tmp_path, name)
    assert done.returncode == 2, done.stderr
    assert f"{name.rpartition('.')[2]}() of this Python has been replaced" in done.stderr
    assert "tool.py:6" in done.stderr


def _run(folder: Path, name: str) -> subprocess.CompletedProcess[str]:
    (folder / "tool.py").write_text(_TOOL)
    (folder / "node.py").write_text("import os\nos._exit(0)\n")
    (folder / "job.yaml").write_text(_JOB)
    return subprocess.run(
        [sys.executable, "tool.py", name, "record", "job.yaml", "-o", "run.mcap"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
