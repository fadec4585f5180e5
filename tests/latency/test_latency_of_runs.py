"""Latencies of a run of real nodes, against what their messages say; and the command."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

pytest.importorskip("rclpy")

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from rsltrace import Job, NodeSpec, StopSpec, Trace, record
from rsltrace.checks.latency.measure import ChainLatency, measure_latencies
from rsltrace.cli.main import cli
from rsltrace.trace.model.event import EventKind

pytestmark = pytest.mark.ros
MS = 1_000_000
RUNS_NS = 130 * MS


class Camera(Node):
    def __init__(self) -> None:
        super().__init__("camera")
        self.number = 0
        self.publisher = self.create_publisher(Int64, "/image", 10)
        self.create_timer(0.1, self.tick)

    def tick(self) -> None:
        self.number += 1
        self.publisher.publish(Int64(data=self.number))


class Detector(Node):
    """Too slow for its input, of which it keeps one message."""

    def __init__(self) -> None:
        super().__init__("detector")
        self.publisher = self.create_publisher(Int64, "/objects", 10)
        self.create_subscription(Int64, "/image", self.publisher.publish, 1)


class Controller(Node):
    """A timer that publishes what came last."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.last: Int64 | None = None
        self.publisher = self.create_publisher(Int64, "/cmd", 10)
        self.create_subscription(Int64, "/objects", self.hear, 10)
        self.create_timer(0.05, self.tick)

    def hear(self, message: Int64) -> None:
        self.last = message

    def tick(self) -> None:
        if self.last is not None:
            self.publisher.publish(self.last)


class Sleeper(Node):
    """Waits in its callback, and then for a service."""

    def __init__(self) -> None:
        super().__init__("sleeper")
        self.publisher = self.create_publisher(Int64, "/late", 10)
        self.client = self.create_client(Trigger, "/ask", callback_group=ReentrantCallbackGroup())
        self.create_subscription(Int64, "/objects", self.hear, 10)

    async def hear(self, message: Int64) -> None:
        self.get_clock().sleep_for(Duration(seconds=0.02))
        await self.client.call_async(Trigger.Request())
        self.publisher.publish(message)


class Server(Node):
    def __init__(self) -> None:
        super().__init__("server")
        self.create_service(Trigger, "/ask", lambda request, response: response)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a robot with all that takes time."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    nodes = [NodeSpec(node=one) for one in (Camera, Detector, Controller, Sleeper, Server)]
    job = Job(
        nodes=nodes,
        stop=StopSpec(duration=4),
        seed=3,
        delay={
            "topics": {
                "/image": {"constant": "3ms"},
                "/objects": {"uniform": {"min": "1ms", "max": "20ms"}},
            },
            "services": {"/ask": {"constant": "4ms"}},
        },
        execution={
            "nodes": {"/detector": {"constant": "130ms"}},
            "entities": [{"node": "/controller", "entity": "*tick*", "constant": "5ms"}],
        },
    )
    record(job, path)
    return path


def values(trace: Trace, topic: str) -> list[tuple[int, int]]:
    """Return number and time of the event of each message."""
    return [(trace.decode(topic, data).data, stamp) for stamp, _, data in trace.messages(topic)]


def only(trace: Trace, **options: Any) -> ChainLatency:
    (chain,) = measure_latencies(trace, **options).chains
    return chain


def test_ages_are_those_that_the_messages_tell(run: Path) -> None:
    with Trace.open(run) as trace:
        taken = dict(values(trace, "/image"))
        for topic, more_ns, options in (
            ("/objects", RUNS_NS, {}),
            ("/late", 0, {}),
            ("/cmd", 5 * MS, {"via": ["/controller"]}),
        ):
            chain = only(trace, start="/image", end=topic, **options)
            told = [stamp + more_ns - taken[number] for number, stamp in values(trace, topic)]
            assert len(told) > 15
            assert chain.durations("age").tolist() == told
            number, stamp = values(trace, topic)[told.index(max(told))]
            worst = chain.worst("age")
            assert worst is not None
            assert (worst.input_ns, worst.output_ns) == (taken[number], stamp + more_ns)
            assert trace.event(worst.output_event).stamp_ns == stamp


def test_a_chain_that_ends_in_a_node_ends_with_its_callback(run: Path) -> None:
    with Trace.open(run) as trace:
        taken, heard = dict(values(trace, "/image")), []
        for events in trace.events():
            for event in events.tolist():
                found = trace.event(event[1])
                entity = trace.entity(found.entity)
                node = trace.node_of(entity).name
                if found.kind is EventKind.SUBSCRIPTION and node == "/controller":
                    heard.append(found)
        numbers = [number for number, _ in values(trace, "/objects")]
        chain = only(trace, start="/image", end="/controller")
        told = [one.stamp_ns - taken[n] for one, n in zip(heard, numbers, strict=False)]
        assert chain.name == "/image → /objects → (/controller)"
        assert len(told) > 15
        assert chain.durations("age").tolist() == told
        assert chain.parts[-1].link.max() > 10 * MS


