"""A native run is run again: in its order, with its messages, and at its times."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rsltrace import replay
from rsltrace.errors import ReplayError
from rsltrace.search.explore.table import result_rows
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.native.running import COMMAND, PATIENCE_S, environment

pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]

NODES = """\
import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Header, UInt64
from std_srvs.srv import Trigger


class Talker(Node):
    def __init__(self, name, first):
        super().__init__(name)
        self.out = self.create_publisher(UInt64, "/numbers", 1)
        self.number = first
        self.create_timer(0.005, self.on_timer)

    def on_timer(self):
        self.number += 1
        self.out.publish(UInt64(data=self.number))


class Mixer(Node):
    # What it publishes depends on the order of all that it has heard and done. It asks once the
    # server has heard it: their clients and services, created first, have then been discovered.
    def __init__(self):
        super().__init__("mixer")
        self.mixed = self.answers = 0
        self.asks = False
        self.client = self.create_client(Trigger, "/ask")
        self.out = self.create_publisher(UInt64, "/mixed", 10)
        self.stamped = self.create_publisher(Header, "/stamped", 10)
        self.create_subscription(UInt64, "/numbers", self.on_number, 1)
        self.create_subscription(UInt64, "/heard", self.on_heard, 10)
        self.create_timer(0.011, self.on_timer)

    def mix(self, number):
        self.mixed = (self.mixed * 31 + number) % (1 << 60)

    def on_number(self, message):
        self.mix(message.data)
        self.out.publish(UInt64(data=self.mixed))

    def on_timer(self):
        self.mix(1)
        self.stamped.publish(Header(stamp=self.get_clock().now().to_msg()))
        if self.asks:
            self.client.call_async(Trigger.Request()).add_done_callback(self.on_answer)

    def on_heard(self, message):
        self.asks = True

    def on_answer(self, future):
        self.answers += len(future.result().message)  # a task, which has no turn


class Server(Node):
    # Publishes /over when it has heard and been asked often enough, however long that takes.
    def __init__(self):
        super().__init__("server")
        self.last = ""
        self.heard = self.asked = 0
        self.create_service(Trigger, "/ask", self.on_ask)
        self.over = self.create_publisher(UInt64, "/over", 10)
        self.heard_one = self.create_publisher(UInt64, "/heard", 10)
        self.create_subscription(UInt64, "/mixed", self.on_mixed, 10)

    def count(self):
        if self.heard >= 60 and self.asked >= 20:
            self.over.publish(UInt64(data=self.heard))

    def on_mixed(self, message):
        self.last = str(message.data)
        self.heard += 1
        self.heard_one.publish(message)
        self.count()

    def on_ask(self, request, response):
        response.message = self.last
        self.asked += 1
        self.count()
        return response


def serve():
    rclpy.init()
    node, executor = Server(), MultiThreadedExecutor(2)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    # Its threads end before the node does, which may crash otherwise: rclpy's own shutdown does not
    # wait for them. And the node ends before the program.
    executor._executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
"""
JOB = """\
nodes:
  - {node: mixing:Talker, arguments: {name: a, first: 1000}}
  - {node: mixing:Talker, arguments: {name: b, first: 2000}}
  - node: mixing:Mixer
  - SERVER
stop: {topic: /over, timeout: 240s}
"""


def recorded(folder: Path, server: str, *words: str) -> None:
    """Record ``native.mcap`` in a folder, which is the working directory."""
    (folder / "mixing.py").write_text(NODES)
    (folder / "serving.py").write_text("import mixing\nmixing.serve()\n")
    (folder / "job.yaml").write_text(JOB.replace("SERVER", server))
    started = [*COMMAND, "record", "--native", "job.yaml", "-o", "native.mcap", "-q", *words]
    subprocess.run(started, cwd=folder, env=environment(folder), check=True, timeout=PATIENCE_S)


def middle_of_mixed(path: str) -> int:
    """Return the event that sent the middle message on /mixed: an edit there has consequences."""
    with Trace.open(Path(path)) as trace:
        events = [index for _, index, _ in trace.messages("/mixed")]
    return events[len(events) // 2]


def starts(trace: Trace) -> dict[str, list[int]]:
    """Return when the calls of each node's timer began."""
    found: dict[str, list[int]] = {}
    for index in range(trace.event_count):
        event = trace.event(index)
        if event.kind is EventKind.TIMER:
            node = trace.node_of(trace.entity(event.entity)).name
            found.setdefault(node, []).append(event.stamp_ns)
    return found


