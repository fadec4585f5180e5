"""Recorded states and answers from outside: in one run, between two, and in Rerun's text."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.message_tree import Openness
from rsltrace_viewer.model.run import Run

import rsltrace
from rsltrace.errors import NodeError
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

NODE = """
import os
import numpy as np
from rclpy.node import Node
from std_msgs.msg import Float64

class Filter(Node):
    def __init__(self):
        super().__init__('filter')
        self.sender = self.create_publisher(Float64, 'x', 1)
        self.total = 0.0
        self.P = np.eye(4)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.total += float(os.environ.get('GAIN', '1'))
        self.sender.publish(Float64(data=self.total if self.total > 8 else 0.0))
"""
JOB = "nodes: [{node: 'filtering:Filter'}]\nguard: {state: STATE}\nstop: {duration: 1s}\n"


def record(folder: Path, state: str, gain: str, name: str) -> Path:
    (folder / "filtering.py").write_text(NODE)
    (folder / "job.yaml").write_text(JOB.replace("STATE", state))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GAIN", gain)
        rsltrace.record(rsltrace.load_job(folder / "job.yaml"), folder / name)
    return folder / name


def screen(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "view", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return Path(str(arguments[-1])).read_text()


def test_a_state_is_shown_as_it_was_after_the_event(tmp_path: Path) -> None:
    with Trace.open(record(tmp_path, "record", "1", "run.mcap")) as trace:
        run = Run(trace)
        openness = Openness()
        closed = {line.path: line for line in inspect(run, 3, openness)}
        assert closed["state"].open is False
        openness.toggle("state")
        lines = {line.path: line.value for line in inspect(run, 3, openness)}
        assert lines["state.total"] == "3.0"
        assert lines["state.P"] == "float64 4 x 4: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, …]"
    with Trace.open(record(tmp_path, "true", "1", "hashes.mcap")) as trace:
        assert not any(line.path == "state" for line in inspect(Run(trace), 3, Openness()))


@pytest.mark.long
def test_two_runs_differ_in_a_state_before_they_differ_in_a_message(tmp_path: Path) -> None:
    a, b = (record(tmp_path, "record", gain, f"{gain}.mcap") for gain in ("1", "2"))
    text = screen(a, b, "--size", "100x40", "--export", tmp_path / "screen.txt")
    assert ">≠     1   1" in text, "an event that leaves another state is not the same"
    assert "the same, at another time" not in text
    rows = [row.strip() for row in text.splitlines()]
    at = rows.index("▼ ≠ state  of /filter after it")
    assert rows[at + 1 : at + 4] == ["total", "a 1.0", "b 2.0"]
    at = rows.index("≠ call  environment: os.environ['GAIN']")
    assert rows[at + 2 : at + 4] == ["a '1'", "b '2'"]


@pytest.mark.long
def test_of_hashes_the_screen_says_how_to_see_more(tmp_path: Path) -> None:
    a, b = (record(tmp_path, "true", gain, f"{gain}.mcap") for gain in ("1", "2"))
    text = screen(a, b, "--size", "100x40", "--export", tmp_path / "screen.txt")
    assert "only hashes were recorded; guard: {state: record} in the job keeps the values" in text


def test_rerun_tells_them_too(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'rsltrace[rerun]'")
    from rsltrace_viewer.rerun_export.divergence import document

    a, b = (record(tmp_path, "record", gain, f"{gain}.mcap") for gain in ("1", "2"))
    text = document(rsltrace.diff(a, b))
    assert "state of the node afterwards\n  total  1.0  |  2.0" in text
    at = text.index("! environment: os.environ['GAIN']\n")
    assert text[at:].splitlines()[1:3] == ["      a '1'", "      b '2'"]


@pytest.mark.long
def test_a_run_that_an_exception_ended_says_so(tmp_path: Path) -> None:
    """Also where the runs diverge by something else, and where run a went on."""
    a = record(tmp_path, "false", "1", "a.mcap")
    code = NODE + "        if self.total > 12:\n            raise ValueError('too much')\n"
    (tmp_path / "filtering.py").write_text(code)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GAIN", "2")
        with pytest.raises(NodeError):
            rsltrace.record(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "b.mcap")
    text = screen(a, tmp_path / "b.mcap", "--size", "108x40", "--export", tmp_path / "screen.txt")
    assert "! b ended with an exception (event 7, " in text
    (row,) = [row for row in text.splitlines() if row.startswith(" ≠ !   7   7 ")]
    assert "b: /x 14, exception ValueError" in row


@pytest.mark.long
def test_a_trace_that_has_no_segment_yet(tmp_path: Path) -> None:
    path = record(tmp_path, "false", "1", "whole.mcap")
    (tmp_path / "begun.mcap").write_bytes(path.read_bytes()[:400])
    text = screen(tmp_path / "begun.mcap", "--export", tmp_path / "screen.txt")
    assert "no events: the run writes some four thousand at a time, or was killed before" in text
    assert "0 events  not finished" in text
    assert "digest" not in text, "there is none yet"
