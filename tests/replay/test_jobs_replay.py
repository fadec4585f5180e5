"""Whatever a job is made of, its trace replays with every event verified, and to the same bytes."""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.export import export_bag
from tests.guard.conftest import node_code
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]


def replayed(trace: Path, **options: Any) -> rsltrace.ReplayResult:
    """Replay a trace, keep the replay's own, and see that the two are the same."""
    output = trace.with_name("again.mcap")
    result = rsltrace.replay(trace, trust=True, output=output, force=True, **options)
    assert result.exit_code == 0, result.sentence
    assert not result.diverged
    with Trace.open(trace) as recorded:
        assert (result.verified, result.digest) == (recorded.event_count, recorded.digest)
        assert result.events == recorded.event_count
    assert result.is_whole
    assert output.read_bytes() == trace.read_bytes()
    return result


EXAMPLES = [
    ("examples/benchmark8/job.yaml", ("stop.duration=1s",)),
    ("examples/ping_pong/job.yaml", ("stop.duration=0.5s",)),
    ("examples/rslcpp_determinism/job.yaml", ("stop.duration=8s",)),
    ("examples/rslcpp_determinism/job_heap.yaml", ("stop.duration=8s",)),
    ("examples/sensor_fusion/job.yaml", ("stop.duration=2s",)),
    *((f"sample_traces/{name}", ()) for name in ("delayed_input/job.yaml", "schedule/job_b.yaml")),
    ("sample_traces/missing_event/job.yaml", ()),
]