def test_where_the_time_goes_and_what_went_no_further(run: Path) -> None:
    with Trace.open(run) as trace:
        chain = only(trace, topics=["/image", "/objects", "/late"])
        images, objects = (len(values(trace, topic)) for topic in ("/image", "/objects"))
    detects, sleeps = chain.parts
    assert set(detects.link.tolist()) == {3 * MS}
    assert set(detects.runs.tolist()) == {RUNS_NS}
    assert detects.queue.max() > 30 * MS
    assert 1 * MS <= sleeps.link.min() < sleeps.link.max() <= 20 * MS
    assert (sleeps.held >= 28 * MS).all(), "it sleeps, and the service is 8 ms away"
    before, after = chain.passages
    assert before.sent == images == before.received + before.overwritten + before.waiting
    assert before.overwritten > 5
    assert before.received - objects in (0, 1), "the last callback may be at work at the end"
    assert after.sent == objects


def call(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["latency", *map(str, arguments)])


class Sampler(Node):
    """Publishes by a timer, and receives what it and others publish."""

    def __init__(self) -> None:
        super().__init__("sampler")
        publisher = self.create_publisher(Int64, "/x", 10)
        self.create_subscription(Int64, "/x", lambda _: None, 10)
        self.create_timer(0.1, lambda: publisher.publish(Int64()))


def test_of_many_nodes_that_sample_some_are_named(tmp_path: Path) -> None:
    nodes = tuple(NodeSpec(node=Sampler, name=f"n{number}") for number in range(9))
    record(Job(nodes=nodes, stop=StopSpec(duration="200ms")), tmp_path / "many.mcap")
    found = call(tmp_path / "many.mcap")
    assert found.exit_code == 2
    assert found.output.count("with no message as the cause") == 3
    assert "so do 6 more nodes" in found.output


def test_the_command_finds_chains_and_says_where_one_breaks(run: Path) -> None:
    found = call(run)
    assert found.exit_code == 0, found.output
    assert "/image → /objects → /late" in found.output
    assert "/controller publishes /cmd with no message as the cause" in found.output
    assert "--via /controller" in found.output
    broken = call(run, "--from", "/image", "--to", "/cmd")
    assert broken.exit_code == 2
    assert "/controller receives /objects and publishes /cmd" in broken.output
    assert "--via /controller" in broken.output
    named = call(run, "--from", "/imgae", "--to", "/cmd")
    assert named.exit_code == 2
    assert "nobody publishes /imgae; did you mean '/image'?" in named.output
    assert "no node is called /x" in call(run, "--via", "/x").output
    gap = call(run, "--chain", "/image,/late")
    assert gap.exit_code == 2
    assert "/objects may belong in between" in gap.output


def test_numbers_for_programs_are_those_of_the_table(run: Path) -> None:
    options = ("--from", "/image", "--to", "/cmd", "--via", "controller")
    (chain,) = json.loads(call(run, *options, "--format", "json").stdout)["chains"]
    rows = list(csv.DictReader(call(run, *options, "--format", "csv").stdout.splitlines()))
    ages = [int(row["age_ns"]) for row in rows]
    assert chain["age"]["max_ns"] == max(ages) == chain["age"]["worst"]["duration_ns"]
    assert chain["age"]["count"] == chain["outputs"] == len(rows)
    firsts = [int(row["age_ns"]) for row in rows if row["first"] == "1"]
    assert chain["latency"]["max_ns"] == max(firsts)
    parts = ("link_ns", "queue_ns", "held_ns", "runs_ns")
    assert all(sum(int(row[part]) for part in parts) == int(row["age_ns"]) for row in rows)
    assert f"--at {chain['latency']['worst']['output_event']}" in call(run, *options).output


def test_in_a_narrow_terminal_counts_are_below_times(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shown(width: int | None) -> list[str]:
        monkeypatch.setattr("rsltrace.cli.latency.terminal_width", lambda: width)
        text = call(run, "--from", "/image", "--to", "/cmd", "--via", "controller").stdout
        return text[text.index("  mean (max)") : text.index("  longest")].splitlines()

    (head, *rows), (narrow, *others) = shown(200), shown(115)
    assert shown(None) == [head, *rows]
    assert all(len(line) <= 115 for line in others)
    at = others.index(next(line for line in others if "messages" in line))
    assert narrow.split() + others[at].split()[1:] == head.split()
    for row, times, counts in zip(rows, others[:at], others[at + 1 :], strict=True):
        assert times.split() + counts.split()[3:] == row.split()


def test_two_traces_are_shown_with_their_difference(run: Path, tmp_path: Path) -> None:
    other = shutil.copy(run, tmp_path / "other.mcap")
    both = call(run, other, "--from", "/image", "--to", "/late", "--format", "json")
    (chain,) = json.loads(both.stdout)["chains"]
    assert chain["a"] == chain["b"]
    assert set(chain["difference"]["latency"].values()) == {0}
    assert "b − a" in call(run, other).output
