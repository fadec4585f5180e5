"""One node of a trace alone does what it did in the graph, whatever the job is made of."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace.checks.latency.flow import MessageFlow
from rsltrace.checks.latency.paths import ChainSelection
from rsltrace.diff.why.history import RunHistory
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.replay.test_jobs_replay import EXAMPLES, FEATURES
from tests.run.conftest import TALKER
from tests.run.test_recorded_order import ALL, MIXED

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]


SHORT = ("job_heap", "sensor_fusion", "missing_event", "delayed_input")
SHORT_FEATURES = ("", "a policy of one's own", "delays", "execution times")


def some(all_of_them: Iterable[Any], short: tuple[str, ...]) -> list[Any]:
    """Return parameters; those that name none of ``short`` are for the long campaigns."""
    found = []
    for one in all_of_them:
        values = one if isinstance(one, tuple) else (one,)
        is_short = values[0] in short or any(name and name in values[0] for name in short)
        found.append(pytest.param(*values, marks=() if is_short else pytest.mark.long))
    return found


def nodes_of(trace: Path) -> list[str]:
    """Return the names of the nodes in a trace."""
    with Trace.open(trace) as opened:
        nodes = (e.name for e in opened.entities.values() if e.kind is EntityKind.NODE)
        return list(dict.fromkeys(nodes))


def events_of(trace: Path, node: str) -> list[tuple[int, int, int]]:
    """Return (simulated time, kind, input hash) of the events of a node."""
    with Trace.open(trace) as opened:
        own = {e.id for e in opened.entities.values() if opened.node_of(e).name == node}
        return [
            (int(row["stamp"]), int(row["kind"]), int(row["input_hash"]))
            for rows in opened.events()
            for row in rows
            if int(row["entity"]) in own
        ]


def unchanged(
    trace: Path, folder: Path, *, without: tuple[str, ...] = (), twice: bool = False
) -> None:
    """See that each node alone does the same: its outputs, and its events with their inputs.

    ``twice``: also when it is fed from the trace of that.
    """
    names = [name for name in nodes_of(trace) if name not in without]
    assert len(names) > 1
    for name in names:
        again = trace.with_name("alone.mcap")
        result = rsltrace.replay(
            trace, node=name, trust=True, job_folder=folder, output=again, force=True
        )
        assert result.same, result.sentence
        assert result.exit_code == 0
        assert result.compared > 0
        assert events_of(again, name) == events_of(trace, name)
        if not twice:
            continue
        once_more = rsltrace.replay(again, node=name, trust=True, job_folder=folder)
        assert once_more.same, once_more.sentence
        assert once_more.compared == result.compared


@pytest.mark.long
@pytest.mark.parametrize(("job", "overrides"), some(EXAMPLES, SHORT))
def test_each_node_of_the_examples(
    job: str, overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The monitor of the determinism network reads the states of the others, as no robot could."""
    if "benchmark8" in job:
        pytest.skip("one entry makes all of its nodes")
    assert run(load_job(ROOT / job, overrides=overrides), tmp_path / "run.mcap").error is None
    monkeypatch.chdir(tmp_path)
    unchanged(tmp_path / "run.mcap", (ROOT / job).parent, without=("/monitor",))


@pytest.mark.long
@pytest.mark.parametrize("feature", some(["", *FEATURES], SHORT_FEATURES))
def test_mains_threads_services_and_blocking_calls(feature: str, tmp_path: Path) -> None:
    (tmp_path / "nodes_under_test.py").write_text(TALKER + MIXED)
    (tmp_path / "job.yaml").write_text(ALL + FEATURES.get(feature, "") + "seed: 5\n")
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap").error is None
    unchanged(tmp_path / "run.mcap", tmp_path, twice=not feature)


