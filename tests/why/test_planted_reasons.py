"""Why a callback did not run: reasons planted in real runs; each names reason, entity and line."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.diff.why.answer import why
from rsltrace.errors import TraceError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.simulation.middleware.qos.policies import DEFAULT_QOS, Liveliness, Qos, Reliability
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODES = Path(__file__).with_name("nodes")
JOBS = {
    "graph": """
nodes: [{node: planted_nodes:Source}, {node: planted_nodes:Listener}, {node: planted_nodes:SimTime}]
clocks: {node: /sim_time, source: topic}
""",
    "delivery": """
nodes: [{node: planted_nodes:Source}, {node: planted_nodes:Worker},
  {node: planted_nodes:Worker, name: idle}, {node: planted_nodes:Worker, name: far},
  {node: planted_nodes:Worker, name: slow}]
execution: {entities: [{node: /worker, entity: /numbers, constant: 350ms}]}
delay:
  default: 0ms
  links:
    - {topic: /numbers, to: /slow, constant: 700ms}
    - {topic: /quick, to: /slow, constant: 20ms}
  outages: [{node: /far, from: 150ms, to: 1900ms}]
faults: [{drop: /quick, message: 3, to: /idle}]
""",
    "waits": """
nodes: [{node: planted_nodes:Source}, {node: planted_nodes:Locked}, {node: planted_nodes:Caller},
  {node: planted_nodes:Sleeper}, {node: planted_nodes:Worker, name: crashes},
  {node: planted_nodes:Worker, name: hangs}]
faults: [{crash: /crashes, at: 350ms}, {hang: /hangs, at: 350ms, for: 200ms}]
""",
    "constructor": """
nodes: [{node: planted_nodes:Source}, {node: planted_nodes:Broken}, {node: planted_nodes:Worker}]
""",
    "exception": "nodes: [{node: planted_nodes:Source}, {node: planted_nodes:Failing}]",
    "filters": "nodes: [{node: planted_nodes:Fusion}, {node: planted_nodes:Mapper}]",
}


@dataclass(frozen=True)
class Planted:
    """A question about one of the jobs, and what its answer has to name; ``mark``: the comment on
    the line to blame."""

    job: str
    node: str
    asked: str
    reason: str
    entity: str
    mark: str
    at: str = ""
    says: str = ""

    def __str__(self) -> str:
        return f"{self.job}-{self.node}-{self.asked}-{self.at}".strip("-").replace("/", "")


PLANTED = [
    Planted(
        "graph",
        "/listener",
        "/nothing",
        "no_sender",
        "subscription /nothing of /listener",
        "nobody",
    ),
    Planted(
        "graph", "listener", "on_names", "no_sender", "/source publishes /robot/names", "namespace"
    ),
    Planted(
        *("graph", "listener", "on_quick", "incompatible_qos", "publisher /quick of /source"),
        "reliability",
        says="reliability is best_effort at the publisher, and the subscription asks for reliable",
    ),
    Planted(
        *("graph", "listener", "on_often", "incompatible_qos", "publisher /quick of /source"),
        "deadline",
        says="deadline is unlimited at the publisher, and the subscription asks for 50 ms",
    ),
    Planted(
        *("graph", "listener", "on_kept", "incompatible_qos", "publisher /numbers of /source"),
        "durability",
        says="durability is volatile at the publisher",
    ),
    Planted(
        *("graph", "listener", "robot/names", "created_late", "publisher /robot/names of /source"),
        "joined late",
    ),
    Planted(
        *("graph", "listener", "stopping", "silent", "publisher /stopping of /source"),
        "tick",
        says="until_stopped of /source was cancelled at 0.4 s by timer Source.tick of /source",
    ),
    Planted("graph", "listener", "reset", "no_sender", "client /reset of /listener", "Listener"),
    Planted("graph", "sim_time", "numbers", "not_received", "/sim_time", "SimTime"),
    Planted(
        *("graph", "source", "until_stopped", "timer_cancelled", "by timer Source.tick of /source"),
        "tick",
    ),
    Planted(
        *("graph", "source", "never_started", "timer_cancelled", "autostart=False", "not started")
    ),
    Planted("graph", "source", "rare", "run_ended", "timer Source.rare of /source", "rare"),
    Planted("graph", "sim_time", "by_clock", "clock_stands", "timer SimTime.by_clock", "clock"),
    Planted(
        *(
            "delivery",
            "idle",
            "quick",
            "lost_by_link",
            "publisher /quick of /source",
            "sends quick",
        ),
        says="sent at 0.3 s was lost on the way",
    ),
    Planted(
        *("delivery", "far", "quick", "lost_by_link", "subscription /quick of /far", "sends quick"),
        at="0.5",
        says="lost in an outage",
    ),
    Planted(
        *("delivery", "far", "numbers", "pushed_out", "publisher /numbers of /source in an outage"),
        "sends number",
        says="the message of 1.2 s pushed it out",
    ),
    Planted(
        *("delivery", "worker", "numbers", "pushed_out", "subscription /numbers of /worker"),
        "works",
        says="the message of 0.4 s pushed it out, because an earlier callback of it ran from 0.1 s",
    ),
    Planted(
        *("delivery", "worker", "quick", "busy", "subscription /numbers of /worker", "works"),
        at="350ms",
        says="was 500 ms late",
    ),
    Planted(
        *("delivery", "slow", "quick", "late", "publisher /quick of /source", "sends quick"),
        at="350ms",
        says="the link took 20 ms",
    ),
    Planted(
        *("delivery", "slow", "numbers", "run_ended", "subscription /numbers of /slow", "works"),
        at="1.95s",
        says="was due at 2.6 s, and the run ended at 2.0 s",
    ),
    Planted(
        *("waits", "locked", "numbers", "waiting", "thread Thread-1 (work)", "lock"),
        says="is held back since 0.3 s",
    ),
    Planted("waits", "caller", "on_time", "waiting", "service call, of /nobody", "service"),
    Planted("waits", "sleeper", "numbers", "busy", "timer Sleeper.on_time of /sleeper", "sleeps"),
    Planted(
        *("waits", "sleeper", "on_time", "unfinished", "timer Sleeper.on_time", "sleeps"),
        at="500ms",
        says="began at 0.45 s and had not ended at 0.5 s",
    ),
    Planted(*("waits", "crashes", "numbers", "node_ended", "/crashes ended at 0.35 s", "Worker")),
    Planted("waits", "hangs", "numbers", "busy", "node /hangs hung from 0.35 s", "Worker"),
    Planted(
        *("constructor", "broken", "numbers", "not_constructed", "its constructor raised"),
        "constructor",
    ),
    Planted(
        *("constructor", "worker", "numbers", "not_constructed", "the constructor of /broken"),
        "constructor",
    ),
    Planted(
        *("exception", "failing", "numbers", "node_ended", "subscription /numbers of /failing"),
        "raises",
        says="ValueError: three",
    ),
    Planted(
        *("filters", "fusion", "fuse", "unmatched_stamps", "filter of Fusion.fuse", "stamps"),
        says="the stamps of /point and /twist are at least 5 ns apart",
    ),
    Planted(
        *("filters", "mapper", "point", "no_transform", "subscription /point of /mapper"),
        "extrapolation",
        says="publisher /tf of /mapper sent base last at 0.35 s, with stamp 0.35 s",
    ),
    Planted(
        *("filters", "mapper", "twist", "no_transform", "subscription /twist of /mapper", "frame"),
        says="nobody sent a transform of lidar",
    ),
    Planted("graph", "source", "tick", "as_expected", "timer Source.tick of /source", "tick"),
]


@pytest.fixture(scope="module")
def traces(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Record each job once, when it is first asked about."""
    folder = tmp_path_factory.mktemp("why") / "nodes"
    shutil.copytree(NODES, folder)

    def record(name: str) -> Path:
        trace = folder / f"{name}.mcap"
        if not trace.exists():
            (folder / f"{name}.yaml").write_text(f"{JOBS[name]}\nstop: {{duration: 2s}}\n")
            run(load_job(folder / f"{name}.yaml"), trace)
        return trace

    return record


