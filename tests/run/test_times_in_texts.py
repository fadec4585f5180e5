"""Times in texts of a run on recorded input count from its start, and can be typed back."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace import load_job
from rsltrace.debug.prompt.show import position_line
from rsltrace.errors import NodeError, RunError
from rsltrace.run import Simulation, run
from tests.run.test_bag_runs import write_bag

pytestmark = pytest.mark.ros

NODES = """
from rclpy.node import Node
from std_msgs.msg import UInt64

class Scaler(Node):
    def __init__(self, **options):
        super().__init__('scaler', **options)
        self.gain = self.declare_parameter('gain', 1).value
        self.sender = self.create_publisher(UInt64, '/scaled', 10)
        self.create_subscription(UInt64, '/numbers', self.got, 10)
        self.create_timer(0.5, self.tick)

    def tick(self):
        pass

    def got(self, message):
        if self.gain == 4 and message.data == 2:
            raise ValueError('four')
        self.sender.publish(UInt64(data=message.data * self.gain))

class Logger(Node):
    def __init__(self):
        super().__init__('logger')
        self.create_subscription(UInt64, '/scaled', self.got, 10)

    def got(self, message):
        self.get_logger().warn(f'{message.data}')
"""
JOB = """
nodes:
  - {{node: "timed_nodes:Scaler", parameters: {{gain: {gain}}}}}
  - {{node: "timed_nodes:Logger"}}
bags: [bag]
checks: [{{never: "/scaled: data > 1"}}]
{more}
"""
BEFORE = "construct_time: 1699999999.750000001s"
"""Nodes are constructed 0.25 s before the bag begins, at 1700000000.000000001 s."""
SECOND = "0.499999999"
"""The time of the second message, after the start."""
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``one``, ``two`` (another gain), ``failed`` (raises), ``later`` (starts at another time)."""
    folder = tmp_path_factory.mktemp("times")
    write_bag(folder / "bag")
    (folder / "timed_nodes.py").write_text(NODES)
    for name, gain, more in (
        ("one", 1, BEFORE),
        ("two", 2, BEFORE),
        ("failed", 4, BEFORE),
        ("later", 1, "start: 1699999999.000000001s"),
    ):
        job = folder / f"{name}.yaml"
        job.write_text(JOB.format(gain=gain, more=more))
        run(load_job(job), folder / f"{name}.mcap")
    return folder


