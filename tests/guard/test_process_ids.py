"""Each main has a process id of its own, the same in every run, and can do with it what one can."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard.process_ids import FIRST
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

MAIN = """
import json, logging, os, resource, signal, sys
from pathlib import Path
import rclpy

rclpy.init()
pid = os.getpid()
node = rclpy.create_node(f"main_{pid}")

def own():
    with open(f"/proc/{pid}/cmdline") as file, open("/proc/self/cmdline") as other:
        name = file.read() == other.read()
    record = logging.LogRecord("x", 20, "", 0, "", (), None)
    if (child := os.fork()) == 0:
        os._exit(os.getpid() == pid)
    is_child = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return {
        "pid": pid,
        "record": record.process,
        "name": name,
        "stat": os.stat(f"/proc/{pid}").st_ino == os.stat("/proc/self").st_ino,
        "path": bool(Path(f"/proc/{pid}/stat").read_text()) and Path("/proc", str(pid)).exists(),
        "tasks": bool(os.listdir(f"/proc/{pid}/task")),
        "exe": os.readlink(f"/proc/{pid}/exe") == os.readlink("/proc/self/exe"),
        "group": os.getpgid(pid) == os.getpgrp(),
        "nice": os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0),
        "limit": resource.prlimit(pid, resource.RLIMIT_NOFILE) is not None,
        "alive": os.kill(pid, 0) is None,
        "child": is_child == 0,
    }

with open(sys.argv[1], "w") as file:
    json.dump(own(), file)
signal.signal(signal.SIGUSR1, lambda number, frame: node.get_logger().info("signalled"))
os.kill(pid, signal.SIGUSR1)

def end():
    try:
        os.kill(pid + 1000, 0)
    except ProcessLookupError:
        os.kill(pid, signal.SIGTERM)

node.create_timer(0.1, end)
rclpy.spin(node)
"""
JOB = """
nodes:
  - {script: main.py, arguments: [a.json]}
  - {script: main.py, arguments: [b.json]}
guard: {file: allow, process: allow}
"""


def recorded(folder: Path, job: str = JOB) -> Any:
    (folder / "main.py").write_text(MAIN)
    (folder / "job.yaml").write_text(job)
    return run(load_job(folder / "job.yaml"), folder / "run.mcap", force=True)


def test_a_main_has_an_id_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = recorded(tmp_path)
    assert result.error is None
    for file, pid in (("a.json", FIRST + 1), ("b.json", FIRST + 2)):
        found = json.loads((tmp_path / file).read_text())
        assert (found.pop("pid"), found.pop("record")) == (pid, pid)
        assert all(found.values()), found
    with Trace.open(result.path) as trace:
        names = {entity.name for entity in trace.entities.values()}
        said = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    assert {f"/main_{FIRST + 1}", f"/main_{FIRST + 2}"} <= names
    assert said == ["signalled"] * 2
    found = [met.call for met in result.guarded if met.is_finding]
    assert "os.getpid()" not in found, found


@pytest.mark.parametrize(("mode", "is_real"), [("warn", True), ("record", True), ("error", None)])
def test_the_job_may_want_the_real_one(tmp_path: Path, mode: str, is_real: bool | None) -> None:
    (tmp_path / "m.py").write_text(
        "import os\nfrom rclpy.node import Node\ndef make():\n    return Node(f'n{os.getpid()}')\n"
    )
    job = f"nodes: [{{node: 'm:make'}}]\nstop: {{duration: 1s}}\nguard: {{pid: {mode}}}\n"
    result = recorded(tmp_path, job)
    if is_real is None:
        assert "os.getpid() at m.py:4" in str(result.error)
        assert "write 'pid: virtual'" in str(result.error)
        return
    with Trace.open(result.path) as trace:
        assert f"/n{os.getpid()}" in {entity.name for entity in trace.entities.values()}
        (finding,) = [one for found in trace.findings.values() for one in found]
    assert (finding.source.value, finding.call) == ("pid", "os.getpid()")