@pytest.mark.few(1)
@pytest.mark.parametrize(("job", "overrides"), EXAMPLES)
def test_examples_and_samples(
    job: str, overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From another folder, with what the command line said of the job in the trace alone."""
    done = run(load_job(ROOT / job, overrides=overrides), tmp_path / "run.mcap")
    assert done.error is None
    monkeypatch.chdir(tmp_path)
    replayed(tmp_path / "run.mcap", job_folder=(ROOT / job).parent)


def test_the_nondeterministic_sample_is_told_truthfully() -> None:
    """It sums a set whose order follows the hash seed, which this process did not choose."""
    folder = ROOT / "sample_traces/nondeterministic_callback"
    result = rsltrace.replay(folder / "a.mcap", trust=True)
    if result.diverged:
        assert result.diff is not None
        assert result.diff.verdict.value == "same-input-different-output"
        assert result.verified == result.diff.agreeing
    else:
        assert result.is_whole


FEATURES = {
    "a policy": "policy: permutation\n",
    "a policy of one's own": "policy: {function: nodes_under_test:Turns}\n",
    "priorities": "policy: {priority: [{node: /in_main, priority: 3}]}\n",
    "delays": "delay: {default: {uniform: {min: 1ms, max: 30ms}}, outages: "
    "[{node: /listener, from: 100ms, to: 200ms}]}\n",
    "losses": "delay: {topics: {/numbers: {normal: {mean: 5ms, sd: 2ms}, drop: 0.2}}}\n",
    "execution times": "executors: single_threaded\n"
    "execution: {default: {normal: {mean: 3ms, sd: 1ms}}}\n",
    "clocks": "clocks: [{node: /one, offset: -20ms, drift: 50ppm, "
    "random_jumps: {every: 100ms, most: 5ms}}]\n",
    "states": "guard: {state: record}\nmin_time_step: 1ms\n",
}


@pytest.mark.few(1)
@pytest.mark.parametrize("feature", FEATURES)
def test_mains_threads_and_calls_that_block(feature: str, tmp_path: Path) -> None:
    (tmp_path / "nodes_under_test.py").write_text(TALKER + MIXED)
    (tmp_path / "job.yaml").write_text(ALL + FEATURES[feature] + "seed: 5\n")
    done = run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    assert done.error is None
    assert done.events > 80
    replayed(tmp_path / "run.mcap")


@pytest.mark.long
def test_a_recorded_order_is_in_the_trace_itself(tmp_path: Path) -> None:
    """The recording whose order a run followed may be gone: the run's own trace has that order."""
    (tmp_path / "nodes_under_test.py").write_text(TALKER + MIXED)
    (tmp_path / "job.yaml").write_text(ALL + "policy: permutation\nseed: 5\n")
    run(load_job(tmp_path / "job.yaml"), tmp_path / "first.mcap")
    (tmp_path / "job.yaml").write_text(ALL + "policy: {recorded: first.mcap}\n")
    run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    replayed(tmp_path / "run.mcap")
    (tmp_path / "first.mcap").unlink()
    result = rsltrace.replay(tmp_path / "run.mcap", trust=True)
    assert result.is_whole


@pytest.mark.few(1)
@pytest.mark.parametrize("until", ["5", "20", None])
def test_what_a_replay_has_not_come_to_is_no_note(
    recorded: Callable[..., Path], until: str | None
) -> None:
    """It ends where it was asked to; in the job's own run there is that choice, and that fault."""
    path = recorded(
        """\
nodes:
  - node: nodes_of_replay:Source
  - node: nodes_of_replay:Filter
  - {node: nodes_of_replay:Filter, name: other}
policy: {departures: [{choice: 5, run: 1}]}
faults: [{crash: /other, at: 2.5s}]
stop: {duration: 3s}
"""
    )
    result = rsltrace.replay(path, until=until, trust=True)
    assert not result.diverged
    assert result.is_whole == (until is None)
    assert result.notes == ()


@pytest.mark.skipif(importlib.util.find_spec("test_msgs") is None, reason="needs ROS 2's test_msgs")
def test_actions_and_lifecycles(tmp_path: Path) -> None:
    programs = ("fibonacci_server", "fibonacci_client", "camera", "camera_manager")
    nodes = "".join(f"  - {{main: demo_interactions.{name}:main}}\n" for name in programs)
    folder = ROOT / "tests/demos/demo_interactions"
    (tmp_path / "job.yaml").write_text(
        f"nodes:\n{nodes}search_path: [{folder}]\nstop: {{duration: 5s}}\n"
    )
    run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert any((rows["kind"] == EventKind.ACTION).any() for rows in trace.events())
    replayed(tmp_path / "run.mcap")


@pytest.mark.long
def test_bags(recorded: Callable[..., Path], tmp_path: Path) -> None:
    export_bag(recorded(), tmp_path / "bag", topics=["/speed"])
    bag = recorded("nodes: [{node: nodes_of_replay:Filter}]\nbags: [bag]\n", name="from_bag.mcap")
    replayed(bag)
    shutil.move(tmp_path / "bag", tmp_path / "elsewhere")
    with pytest.raises(
        rsltrace.RsltraceError, match=r"bags.0..path: .bag.: there is no such bag; .* --job-folder"
    ):
        rsltrace.replay(bag, trust=True)


@pytest.mark.long
def test_another_bag_is_seen_at_its_first_message(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    export_bag(recorded(), tmp_path / "bag", topics=["/speed"])
    job = "nodes: [{node: nodes_of_replay:Filter}]\nbags: [bag]\n"
    trace = recorded(job, name="from_bag.mcap")
    other = recorded(overrides=["nodes.0.parameters.gain=3.0"], name="other.mcap")
    export_bag(other, tmp_path / "bag", topics=["/speed"], force=True)
    (tmp_path / "job.yaml").write_text(job)
    result = rsltrace.replay(trace, trust=True)
    assert result.diff is not None
    assert result.diff.divergences[0].root.value == "external-input"


def test_launch_files_with_arguments(recorded: Callable[..., Path], tmp_path: Path) -> None:
    """The trace has the nodes: the launch file is not read again, nor its arguments asked for."""
    (tmp_path / "demo.launch.xml").write_text(
        '<launch><arg name="gain" default="1.0"/>'
        '<node_container pkg="rclpy_components" exec="container" name="c" namespace="">'
        '<composable_node pkg="demo" plugin="nodes_of_replay.Source" name="from_launch">'
        '<param name="gain" value="$(var gain)"/></composable_node>'
        "</node_container></launch>"
    )
    job = "launch: [{file: demo.launch.xml, arguments: {gain: '4.5'}}]\nstop: {duration: 1s}\n"
    trace = recorded(job)
    (tmp_path / "demo.launch.xml").unlink()
    assert replayed(trace).events > 10


def test_what_came_from_outside_is_given_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = node_code(
        "self.say(time.time(), random.random(), os.environ.get('SHIFT'), open(FILE).read())",
        imports="import os, random, time",
        module=f"FILE = {str(tmp_path / 'config.txt')!r}",
    )
    (tmp_path / "config.txt").write_text("first")
    monkeypatch.setenv("SHIFT", "7")
    (tmp_path / "m.py").write_text(code)
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'm:N', guard: {file: {mode: record, allow: [x]}}}]\n"
        "stop: {duration: 1.2s}\n"
        "guard: {clock: record, random: record, environment: record, file: {allow: [y]}}\n"
    )
    first = run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    assert first.error is None
    (tmp_path / "config.txt").write_text("second")
    monkeypatch.delenv("SHIFT")
    replayed(tmp_path / "run.mcap")


def test_a_job_made_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Classes are found again by their names; of local ones the job itself is given."""
    from rclpy.node import Node

    class Local(Node):
        def __init__(self) -> None:
            super().__init__("local")
            self.create_timer(0.1, lambda: self.get_logger().info("tick"))

    monkeypatch.chdir(tmp_path)
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node=Local)], stop=rsltrace.StopSpec(duration="1s"))
    rsltrace.record(job, "run.mcap")
    with pytest.raises(rsltrace.RsltraceError, match="Local"):
        rsltrace.replay("run.mcap", trust=True)
    assert rsltrace.replay("run.mcap", job=job).is_whole


def test_the_folder_of_the_caller_stays(recorded: Callable[..., Path]) -> None:
    before = os.getcwd()
    rsltrace.replay(recorded(), trust=True, until=5)
    assert os.getcwd() == before