@pytest.mark.parametrize(
    ("server", "words"),
    [
        ("node: mixing:Server", ()),
        ("node: mixing:Server", ("--executor", "multi")),
        ("main: mixing:serve", ()),
        ("{script: serving.py, isolated: true}", ()),
    ],
    ids=["one process", "threads", "processes", "isolated"],
)
def test_a_replay_does_what_the_native_run_did(
    tmp_path: Path, command: Any, server: str, words: tuple[str, ...]
) -> None:
    recorded(tmp_path, server, *words)
    done = command("replay", "native.mcap", "-q", "-o", "again.mcap")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the messages are the same except for times" in " ".join(done.stdout.split())
    said = " ".join(done.stdout.split())
    assert "common callbacks started in the same order" in said
    assert "callbacks of native.mcap ran in its order" in done.stderr
    assert "note: all " in done.stderr
    first = replay("native.mcap")
    assert first.diff is None
    assert "the messages are the same except for times" in first.sentence
    with Trace.open(Path("native.mcap")) as native, Trace.open(Path("again.mcap")) as again:
        assert again.digest == first.digest
        assert starts(native) == starts(again)
        stamps = [
            [(one.stamp.sec, one.stamp.nanosec) for one in decoded]
            for decoded in (
                [trace.decode("/stamped", data) for _, _, data in trace.messages("/stamped")]
                for trace in (native, again)
            )
        ]
        late_ns = [
            (a[0] - b[0]) * 10**9 + a[1] - b[1] for a, b in zip(stamps[0], stamps[1], strict=True)
        ]
        assert min(late_ns) >= 0  # the callback had begun when it read the clock
    verified = command("replay", "again.mcap", "-q")
    assert verified.returncode == 0, verified.stderr
    assert "verified all" in verified.stdout
    edit = f'{middle_of_mixed("again.mcap")}: node("/mixer").mixed = 7'
    branch = command("replay", "again.mcap", "-q", "--edit", edit)
    assert branch.returncode == 1, branch.stderr
    assert "/mixed" in branch.stdout


def test_one_node_alone_and_changed_code(tmp_path: Path, command: Any) -> None:
    recorded(tmp_path, "node: mixing:Server", "--processes")
    done = command("replay", "native.mcap", "-q", "--node", "/mixer", "-o", "alone.mcap")
    assert done.returncode == 0, done.stdout + done.stderr
    with Trace.open(Path("alone.mcap")) as alone:
        callbacks = [alone.event(index) for index in range(alone.event_count)]
        nodes = {alone.node_of(alone.entity(one.entity)).name for one in callbacks if one.entity}
        assert any(one.kind is EventKind.BAG for one in callbacks)
        timers = [one for one in callbacks if one.kind is EventKind.TIMER]
        assert {alone.node_of(alone.entity(one.entity)).name for one in timers} == {"/mixer"}
        assert {"/mixer", "/a", "/b"} <= nodes
    file = tmp_path / "mixing.py"
    file.write_text(NODES.replace("* 31", "* 33"))
    other = command("replay", "native.mcap", "-q", "--node", "/mixer")
    assert other.returncode == 1, other.stderr
    assert re.search("first on /mixed: message [01] has a different data", other.stdout)
    file.write_text(NODES.replace("        self.out.publish(UInt64(data=self.number))\n", ""))
    silent = command("replay", "native.mcap", "-q")
    assert silent.returncode == 1
    assert "/mixer: subscription /numbers with message " in silent.stderr
    assert "that message was not sent here" in silent.stderr


