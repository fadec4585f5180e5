"""A trace exported as a bag: what other tools read is what the nodes published."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import rsltrace
from rsltrace import Job, NodeSpec, RecordSpec, StopSpec, Trace
from rsltrace.errors import OutputError, TraceError
from rsltrace.trace.recordings import open_bag
from rsltrace.trace.recordings.export import check_bag_folder, export_bag

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
pytestmark = pytest.mark.ros


def _nodes() -> list[Any]:
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import Imu
    from std_msgs.msg import String

    class Source(Node):
        def __init__(self) -> None:
            super().__init__("source")
            latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.imu = self.create_publisher(Imu, "imu", 10)
            self.text = self.create_publisher(String, "text", latched)
            self.silent = self.create_publisher(String, "silent", 10)
            self.count = 0
            self.create_timer(0.01, self.tick)

        def tick(self) -> None:
            self.count += 1
            message = Imu()
            message.angular_velocity.x = self.count / 7
            message.header.stamp = self.get_clock().now().to_msg()
            self.imu.publish(message)
            if self.count % 10 == 0:
                self.text.publish(String(data=f"number {self.count}"))

    return [Source()]


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    job = Job(nodes=[NodeSpec(node=_nodes)], stop=StopSpec(duration="2s"), start="5s")
    rsltrace.record(job, tmp_path / "run.mcap")
    return tmp_path / "run.mcap"


def test_others_read_what_was_published(trace: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    count = export_bag(trace, tmp_path / "out", exclude=["/parameter_events"])
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["metadata.yaml", "out_0.mcap"]
    with AnyReader([tmp_path / "out"]) as bag:
        assert bag.message_count == count == 220
        assert (bag.start_time, bag.duration) == (5_010_000_000, 1_990_000_001)
        topics = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections}
        assert topics["/imu"] == ("sensor_msgs/msg/Imu", 200)
        assert not [topic for topic in topics if topic.startswith("/rsltrace")]
        (text,) = [c for c in bag.connections if c.topic == "/text"]
        assert text.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
        read = [
            (stamp, bag.deserialize(raw, connection.msgtype).angular_velocity.x)
            for connection, stamp, raw in bag.messages()
            if connection.topic == "/imu"
        ]
    assert read == [(5 * 10**9 + n * 10**7, n / 7) for n in range(1, 201)]


@pytest.mark.long
def test_our_reader_reads_the_same_as_from_the_trace(trace: Path, tmp_path: Path) -> None:
    export_bag(trace, tmp_path / "out", topics=["/imu", "/text"])
    with open_bag(tmp_path / "out") as bag, open_bag(trace, topics=["/imu", "/text"]) as original:
        assert list(bag.messages()) == list(original.messages())
        assert [(t.name, t.type_hash, t.qos, t.schema_text) for t in bag.topics] == [
            (t.name, t.type_hash, t.qos, t.schema_text) for t in original.topics
        ]
    again = Job(bags=[str(tmp_path / "out")])
    replayed = rsltrace.record(again, tmp_path / "again.mcap")
    assert replayed.events >= 220


@pytest.mark.long
def test_the_same_trace_gives_the_same_bag(trace: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        export_bag(trace, tmp_path / name / "out")
    for file in ("metadata.yaml", "out_0.mcap"):
        a, b = ((tmp_path / name / "out" / file).read_bytes() for name in ("a", "b"))
        assert a == b


@pytest.mark.long
def test_a_trace_without_messages_is_an_empty_bag(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    job = Job(
        nodes=[NodeSpec(node=_nodes)],
        stop=StopSpec(duration="0.1s"),
        record=RecordSpec(payloads=False),
    )
    rsltrace.record(job, tmp_path / "run.mcap")
    assert export_bag(tmp_path / "run.mcap", tmp_path / "out") == 0
    with AnyReader([tmp_path / "out"]) as bag:
        assert bag.message_count == 0


@pytest.mark.long
def test_a_cut_off_trace_gives_what_is_whole(trace: Path, tmp_path: Path) -> None:
    data = trace.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 3 // 4])
    count = export_bag(tmp_path / "cut.mcap", tmp_path / "out")
    with open_bag(tmp_path / "out") as bag:
        assert sum(1 for _ in bag.messages()) == count > 0


@pytest.mark.long
def test_nothing_is_lost_or_left_half_done(
    trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    export_bag(trace, out, topics=["/text"])
    before = (out / "metadata.yaml").read_bytes()
    with pytest.raises(OutputError, match="it exists; use --force"):
        export_bag(trace, out)
    with pytest.raises(TraceError):
        export_bag(tmp_path / "none.mcap", tmp_path / "other")

    real = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if ".part-" in self.name:
            raise OSError(28, "No space left on device")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(OutputError, match="No space left"):
        export_bag(trace, out, force=True)
    monkeypatch.undo()
    assert (out / "metadata.yaml").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "run.mcap"]
    export_bag(trace, out, force=True)
    assert (out / "metadata.yaml").read_bytes() != before


def test_force_replaces_bags_only(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("precious")
    with pytest.raises(OutputError, match="the existing folder is not a bag"):
        check_bag_folder(tmp_path / "home", force=True)
    with pytest.raises(OutputError, match="does not exist; create it"):
        check_bag_folder(tmp_path / "no" / "out", force=True)
    (tmp_path / "empty").mkdir()
    check_bag_folder(tmp_path / "empty", force=True)


@pytest.mark.long
def test_the_commands(trace: Path, tmp_path: Path) -> None:
    (tmp_path / "talk.py").write_text(
        "from rclpy.node import Node\n"
        "from std_msgs.msg import String\n"
        "class Talker(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('talker')\n"
        "        self.p = self.create_publisher(String, 'chatter', 10)\n"
        "        self.create_timer(0.5, lambda: self.p.publish(String(data='x')))\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: talk:Talker}]\nstop: {duration: 2s}\n")

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "rsltrace", *arguments],
            cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True, timeout=300,
            check=False,
        )  # fmt: skip

    done = call("record", "job.yaml", "-o", "t.mcap", "--export-bag", "bag")
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "t.mcap") as opened:
        assert opened.complete
    with open_bag(tmp_path / "bag", topics=["/chatter"]) as bag:
        assert bag.topics[0].message_count == 4
    refused = call("record", "job.yaml", "-o", "u.mcap", "--export-bag", "bag")
    assert (refused.returncode, (tmp_path / "u.mcap").exists()) == (2, False)
    assert "cannot write the bag bag: it exists" in refused.stderr
    assert (
        call("record", "job.yaml", "-o", "t.mcap", "--export-bag", "bag", "--force").returncode == 0
    )
    assert call("export", "t.mcap", "--bag", "other", "--topic", "/chatter").returncode == 0
    whole = (tmp_path / "t.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) - 300])
    cut = call("export", "cut.mcap", "--bag", "part")
    assert cut.returncode == 1
    assert "wrote part: 6 messages" in cut.stderr
    assert "note: cut.mcap is truncated: the bag has only the 6 messages" in cut.stderr
    assert "job.yaml is not a trace" in call("export", "job.yaml", "--bag", "third").stderr