@pytest.fixture
def text(runs: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Run a command in the folder; what it prints but for log lines, which have ROS times."""
    monkeypatch.chdir(runs)

    def call(*words: object, of_status: int = 0) -> str:
        done = command(*words)
        assert done.returncode == of_status, done.stdout + done.stderr
        lines = (done.stdout + done.stderr).splitlines()
        return "\n".join(line for line in lines if not line.startswith("[WARN]"))

    return call


def absolute(text: str) -> list[str]:
    return re.findall(r"\b1[67]\d{8}\.\d+", text)


@pytest.mark.long
def test_info_has_the_start_once(text: Callable[..., str]) -> None:
    shown = text("info", "one.mcap")
    assert "0.000000000 s to 1.999999999 s  (2 s), from simulated time 1700000000.0000" in shown
    assert absolute(shown) == ["1700000000.000000001"]


def test_cat_takes_the_times_it_prints(text: Callable[..., str]) -> None:
    shown = text("cat", "one.mcap")
    assert not absolute(shown)
    times = [line.split()[1] for line in shown.splitlines()]
    assert times[0] == "-0.250000000"
    assert times[-1] == "1.999999999"
    for time in (times[0], SECOND):
        same = text("cat", "one.mcap", "--from", time, "--to", time).splitlines()
        assert same == [line for line in shown.splitlines() if line.split()[1] == time]
    as_json = json.loads(text("cat", "one.mcap", "--from", SECOND, "--limit", 1, "--json"))
    assert as_json["stamp_ns"] == 1_700_000_000_500_000_000


@pytest.mark.parametrize(
    "words",
    [
        ("record", "one.yaml", "-o", "x.mcap", "--until", "1700000000.5"),
        ("cat", "one.mcap", "--from", "1700000000.5"),
        ("why", "one.mcap", "/logger", "/scaled", "--at", "1700000000.5"),
        ("replay", "one.mcap", "--until", "1700000000.5"),
        ("view", "one.mcap", "--at", "1700000000.5s"),
        ("replay", "one.mcap", "--edit", "1700000000.5: drop()", "-o", "x.mcap"),
    ],
)
def test_a_simulated_time_without_its_sign_is_named(
    text: Callable[..., str], words: tuple[str, ...]
) -> None:
    assert "write @1700000000.5s" in text(*words, of_status=2)


def test_diff_and_its_next_command(text: Callable[..., str]) -> None:
    shown = text("diff", "one.mcap", "two.mcap", of_status=1)
    assert "a different data on /scaled at 0.0 s (data 1 → 2)" in " ".join(shown.split())
    assert " events  1.999999999 s  digest" in shown
    assert not absolute(shown)
    several = text("diff", "one.mcap", "two.mcap", "failed.mcap", of_status=1)
    assert not absolute(several)
    (said,) = (line for line in several.splitlines() if "ended with an exception" in line)
    assert f", {SECOND} s): " in said


def test_diff_says_that_runs_start_at_different_times(text: Callable[..., str]) -> None:
    shown = " ".join(text("diff", "one.mcap", "later.mcap", of_status=1).split())
    assert (
        "note: times count from the start of each run: simulated time 1700000000.000000001 s in a, "
        "1699999999.000000001 s in b" in shown
    )
    assert "ran at -0.25 s in a and at 0.0 s in b, 750 ms earlier in simulated time" in shown


def test_why(text: Callable[..., str]) -> None:
    shown = text("why", "one.mcap", "/logger", "/scaled", "--at", "1")
    assert f"last at {SECOND} s" in shown
    assert not absolute(shown)
    again = text("why", "one.mcap", "/logger", "/scaled", "--at", f"{SECOND}s")
    assert f"last at {SECOND} s" in again


def test_checks_and_latencies(text: Callable[..., str]) -> None:
    shown = text("record", "one.yaml", "-o", "x.mcap", "--force", of_status=1) + text(
        "latency", "one.mcap"
    )
    assert f"{SECOND} s, /scaler" in shown
    assert "(0.000000000 s) to event" in shown
    assert not absolute(shown)


@pytest.mark.long
def test_replay_and_a_node_alone(text: Callable[..., str], runs: Path) -> None:
    shown = text("replay", "one.mcap", "--until", SECOND)
    assert f"to {SECOND} s" in shown
    source = runs / "timed_nodes.py"
    try:
        source.write_text(NODES.replace("* self.gain", "* 3"))
        shown += text("replay", "one.mcap", of_status=1)
        shown += text("replay", "one.mcap", "--node", "/scaler", of_status=1)
    finally:
        source.write_text(NODES)
    assert "message /scaled at 0.000000000 s" in shown
    assert not absolute(shown)


def test_an_exception_and_a_driver_say_when(runs: Path) -> None:
    failed = run(load_job(runs / "failed.yaml"), None)
    assert isinstance(failed.error, NodeError)
    assert f"at simulated time {SECOND} s raised" in str(failed.error)
    assert failed.error.stamp_ns == 1_700_000_000_500_000_000
    with Simulation(load_job(runs / "one.yaml")) as sim:
        sim.run_until(1)
        with pytest.raises(RunError, match=r"is 1\.000000000 s already, past 0\.500000000 s"):
            sim.run_until(0.5)


@pytest.mark.long
def test_debug_goes_to_the_times_it_shows(runs: Path) -> None:
    lines = [f"goto {SECOND}", "info timers", "goto 0.75", "goto 1700000000.5", "quit"]
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "debug", "one.mcap"],
        input="".join(f"{line}\n" for line in lines),
        capture_output=True,
        text=True,
        cwd=runs,
        timeout=240,
        env=os.environ,
    )
    said = "\n".join(one for one in done.stdout.splitlines() if not one.startswith("[WARN]"))
    answers = said.split("(rsltrace) ")
    assert "-> event 12  0.750000000  /scaler: timer Scaler.tick" in answers[1]
    assert re.search(r"tick +500 ms +1\.250000000", answers[2])
    assert "-> event 13  1.250000000" in answers[3]
    assert "write @1700000000.5s" in answers[4] + done.stderr
    assert not absolute("".join(answers[:4]))


def test_the_viewer_and_pages(text: Callable[..., str], runs: Path) -> None:
    pytest.importorskip("textual", reason="needs textual")
    from rsltrace_viewer.model.inspector.event import Openness, inspect
    from rsltrace_viewer.model.run import Run
    from rsltrace_viewer.session import Session

    from rsltrace.job.values.times import parse_time_in_run

    opened = Run.open(runs / "one.mcap")
    try:
        session = Session(opened)
        session.place = session.place_at_time(parse_time_in_run(SECOND))
        assert session.row(session.place).event.time == SECOND
        lines = {one.label: one.value for one in inspect(opened, session.place, Openness())}
        assert lines["at"] == f"{SECOND} s"
        assert "from 2023-11-14 22:13:20 UTC" in session.facts()
    finally:
        opened.close()
    text("info", "one.mcap", "--format", "html", "-o", "one.html")
    text("diff", "one.mcap", "two.mcap", "--format", "html", "-o", "two.html", of_status=1)
    page = (runs / "one.html").read_text()
    assert set(absolute(re.sub(r"<[^>]*>", " ", page))) <= {"1700000000.000000001"}
    assert "at 0.0 s (data 1 → 2)" in (runs / "two.html").read_text()
    assert position_line  # the agents' tools print positions as the prompt does
