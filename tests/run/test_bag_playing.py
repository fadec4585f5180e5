"""How a bag plays: rate, loop, other names, other times, what is left of one that is incomplete."""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Trace
from rsltrace.errors import BagError, JobError
from rsltrace.job import load_job
from rsltrace.run import RunCallbacks, run

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("RSLTRACE_DATA", ROOT.parent / "shared" / "data"))
S = 1_000_000_000

Sample = tuple[int, int, str, bytes]
"""Log time, publish time, topic, bytes."""


def uint64(value: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<Q", value)


def header(stamp_ns: int, frame: str = "m") -> bytes:
    text = frame.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<iII", *divmod(stamp_ns, S), len(text)) + text


def write_mcap(path: Path, samples: Sequence[Sample], **options: Any) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="test")
        number = writer.register_schema("std_msgs/msg/UInt64", "ros2msg", b"uint64 data\n")
        head = writer.register_schema("std_msgs/msg/Header", "ros2msg", b"")
        point = writer.register_schema("geometry_msgs/msg/PointStamped", "ros2msg", b"")
        event = writer.register_schema("std_srvs/srv/Trigger_Event", "ros2msg", b"")
        channels: dict[str, int] = {}
        for sequence, (log_ns, publish_ns, topic, data) in enumerate(samples):
            schema = event if "_service_event" in topic else number
            schema = {"/points": point, "/heads": head}.get(topic, schema)
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema, {})
            writer.add_message(channels[topic], log_ns, data, publish_ns, sequence)
        writer.finish()
    return path


def numbers(count: int, *, step_ns: int = S, topic: str = "/n", first: int = 10) -> list[Sample]:
    stamps = [first * S + i * step_ns for i in range(count)]
    return [(stamp, stamp, topic, uint64(i)) for i, stamp in enumerate(stamps)]


def played(result: Any, topic: str = "/n") -> list[tuple[int, int]]:
    """Return (simulated time, number) of what played on a topic."""
    assert result.error is None, result.error
    with Trace.open(result.path) as trace:
        return [
            (stamp, struct.unpack("<Q", data[4:12])[0]) for stamp, _, data in trace.messages(topic)
        ]


@pytest.fixture
def play(tmp_path: Path) -> Any:
    """Record a job that has only bags; the result, with the notes in ``play.notes``."""

    def go(text: str) -> Any:
        path = tmp_path / "job.yaml"
        path.write_text(text, encoding="utf-8")
        go.notes = []  # type: ignore[attr-defined]
        observer = RunCallbacks(note=go.notes.append)  # type: ignore[attr-defined]
        (tmp_path / "run.mcap").unlink(missing_ok=True)
        return run(load_job(path), tmp_path / "run.mcap", observer=observer)

    return go