RACE = """\
from rclpy.node import Node
from std_msgs.msg import UInt64


class Ticker(Node):
    def __init__(self):
        super().__init__("ticker")
        self.out = self.create_publisher(UInt64, "/tick", 10)
        self.count = 0
        self.create_timer(0.02, self.on_timer)

    def on_timer(self):
        self.count += 1
        self.out.publish(UInt64(data=self.count))


class Sensor(Node):
    def __init__(self, name, topic):
        super().__init__(name)
        out = self.create_publisher(UInt64, topic, 10)
        self.create_subscription(UInt64, "/tick", out.publish, 10)


class Fuse(Node):
    def __init__(self):
        super().__init__("fuse")
        self.a = 0
        self.over = self.create_publisher(UInt64, "/over", 10)
        self.create_subscription(UInt64, "/a", self.on_a, 10)
        self.create_subscription(UInt64, "/b", self.on_b, 10)

    def on_a(self, message):
        self.a = message.data

    def on_b(self, message):
        if message.data > LIMIT and self.a < message.data:
            raise ValueError("b before a")
        if message.data >= 60:
            self.over.publish(message)


LIMIT = 1 << 60
"""
RACING = """\
nodes:
  - node: racing:Ticker
  - {node: racing:Sensor, arguments: {name: sensor_a, topic: /a}}
  - {node: racing:Sensor, arguments: {name: sensor_b, topic: /b}}
  - node: racing:Fuse
stop: {topic: /over, timeout: 240s}
"""


@pytest.mark.long
def test_other_orders_from_a_time_on(tmp_path: Path, command: Any) -> None:
    (tmp_path / "racing.py").write_text(RACE)
    (tmp_path / "job.yaml").write_text(RACING)
    started = [*COMMAND, "record", "--native", "job.yaml", "-o", "native.mcap", "-q"]
    subprocess.run(started, cwd=tmp_path, env=environment(tmp_path), check=True, timeout=300)
    command("replay", "native.mcap", "-q", "-o", "again.mcap")
    with Trace.open(Path("again.mcap")) as trace:
        half_ns = [stamp_ns for stamp_ns, _, _ in trace.messages("/tick")][30]
        ticks = sum(stamp_ns <= half_ns for stamp_ns, _, _ in trace.messages("/tick"))
        since_start = f"{half_ns - trace.start_ns}ns"
    (tmp_path / "racing.py").write_text(RACE.replace("1 << 60", str(ticks + 2)))  # only then
    words = ("--strategy", "random", "--budget", "4", "--jobs", "1", "-q")
    done = command("explore", "native.mcap", "--fork-after", since_start, *words)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "exception: /fuse: subscription /b" in done.stdout
    plain, *found = result_rows(Path("native.explore"))
    assert plain.failure is None
    assert found[-1].is_forked
    assert len({row.digest for row in (plain, *found)}) == 4
    shown = next(row for row in found if row.failure is not None)
    again = shlex.split(re.search("reproduce: rsltrace (.*)", done.stdout)[1])  # type: ignore[index]
    repeated = command(*again, "-q", "-o", "found.mcap")
    assert f"digest {shown.digest}  events {shown.events}" in repeated.stdout
    with Trace.open(Path("again.mcap")) as a, Trace.open(Path("found.mcap")) as b:
        before = [
            [tuple(row) for rows in one.events() for row in rows if row["stamp"] <= half_ns]
            for one in (a, b)
        ]
    assert before[0] == before[1]
    assert command("replay", shown.trace, "-q").returncode == 0
    late = command("explore", "native.mcap", "--fork-after", "1h", "-o", "late")
    assert "--fork-after: native.mcap ends at " in late.stderr
    simulated = command("explore", "again.mcap")
    assert "again.mcap is of a simulated run: explore its job" in simulated.stderr


def test_a_run_without_callbacks_is_run_again(tmp_path: Path, command: Any) -> None:
    (tmp_path / "talking.py").write_text(
        "import rclpy\nfrom std_msgs.msg import String\n\ndef main():\n    rclpy.init()\n"
        "    node = rclpy.create_node('a')\n"
        "    node.create_publisher(String, '/t', 1).publish(String())\n"
        "    node.destroy_node()\n    rclpy.shutdown()\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{main: 'talking:main'}]\n")
    assert command("record", "--native", "job.yaml", "-o", "native.mcap").returncode == 0
    done = command("replay", "native.mcap", "-q")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_debugger_runs_it_again(tmp_path: Path, command: Any) -> None:
    recorded(tmp_path, "node: mixing:Server")
    words = ("-c", "break topic /mixed", "-c", "continue", "-c", "reverse-step", "-c", "continue")
    done = command("debug", "native.mcap", "-q", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("breakpoint 1 (topic /mixed)") == 2
    with pytest.raises(ReplayError, match="edit a replay of it"):
        replay("native.mcap", edits='9: node("/mixer").mixed = 7')
