"""One node fed from a rosbag2 recording, and what pytest gets of one node."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import rsltrace
from rsltrace.cli.main import cli
from rsltrace.testing import NodeChanged, assert_node_unchanged
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.export import export_bag

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
HUSKY = ROOT.parent / "shared/data/husky_outdoor"


@pytest.fixture
def robot(recorded: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bag with the input and the output of /filter, in the present folder beside its job."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr("rsltrace.cli.replay.unpin", lambda: None)
    export_bag(recorded(), tmp_path / "bag", topics=["/speed", "/smooth"])
    return tmp_path


def change(folder: Path, old: str, new: str) -> None:
    file = folder / "nodes_of_replay.py"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def command(*words: str) -> Any:
    return CliRunner().invoke(cli, ["replay", *words])


@pytest.mark.long
@pytest.mark.parametrize("source", ["job.yaml", "run.mcap"])
def test_fed_from_a_bag(robot: Path, source: str) -> None:
    result = rsltrace.replay(source, node="/filter", bag="bag", trust=True)
    assert result.same
    assert (result.inputs, result.compared) == (30, 30)
    change(robot, "0.125 * message.data", "0.25 * message.data")
    result = rsltrace.replay(source, node="/filter", bag=["bag"], trust=True)
    assert len(result.changes) == 30
    assert result.first is not None
    assert (result.first.name, result.first.recorded_event) == ("/smooth", None)
    assert result.first.fields[0].path == "data"


@pytest.mark.long
def test_a_run_with_a_bag_is_a_trace_to_compare_with(robot: Path) -> None:
    """With the recording of a robot that has none of the node's outputs, say."""
    export_bag(robot / "run.mcap", robot / "inputs", topics=["/speed"])
    result = rsltrace.replay("job.yaml", node="filter", bag="inputs", output="golden.mcap")
    assert result.compared == 0
    assert "nothing to compare" in result.sentence
    assert any("-o keeps this run" in note for note in result.notes)
    (robot / "inputs").rename(robot / "not here any more")
    assert rsltrace.replay("golden.mcap", node="filter").compared > 30
    change(robot, "0.75 * self.state", "0.7 * self.state")
    assert rsltrace.replay("golden.mcap", node="filter", trust=True).diverged


@pytest.mark.long
def test_messages_are_matched_by_the_stamps_in_their_headers(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    """The robot lost one of its outputs on the way to the recorder: only that one is new."""
    code = """
from geometry_msgs.msg import PointStamped

class Stamped(Node):
    def __init__(self):
        super().__init__('stamped')
        self.out = self.create_publisher(PointStamped, 'point', 10)
        self.create_subscription(Float64, 'speed', self.got, 10)
        self.lose = self.declare_parameter('lose', False).value

    def got(self, message):
        point = PointStamped()
        point.header.stamp = self.get_clock().now().to_msg()
        point.point.x = message.data
        if not (self.lose and 10.0 < message.data < 13.0):
            self.out.publish(point)
"""
    job = """\
nodes: [{node: nodes_of_replay:Source}, {node: nodes_of_replay:Stamped, parameters: {lose: true}}]
stop: {duration: 2s}
"""
    trace = recorded(job, code)
    export_bag(trace, tmp_path / "bag", topics=["/speed", "/point"])
    (tmp_path / "job.yaml").write_text(job.replace("true", "false"))
    result = rsltrace.replay(tmp_path / "job.yaml", node="stamped", bag=tmp_path / "bag")
    assert [change.change.value for change in result.changes] == ["new", "new"]
    tolerant = rsltrace.DiffOptions(absolute=(("point.x", 0.5),))
    assert (
        len(
            rsltrace.replay(
                tmp_path / "job.yaml", node="stamped", bag=tmp_path / "bag", options=tolerant
            ).changes
        )
        == 2
    )


@pytest.mark.long
def test_what_is_wrong_with_a_bag_is_said(robot: Path) -> None:
    export_bag(robot / "run.mcap", robot / "outputs", topics=["/smooth"])
    with pytest.raises(rsltrace.RsltraceError, match=r"subscribes to \(/speed\) is in there, only"):
        rsltrace.replay("job.yaml", node="filter", bag="outputs")
    with pytest.raises(rsltrace.RsltraceError, match="no node /fliter; did you mean"):
        rsltrace.replay("job.yaml", node="fliter", bag="bag")
    with pytest.raises(rsltrace.RsltraceError, match="a bag is for one node"):
        rsltrace.replay("run.mcap", bag="bag")  # type: ignore[call-overload]


@pytest.mark.long
def test_the_command(robot: Path) -> None:
    done = command("run.mcap", "--node", "/filter")
    assert done.exit_code == 0, done.output
    assert done.stderr.startswith("replaying /filter of run.mcap alone (job.yaml in .), with")
    assert done.stdout.startswith("/filter is unchanged: ")
    assert command("job.yaml", "--node", "/filter", "--bag", "bag", "-q").exit_code == 0
    change(robot, "0.125 * message.data", "0.25 * message.data")
    done = command("run.mcap", "--node", "/filter", "-q")
    assert done.exit_code == 1
    lines = done.stdout.splitlines()
    assert lines[0].startswith("/filter diverges: message /smooth at 0.1")
    assert lines[2].split() == ["time", "(s)", "output", "field", "recorded", "now"]
    assert lines[3].split()[1:3] == ["/smooth", "data"]
    assert lines[-1] == "and 15 more outputs (--all shows them)"
    assert len(command("run.mcap", "--node", "/filter", "-q", "--all").stdout.splitlines()) == 33
    first = command("run.mcap", "--node", "/filter", "--until-diverged", "--json")
    values = json.loads(first.stdout)
    assert (values["exit_code"], len(values["changes"]), values["same"]) == (1, 1, False)
    assert values["changes"][0]["fields"][0]["path"] == "data"
    assert command("run.mcap", "--node", "/filter", "--ignore", "data", "-q").exit_code == 0
    assert command("run.mcap", "--node", "/filter", "--abs", "data=100", "-q").exit_code == 0


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--bag", "bag"], "need --node"),
        (["--all"], "need --node"),
        (["--node", "filter", "--until", "3"], "have no effect with --node"),
        (["--node", "filter", "--bag", "bag", "--until-diverged"], "has no effect with --bag"),
    ],
)
def test_options_that_do_not_go_together(robot: Path, words: list[str], said: str) -> None:
    done = command("run.mcap", *words)
    assert done.exit_code == 2
    assert said in done.stderr


