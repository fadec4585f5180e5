"""Bags as input: recorded times exactly, canonical bytes; what is wrong is said early."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Trace, load_job
from rsltrace.errors import BagError

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("RSLTRACE_DATA", ROOT.parent / "shared" / "data"))
STAMPS = [1_700_000_000_000_000_001, 1_700_000_000_500_000_000, 1_700_000_002_000_000_000]

HEARER = """
class Hearer(Node):
    def __init__(self):
        super().__init__('hearer')
        self.create_subscription(UInt64, '/numbers', self.got, 10)
        self.create_subscription(String, '/words', self.got, 10)
        self.create_timer(1.0, lambda: None)

    def got(self, message):
        self.get_logger().info(f'{self.get_clock().now().nanoseconds} {message.data}')
"""


def write_bag(path: Path, *, storage: str = "mcap", extra: bool = False) -> Path:
    """Write three numbers and one word at the time of the second number, before it in the file."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    number = store.types["std_msgs/msg/UInt64"]
    word = store.types["std_msgs/msg/String"]
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        numbers = writer.add_connection("/numbers", number.__msgtype__, typestore=store)
        words = writer.add_connection("/words", word.__msgtype__, typestore=store)
        for index, stamp in enumerate(STAMPS):
            if index == 1:
                data = store.serialize_cdr(word(data="two"), word.__msgtype__)
                writer.write(words, stamp, data)
            data = store.serialize_cdr(number(data=index + 1), number.__msgtype__)
            writer.write(numbers, stamp, data)
        if extra:
            store.register(get_types_from_msg("uint8 x\n", "strange_msgs/msg/Strange"))
            strange = store.types["strange_msgs/msg/Strange"]
            odd = writer.add_connection("/odd", strange.__msgtype__, typestore=store)
            writer.write(odd, STAMPS[0], store.serialize_cdr(strange(x=1), strange.__msgtype__))
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_arrive_at_their_recorded_times(
    record_job: Any, tmp_path: Path, storage: str
) -> None:
    write_bag(tmp_path / "bag", storage=storage)
    result = record_job("nodes: [{node: nodes_under_test:Hearer}]\nbags: [bag]\n", HEARER)
    assert result.error is None
    assert result.stop_reason == "end of the bag"
    assert (result.start_ns, result.end_ns) == (STAMPS[0], STAMPS[2])
    with Trace.open(result.path) as trace:
        texts = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
        stamps = [stamp for stamp, _, _ in trace.messages("/numbers")]
        bag_events = [
            e for e in map(trace.event, range(trace.event_count)) if e.kind.label == "bag"
        ]
    assert texts == [f"{STAMPS[0]} 1", f"{STAMPS[1]} two", f"{STAMPS[1]} 2", f"{STAMPS[2]} 3"]
    assert stamps == STAMPS
    assert [event.stamp_ns for event in bag_events] == sorted([*STAMPS, STAMPS[1]])
    assert {event.cause_event for event in bag_events} == {2**64 - 1}


def test_topics_start_offset_and_a_stop_of_the_jobs_own(record_job: Any, tmp_path: Path) -> None:
    write_bag(tmp_path / "bag")
    result = record_job(
        "nodes: [{node: nodes_under_test:Hearer}]\n"
        "bags: [{path: bag, topics: ['/num*'], start_offset: 0.4s}]\n"
        "stop: {duration: 3s}\n",
        HEARER,
    )
    assert result.start_ns == STAMPS[1]
    assert result.end_ns == STAMPS[1] + 3 * 10**9
    with Trace.open(result.path) as trace:
        texts = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
    assert texts == [f"{STAMPS[1]} 2", f"{STAMPS[2]} 3"]


def test_two_bags_are_merged_by_time_then_by_order(record_job: Any, tmp_path: Path) -> None:
    write_bag(tmp_path / "one")
    write_bag(tmp_path / "two")
    result = record_job(
        "nodes: [{node: nodes_under_test:Hearer}]\n"
        "bags: [{path: one, topics: [/words]}, {path: two, topics: [/numbers]}]\n",
        HEARER,
    )
    with Trace.open(result.path) as trace:
        texts = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]
    assert [text.split()[1] for text in texts] == ["1", "two", "2", "3"]


def test_a_type_that_is_not_installed_is_named_before_a_file_is_made(
    record_job: Any, tmp_path: Path
) -> None:
    write_bag(tmp_path / "bag", extra=True)
    job = "nodes: [{node: nodes_under_test:Hearer}]\nbags: [%s]\n"
    with pytest.raises(BagError, match=r"(?s)/odd.*strange_msgs/msg/Strange.*exclude: \[/odd\]"):
        record_job(job % "bag", HEARER)
    assert not (tmp_path / "run.mcap").exists()
    assert record_job(job % "{path: bag, exclude: [/odd]}", HEARER).error is None


def test_a_message_that_is_not_of_its_type_is_named(record_job: Any, tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        words = writer.add_connection("/words", "std_msgs/msg/String", typestore=store)
        writer.write(words, 5, b"\x00\x01\x00\x00\xff\x00\x00\x00a\x00")
    result = record_job("nodes: [{node: nodes_under_test:Hearer}]\nbags: [bag]\n", HEARER)
    assert "message 1 of the bag bag, on /words, is not a std_msgs/msg/String" in str(result.error)
    with Trace.open(result.path) as trace:
        assert trace.complete


@pytest.mark.long
def test_the_husky_bag_through_the_ekf_has_one_digest(tmp_path: Path) -> None:
    if not (DATA / "husky_outdoor").exists():
        pytest.skip("the recording is not part of the project (set RSLTRACE_DATA)")
    from rsltrace import record

    text = (ROOT / "examples/sensor_fusion/job_husky.yaml").read_text()
    text = text.replace("../../../shared/data/husky_outdoor", str(DATA / "husky_outdoor"))
    job = tmp_path / "job.yaml"
    job.write_text(f"search_path: ['{ROOT / 'examples/sensor_fusion'}']\n" + text)
    first = record(load_job(job), tmp_path / "a.mcap")
    second = record(load_job(job), tmp_path / "b.mcap")
    assert first.digest == second.digest
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    with Trace.open(tmp_path / "a.mcap") as trace:
        counts = trace.message_counts
        topics = {c.topic: counts.get(c.id, 0) for c in trace.channels.values()}
    assert topics["/imu/data"] == 11_865
    assert topics["/husky_velocity_controller/odom"] == 3_952
    assert topics["/fix"] == 989