@pytest.mark.parametrize("planted", PLANTED, ids=str)
def test_reason_entity_and_line(
    planted: Planted,
    traces: Callable[[str], Path],
    command: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    at = ("--at", planted.at) if planted.at else ()
    words = (traces(planted.job), planted.node, planted.asked, *at)
    done = command("why", *words, "--json")
    found = json.loads(done.stdout)
    assert found["reason"] == planted.reason, found
    sentence = found["sentence"]
    assert planted.entity.casefold() in sentence.casefold()
    assert planted.says in sentence
    lines = (NODES / "planted_nodes.py").read_text().splitlines()
    (line,) = (n for n, text in enumerate(lines, 1) if text.endswith(f"# {planted.mark}"))
    assert found["place"] == f"planted_nodes.py:{line}"
    assert done.returncode == (planted.reason != "as_expected")
    text = command("why", *words)
    assert text.stdout.splitlines() == [sentence, *(f"  {one}" for one in found["evidence"])]
    assert text.stderr.startswith("next: ") == (found["event"] is not None)


SPINNING = """
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import UInt64

LAST = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)

class Late(Node):
    def __init__(self):
        super().__init__("late")
        self.out = self.create_publisher(UInt64, "map", LAST)
        self.count = 0
        self.create_timer(0.1, self.tick)
        self.create_timer(0.35, self.join)

    def tick(self):
        self.count += 1
        self.out.publish(UInt64(data=self.count))

    def join(self):
        self.create_subscription(UInt64, "map", lambda message: None, LAST)

def main():
    rclpy.init()
    node = Late()
    rclpy.spin_until_future_complete(node, rclpy.Future(), timeout_sec=1.0)
"""


def test_a_main_that_spins_a_node_does_not_keep_it_waiting(
    tmp_path: Path, command: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    (tmp_path / "spinning.py").write_text(SPINNING)
    (tmp_path / "job.yaml").write_text("nodes: [{main: 'spinning:main'}]\n")
    run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    done = command("why", tmp_path / "run.mcap", "/late", "map", "--at", "0.35", "--json")
    assert json.loads(done.stdout)["reason"] == "as_expected", done.stdout


@pytest.mark.parametrize(
    "qos",
    [
        DEFAULT_QOS,
        replace(DEFAULT_QOS, reliability=Reliability.BEST_EFFORT, deadline_ns=5, lease_ns=7),
        replace(DEFAULT_QOS, liveliness=Liveliness.MANUAL_BY_TOPIC, lifespan_ns=9),
    ],
)
def test_the_qos_of_an_entity_is_what_the_trace_shows(qos: Qos) -> None:
    assert Qos.from_summary(qos.summary()) == qos


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("sourc", "tick"), "has no node that is called 'sourc'; did you mean '/source'?"),
        (("source", "tck"), "has no callback of /source that is called 'tck'; there are"),
        (("listener", "qick"), "did you mean '/quick'?"),
        (("listener", "/tick"), "did you mean '/quick'?"),
        (("/numbers", ""), "/numbers is not a node; /listener receives it"),
    ],
)
def test_unknown_names(words: tuple[str, str], error: str, traces: Callable[[str], Path]) -> None:
    with Trace.open(traces("graph")) as trace, pytest.raises(TraceError) as raised:
        why(trace, *words)
    assert error in str(raised.value)
    assert raised.value.exit_code == 2