TIMED = """
import time
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

class Server(Node):
    def __init__(self):
        super().__init__('server')
        self.create_service(Trigger, 'asked', self.answer)
    def answer(self, request, response):
        time.sleep(0.004)
        return response

class Asker(Node):
    def __init__(self):
        super().__init__('asker')
        group = ReentrantCallbackGroup()
        self.client = self.create_client(Trigger, 'asked', callback_group=group)
        self.said = self.create_publisher(String, 'said', 10)
        self.create_timer(0.05, self.wait, callback_group=group)
        self.create_timer(0.03, self.block, callback_group=group)
    def say(self, what):
        self.said.publish(String(data=what))
    async def wait(self):
        self.say('coroutine')
        await self.client.call_async(Trigger.Request())
        self.say('coroutine goes on')
        time.sleep(0.003)
        self.say('coroutine has slept')
    def block(self):
        self.say('callback')
        time.sleep(0.002)
        self.say('callback has slept')
        self.client.call(Trigger.Request())
        self.say('callback goes on')

class Echo(Node):
    def __init__(self):
        super().__init__('echo')
        self.heard = self.create_publisher(String, 'heard', 10)
        self.create_subscription(String, 'said', self.heard.publish, 10)
"""


@pytest.mark.parametrize("more", ["", "delay: {default: {uniform: {min: 0ms, max: 3ms}}}\n"])
@pytest.mark.parametrize("times", ["nodes: {/asker: 1ms}", "default: 1ms"])
def test_what_waiting_callbacks_with_execution_times_send(
    times: str, more: str, tmp_path: Path
) -> None:
    """After blocking calls it leaves with the execution time; of coroutines that go on at once."""
    (tmp_path / "timed.py").write_text(TIMED)
    nodes = "".join(f"  - {{node: timed:{name}}}\n" for name in ("Server", "Asker", "Echo"))
    (tmp_path / "job.yaml").write_text(
        f"nodes:\n{nodes}execution: {{{times}}}\nexecutors: [{{nodes: [/asker], workers: 3}}]\n"
        f"{more}stop: {{duration: 400ms}}\nseed: 3\n"
    )
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap").error is None
    unchanged(tmp_path / "run.mcap", tmp_path)
    if "/asker" in times and not more:
        said_is_heard_when_it_left(tmp_path / "run.mcap")


def said_is_heard_when_it_left(path: Path) -> None:
    """The echo takes no time and links none, so what left is received at that time."""
    with Trace.open(path) as trace:
        (said,) = (one for one in trace.entities.values() if (one.name, one.kind) == SAID)
        (heard,) = (one for one in trace.entities.values() if (one.name, one.kind) == HEARD)
        history = RunHistory(trace)
        messages = history.messages([said], heard.id)
        assert {one.left_ns - one.sent_ns for one in messages} == {0, 1_000_000}
        for one in messages:
            assert one.taken is None or history.stamp(one.taken) == one.left_ns
        flow = MessageFlow(trace, ChainSelection())
        for events, outputs in zip(trace.events(), trace.outputs(), strict=True):
            flow.read(events, outputs)
        left_ns = flow.messages["published"]
        taken = zip(flow.taken["message"], flow.taken["began"], strict=True)
        received = [(began_ns, left_ns[message]) for message, began_ns in taken]
        assert received
        assert all(began_ns == sent_ns for began_ns, sent_ns in received)


SAID, HEARD = ("/said", EntityKind.PUBLISHER), ("/said", EntityKind.SUBSCRIPTION)


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("test_msgs") is None, reason="needs ROS 2's test_msgs")
@pytest.mark.parametrize(
    "more", ["", "delay: {default: {uniform: {min: 1ms, max: 30ms}}}\n", "policy: permutation\n"]
)
def test_actions_lifecycles_and_parameters_set_from_outside(more: str, tmp_path: Path) -> None:
    programs = ("fibonacci_server", "fibonacci_client", "camera", "camera_manager")
    nodes = "".join(f"  - {{main: demo_interactions.{name}:main}}\n" for name in programs)
    folder = ROOT / "tests/demos/demo_interactions"
    (tmp_path / "job.yaml").write_text(
        f"nodes:\n{nodes}search_path: [{folder}]\nstop: {{duration: 5s}}\nseed: 3\n{more}"
    )
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap").error is None
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert any((rows["kind"] == EventKind.ACTION).any() for rows in trace.events())
    unchanged(tmp_path / "run.mcap", tmp_path, twice=True)


