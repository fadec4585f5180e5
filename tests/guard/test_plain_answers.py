"""Code that no guard needs to touch answers under the guard as in plain Python."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import rsltrace
from rsltrace.trace.reader import Trace

CODE = """
import inspect, io, os, pickle, random
import numpy as np

A, B = np.array([1.0, 2.0]), np.array([0.0, 4.0])

def apply(function, where):
    return function(where)

class Counted:
    asked = 0
    def __getstate__(self):
        Counted.asked += 1
        return {"asked": Counted.asked}

def counted():
    file = io.BytesIO()
    pickle.Pickler(file).dump(Counted())
    return pickle.loads(file.getvalue()).__dict__

def signature(function):
    try:
        return inspect.signature(function)
    except ValueError:
        return None

def answers():
    return [str(one) for one in (
        np.divide(A, B, np.zeros_like(A), where=B != 0).tolist(),
        [one.tolist() for one in np.frexp(A, where=[True, True])],
        [one.tolist() for one in np.divmod([7, 8], [3, 4], np.full(2, 9), np.full(2, 9),
                                           where=[True, False])],
        np.add(np.datetime64("2020-01-01"), np.timedelta64(1, "D"), where=True),
        np.empty(2, "U3").tolist(),
        np.empty_like(np.zeros(2, [("x", "f4"), ("pad", "V12")])).shape,
        np.empty(2, "V4").shape,
        apply(function=len, where="abc"),
        sorted({0.5, 2**2000, 3})[0],
        counted(),
        *map(signature, (os.listdir, hash, open, random.seed, random.choice, random.random,
                         np.empty, np.random.seed, np.random.normal, pickle.dumps)),
    )]
"""
NODE = """
from plain_code import answers
from rclpy.node import Node
from std_msgs.msg import String

class Plain(Node):
    def __init__(self):
        super().__init__("plain")
        publisher = self.create_publisher(String, "/answers", 100)
        for answer in answers():
            publisher.publish(String(data=answer))
"""


@pytest.mark.ros
@pytest.mark.filterwarnings("ignore:'where' used without 'out'")
def test_answers_are_those_of_plain_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain_code.py").write_text(CODE)
    Path("plain_node.py").write_text(NODE)
    Path("job.yaml").write_text("nodes: [{node: plain_node:Plain}]\nstop: {duration: 1s}\n")
    result = rsltrace.record(rsltrace.load_job("job.yaml"), Path("run.mcap"))
    assert result.exit_code == 0
    spec = importlib.util.spec_from_file_location("plain_code_here", "plain_code.py")
    assert spec is not None
    assert spec.loader is not None
    plain = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "plain_code_here", plain)
    spec.loader.exec_module(plain)
    with Trace.open("run.mcap") as trace:
        sent = trace.messages("/answers")
        found = [trace.decode("/answers", data).data for *_, data in sent]  # type: ignore[attr-defined]
        assert found == plain.answers()
        assert [one.call for one in trace.guarded if one.is_finding] == []


def test_the_audit_of_names_bound_to_each_other_ends(tmp_path: Path) -> None:
    lines = ["def use(sock):", "    spare = sock"]
    for _ in range(9):
        lines += ["    try:", "        spare = sock; sock = spare"]
        lines += ["    except OSError:", "        sock = spare; spare = sock"]
    (tmp_path / "bound.py").write_text("\n".join([*lines, "    sock.connect()"]) + "\n")
    command = [sys.executable, "-m", "rsltrace", "audit", "bound.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