@pytest.mark.long
def test_rate_and_start(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(4))
    assert played(play("bags: [{path: a.mcap, rate: 2}]")) == [
        (10 * S, 0),
        (10 * S + S // 2, 1),
        (11 * S, 2),
        (11 * S + S // 2, 3),
    ]
    assert played(play("bags: [{path: a.mcap, rate: 0.1, at: 5ms}]")) == [
        (5_000_000 + i * 10 * S, i) for i in range(4)
    ]


def test_a_part_of_a_bag(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(6))
    result = play("bags: [{path: a.mcap, start_offset: 1s, duration: 2s}]")
    assert played(result) == [(11 * S, 1), (12 * S, 2), (13 * S, 3)]
    assert result.stop_reason == "end of the bag"


@pytest.mark.long
def test_a_bag_plays_several_times_or_for_ever(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(3))
    seconds = [10, 11, 12, 12, 13, 14]
    twice = [(second * S, i % 3) for i, second in enumerate(seconds)]
    assert played(play("bags: [{path: a.mcap, loop: 2}]")) == twice
    endless = played(play("{bags: [{path: a.mcap, loop: true, rate: 4}], stop: {duration: 1h}}"))
    assert len(endless) == 3 * 2 * 3600 + 1  # a pass takes half a second; one more begins at 1 h
    first = [(0, 0), (S // 4, 1), (S // 2, 2), (S // 2, 0)]
    assert endless[:4] == [(10 * S + after, value) for after, value in first]


def test_a_bag_that_plays_for_ever_needs_an_end(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(3))
    with pytest.raises(JobError, match=r"job\.yaml:1:29: bags\[0\]\.loop: plays forever"):
        play("bags: [{path: a.mcap, loop: true}]")


def test_a_bag_that_begins_before_the_run_is_noted(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(4))
    result = play("{bags: [a.mcap], start: 12s}")
    assert [stamp for stamp, _ in played(result)] == [12 * S, 12 * S, 12 * S, 13 * S]
    (note,) = play.notes
    assert result.notes == (note,)
    assert note.startswith("a.mcap: begins at 10.000000000 s, before the run does (12.0")
    assert play("{bags: [{path: a.mcap, start_offset: 2s}], start: 12s}").notes == ()


def test_a_single_instant_cannot_loop(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(2, step_ns=0))
    result = play("{bags: [{path: a.mcap, loop: true}], stop: {duration: 1s}}")
    assert "all of its messages have one time, so it cannot loop" in str(result.error)


@pytest.mark.long
def test_other_names_and_qos(record_job: Any, tmp_path: Path) -> None:
    code = """
from rclpy.qos import QoSProfile, DurabilityPolicy
class Late(Node):
    def __init__(self):
        super().__init__('late')
        self.create_timer(2.5, self.join)
        self.sub = None
    def join(self):
        qos = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        if self.sub is None:
            self.sub = self.create_subscription(UInt64, '/renamed', self.got, qos)
    def got(self, message):
        self.get_logger().info(f'got {message.data}')
"""
    write_mcap(tmp_path / "a.mcap", numbers(4))
    bag = "{path: a.mcap, remappings: {/n: /renamed}, qos: %s}"
    job = "nodes: [{node: nodes_under_test:Late}]\nbags: [%s]\nstop: {duration: 6s}\n"

    def heard(qos: str) -> list[str]:
        result = record_job(job % (bag % qos), code)
        assert result.error is None
        with Trace.open(result.path) as trace:
            return [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]

    # The last two of 0, 1, 2 are history; 3 comes live. As recorded, the topic is volatile.
    got = heard('{"/*": {durability: transient_local, depth: 2}}')
    assert [text for text in got if text.startswith("got")] == ["got 1", "got 2", "got 3"]
    assert not [text for text in heard("{}") if text.startswith("got")]


@pytest.mark.parametrize("key", ["remappings: {/m: /x}", "qos: {/m: {depth: 1}}"])
def test_a_name_that_does_not_play_is_shown_in_the_job(play: Any, tmp_path: Path, key: str) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(2))
    said = r"job\.yaml:1:32: \S+a\.mcap: no topic matches '/m'.*\n +1 \| bags: .*\n +\| +\^$"
    with pytest.raises(BagError, match=said):
        play("bags: [{path: a.mcap, topics: [/m]}]")
    said = r"job\.yaml:1:\d+: a\.mcap plays no topic '/m'.* /n\n +1 \| bags: .*\n +\| +\^$"
    with pytest.raises(BagError, match=said):
        play(f"bags: [{{path: a.mcap, {key}}}]")


@pytest.mark.long
def test_bags_of_different_days_are_noted(play: Any, tmp_path: Path) -> None:
    day = 86_400 * S
    write_mcap(tmp_path / "a.mcap", numbers(2))
    write_mcap(tmp_path / "b.mcap", [(t + day, p + day, n, m) for t, p, n, m in numbers(2)])
    play("bags: [b.mcap, a.mcap]")
    assert play.notes == [
        "b.mcap: begins at 86410.000000000 s, 86399 s after everything before it has played, and "
        "simulated time passes until then; move it with at"
    ]
    play("{bags: [b.mcap, a.mcap], stop: {duration: 1h}}")
    assert play.notes == [
        "b.mcap: begins at 86410.000000000 s, after the end of the run (3610.000000000 s): nothing "
        "of it plays; move it with at"
    ]
    play("bags: [{path: b.mcap, at: 12s}, a.mcap]")
    assert play.notes == []


def test_a_glob_that_excludes_nothing_is_noted(play: Any, tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", numbers(2))
    play("bags: [{path: a.mcap, exclude: ['*/image', /m]}]")
    (note,) = play.notes
    assert note.endswith("job.yaml:1:44: a.mcap has no topic '/m', so nothing is left out for it")


def test_bags_are_merged_by_time_and_then_by_their_order_in_the_job(
    play: Any, tmp_path: Path
) -> None:
    write_mcap(tmp_path / "a.mcap", [(10 * S, 0, "/n", uint64(1)), (11 * S, 0, "/n", uint64(2))])
    write_mcap(tmp_path / "b.mcap", [(10 * S, 0, "/n", uint64(3)), (11 * S, 0, "/n", uint64(4))])
    assert [value for _, value in played(play("bags: [a.mcap, b.mcap]"))] == [1, 3, 2, 4]
    assert [value for _, value in played(play("bags: [b.mcap, a.mcap]"))] == [3, 1, 4, 2]


@pytest.mark.long
def test_by_publish_time_and_by_header_stamp(play: Any, tmp_path: Path) -> None:
    point = bytes(2 + 24)  # padding, and three numbers
    samples = [
        (10 * S, 9 * S, "/n", uint64(0)),
        (11 * S, 12 * S, "/n", uint64(1)),
        (12 * S, 11 * S, "/n", uint64(2)),
        (13 * S, 0, "/n", uint64(3)),  # not kept by the writer: its log time
        (14 * S, 14 * S, "/points", header(8 * S) + point),
        (15 * S, 15 * S, "/points", header(0) + point),
        (16 * S, 16 * S, "/points", header(7 * S) + point),
    ]
    write_mcap(tmp_path / "a.mcap", samples, chunk_size=60)
    result = play("bags: [{path: a.mcap, by: publish_time}]")
    assert played(result) == [(9 * S, 0), (11 * S, 2), (12 * S, 1), (13 * S, 3)]
    assert result.start_ns == 9 * S
    result = play("bags: [{path: a.mcap, by: header_stamp, topics: [/points]}]")
    with Trace.open(result.path) as trace:
        stamps = [stamp for stamp, _, _ in trace.messages("/points")]
    assert stamps == [7 * S, 8 * S, 15 * S]


def test_a_database_does_not_know_when_messages_were_published(play: Any, tmp_path: Path) -> None:
    write_db3(tmp_path / "a.db3", 3)
    result = play("bags: [a.db3]")
    assert len(played(result)) == 3
    with pytest.raises(BagError, match="play it by log_time or header_stamp"):
        play("bags: [{path: a.db3, by: publish_time}]")


def test_services_and_actions_are_listed_as_not_played(play: Any, tmp_path: Path) -> None:
    extra = [
        (12 * S, 0, "/reset/_service_event", b"\0\1\0\0"),
        (12 * S, 0, "/go/_action/feedback", b"\0\1\0\0"),
        (12 * S, 0, "/go/_action/get_result/_service_event", b"\0\1\0\0"),
    ]
    write_mcap(tmp_path / "a.mcap", [*numbers(2), *extra])
    result = play("bags: [a.mcap]")
    assert len(played(result)) == 2
    assert play.notes == [
        "a.mcap: recorded services are not played: /reset (only topics play; what a server "
        "answers, its node must answer again)",
        "a.mcap: recorded actions are not played: /go (only topics play; what a server answers, "
        "its node must answer again)",
    ]


# --- incomplete bags ------------------------------------------------------------------------------


def test_what_is_whole_of_an_mcap_that_was_cut_off_plays(play: Any, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", numbers(100), chunk_size=200)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    got = played(play("bags: [a.mcap]"))
    assert 5 < len(got) < 60
    assert got == [(10 * S + i * S, i) for i in range(len(got))]
    (note,) = play.notes
    assert "cut off, only its beginning plays: the first" in note
    assert "bytes are whole" in note


@pytest.mark.long
@pytest.mark.parametrize("chunks", [True, False])
def test_an_mcap_without_index_plays_in_full_without_a_word(
    play: Any, tmp_path: Path, chunks: bool
) -> None:
    from mcap.writer import IndexType

    path = tmp_path / "a.mcap"
    options: dict[str, Any] = {"use_summary_offsets": False, "index_types": IndexType.NONE}
    write_mcap(path, numbers(20), use_chunking=chunks, use_statistics=False, **options)
    assert len(played(play("bags: [a.mcap]"))) == 20
    assert play.notes == []


def write_db3(path: Path, count: int, *, first: int = 0) -> Path:
    db = sqlite3.connect(path)
    db.executescript(
        "PRAGMA page_size = 1024;"
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
        " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
        "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        "INSERT INTO topics VALUES (1, '/n', 'std_msgs/msg/UInt64', 'cdr', '');"
    )
    for i in range(first, first + count):
        db.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (i + 1, (10 + i) * S, uint64(i)))
    db.commit()
    db.close()
    return path


def test_what_can_be_read_of_a_database_that_was_cut_off_plays(play: Any, tmp_path: Path) -> None:
    path = write_db3(tmp_path / "a.db3", 400)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    got = played(play("bags: [a.db3]"))
    assert 50 < len(got) < 400
    assert got == [((10 + i) * S, i) for i in range(len(got))]
    assert "only its beginning plays: the first" in play.notes[0]


def test_a_folder_without_metadata_plays_in_the_order_of_its_files(
    play: Any, tmp_path: Path
) -> None:
    (tmp_path / "bag").mkdir()
    for number in (0, 2, 10):
        write_db3(tmp_path / "bag" / f"bag_{number}.db3", 2, first=number)
    got = [value for _, value in played(play("bags: [bag]"))]
    assert got == [0, 1, 2, 3, 10, 11]
    assert "no metadata.yaml; played without it: bag_0.db3, bag_2.db3, bag_10.db3" in play.notes[0]


@pytest.mark.few(1)
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("mode", ["file", "message"])
def test_compressed_bags_play_as_plain_ones(
    play: Any, tmp_path: Path, storage: str, mode: str
) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/n", "std_msgs/msg/UInt64", typestore=store)
        for stamp_ns, _, _, data in numbers(5):
            writer.write(connection, stamp_ns, data)
    assert played(play("bags: [bag]")) == [((10 + i) * S, i) for i in range(5)]
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert played(play("bags: [bag]")) == [((10 + i) * S, i) for i in range(5)]


@pytest.mark.few(3)
@pytest.mark.parametrize("codec", ["NONE", "LZ4", "ZSTD"])
def test_chunks_of_any_compression(play: Any, tmp_path: Path, codec: str) -> None:
    from mcap.writer import CompressionType

    write_mcap(tmp_path / "a.mcap", numbers(50), compression=CompressionType[codec], chunk_size=99)
    assert len(played(play("bags: [{path: a.mcap, by: publish_time}]"))) == 50


# --- real recordings ------------------------------------------------------------------------------


@pytest.mark.skipif(not (DATA / "turtlebot3_gazebo").is_dir(), reason="no real recordings here")
def test_a_real_recording_by_its_header_stamps(play: Any, tmp_path: Path) -> None:
    bag = DATA / "turtlebot3_gazebo"
    text = f"bags: [{{path: {bag}, by: header_stamp, topics: [/scan, /imu], duration: 20s}}]"
    result = play(text)
    assert result.error is None
    with Trace.open(result.path) as trace:
        for topic in ("/scan", "/imu"):
            count = 0
            for stamp, _, data in trace.messages(topic):
                sec, nanosec = struct.unpack("<iI", data[4:12])
                assert stamp == sec * S + nanosec
                count += 1
            assert count > 50


@pytest.mark.skipif(not (DATA / "husky_outdoor").is_dir(), reason="no real recordings here")
def test_a_real_recording_cut_off_in_the_middle(play: Any, tmp_path: Path) -> None:
    (source,) = (DATA / "husky_outdoor").glob("*.mcap")
    path = tmp_path / "husky.mcap"
    shutil.copyfile(source, path)
    path.chmod(0o644)
    with path.open("r+b") as file:
        file.truncate(source.stat().st_size // 2)
    result = play("bags: [{path: husky.mcap, topics: [/fix]}]")
    assert result.error is None
    assert "cut off" in play.notes[0]
    with Trace.open(result.path) as trace:
        stamps = [stamp for stamp, _, _ in trace.messages("/fix")]
    assert 200 < len(stamps) < 989
    assert all(a <= b for a, b in itertools.pairwise(stamps))