@pytest.mark.long
def test_in_a_test(robot: Path) -> None:
    assert assert_node_unchanged("run.mcap", "/filter").compared > 30
    change(robot, "0.75 * self.state", "0.7 * self.state")
    with pytest.raises(NodeChanged, match=r"(?s)/filter diverges: .*/smooth +data"):
        assert_node_unchanged("run.mcap", "/filter")
    with pytest.raises(NodeChanged, match="/smooth"):
        assert_node_unchanged(Path("job.yaml"), "/filter", bag=Path("bag"))


@pytest.mark.long
def test_the_fixture(robot: Path) -> None:
    (robot / "test_nodes.py").write_text(
        "def test_same(rsltrace_node):\n"
        "    assert rsltrace_node('run.mcap', '/source').compared\n"
        "def test_changed(rsltrace_node):\n"
        "    rsltrace_node('job.yaml', '/filter', bag='bag')\n"
    )
    change(robot, "0.75 * self.state", "0.7 * self.state")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_nodes.py"],
        cwd=robot,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "1 failed, 1 passed" in done.stdout, done.stdout
    assert "/filter diverges: message /smooth" in done.stdout
    assert "Traceback" not in done.stdout


@pytest.mark.long
@pytest.mark.skipif(not HUSKY.exists(), reason="the Husky recording is not here")
def test_nodes_of_the_husky_job(tmp_path: Path) -> None:
    """Each node fed from the trace of the job; the filter from the recording itself."""
    folder = ROOT / "examples/sensor_fusion"
    job = rsltrace.load_job(folder / "job_husky.yaml", overrides=["stop.duration=60s"])
    rsltrace.record(job, tmp_path / "run.mcap")
    for node in ("/ekf", "/track_monitor"):
        result = rsltrace.replay(tmp_path / "run.mcap", node=node, trust=True, job_folder=folder)
        assert result.same, result.sentence
    golden = tmp_path / "golden.mcap"
    rsltrace.replay(folder / "job_husky.yaml", node="ekf", bag=HUSKY, output=golden)
    with Trace.open(golden) as trace:
        assert trace.event_count > 16_000
    result = rsltrace.replay(golden, node="ekf", trust=True, job_folder=folder)
    assert result.same
    assert result.compared > 4_000