def test_a_changed_node_is_seen_at_its_first_changed_output(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    trace = recorded()
    code = tmp_path / "nodes_of_replay.py"
    code.write_text(code.read_text().replace("self.warned += 3", "self.warned += 4"))
    result = rsltrace.replay(trace, node="watch", trust=True)
    assert result.node == "/watch"
    assert result.exit_code == 1
    assert result.first is not None
    assert (result.first.kind, result.first.name) == ("log", "/rosout")
    assert result.first.change.value == "changed"
    assert result.first.fields[0].path == "msg"
    assert any("its inputs are the recorded ones" in note for note in result.notes)
    first_only = rsltrace.replay(trace, node="watch", trust=True, until_diverged=True)
    assert first_only.changes == (result.first,)
    assert first_only.end_ns <= result.first.time_ns + 100_000_000
    assert rsltrace.replay(trace, node="source", trust=True).same
    assert rsltrace.replay(trace, node="filter", trust=True).same


@pytest.mark.long
def test_others_need_not_be_there(recorded: Callable[..., Path], tmp_path: Path) -> None:
    """The code of the other nodes may be gone, or broken: it is not imported."""
    job = """\
nodes:
  - {node: nodes_of_replay:Source, parameters: {gain: 2.0}}
  - {node: filter_of_replay:Filter}
stop: {duration: 1s}
"""
    (tmp_path / "filter_of_replay.py").write_text("from nodes_of_replay import Filter\n")
    trace = recorded(job)
    (tmp_path / "filter_of_replay.py").write_text("raise SystemExit('never imported')\n")
    assert rsltrace.replay(trace, node="source", trust=True).same


def test_what_the_trace_does_not_hold_is_named(recorded: Callable[..., Path]) -> None:
    job = """\
nodes: [{node: nodes_of_replay:Source}, {node: nodes_of_replay:Filter}]
stop: {duration: 1s}
record: {exclude: [/speed]}
"""
    trace = recorded(job)
    with pytest.raises(
        rsltrace.RsltraceError, match=r"does not hold what /filter got on /speed: .*record\.exclude"
    ):
        rsltrace.replay(trace, node="filter", trust=True)
    assert rsltrace.replay(trace, node="source", trust=True).same


@pytest.mark.long
def test_wrong_names_and_whole_replays_of_a_part(
    recorded: Callable[..., Path], tmp_path: Path
) -> None:
    trace = recorded()
    with pytest.raises(rsltrace.RsltraceError, match=r"no node /wach; did you mean '/watch'"):
        rsltrace.replay(trace, node="wach", trust=True)
    rsltrace.replay(trace, node="watch", trust=True, output=tmp_path / "alone.mcap")
    with pytest.raises(rsltrace.RsltraceError, match="replay it with --node /watch"):
        rsltrace.replay(tmp_path / "alone.mcap", trust=True)


@pytest.mark.long
def test_a_node_that_raises_as_recorded_is_the_same(recorded: Callable[..., Path]) -> None:
    code = """
class Fragile(Watch):
    def got(self, message):
        super().got(message)
        if message.data > 3.0:
            raise ValueError(f'{message.data} is too much')
"""
    job = """\
nodes: [{node: nodes_of_replay:Source}, {node: nodes_of_replay:Filter},
        {node: nodes_of_replay:Fragile}]
stop: {duration: 3s}
"""
    trace = recorded(job, code)
    result = rsltrace.replay(trace, node="watch", trust=True)
    assert result.same
    assert result.error is not None
    assert rsltrace.replay(trace, node="filter", trust=True).same


@pytest.mark.long
def test_traces_that_were_cut_off(recorded: Callable[..., Path], tmp_path: Path) -> None:
    trace = recorded(overrides=["record.segment_events=16"])
    data = trace.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 3 // 5])
    result: Any = rsltrace.replay(cut, node="filter", trust=True)
    assert result.same, result.sentence
    assert any("cut off" in note for note in result.notes)
