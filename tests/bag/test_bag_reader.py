"""Whatever a recording is stored in, the same messages come out in the same order."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType

import rsltrace.errors
from rsltrace.trace.recordings import Bag, BagQos, open_bag
from tests.tiers import cases

Maker = Callable[..., Path]
Sample = tuple[int, str, bytes]

WITHOUT_SUMMARY = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
MCAP_WRITERS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "no crcs": {"enable_crcs": False},
    "outside chunks": {"use_chunking": False},
    "outside chunks, no summary": {"use_chunking": False, **WITHOUT_SUMMARY},
    "no message index": {"index_types": IndexType.CHUNK},
    "no chunk index": {"index_types": IndexType.NONE},
    "no statistics": {"use_statistics": False},
    "no channels in the summary": {"repeat_channels": False},
    "no schemas in the summary": {"repeat_schemas": False},
    "no summary": WITHOUT_SUMMARY,
}
STORAGES = [
    ("mcap", None),
    ("mcap", "storage"),
    ("mcap", "message"),
    ("mcap", "file"),
    ("sqlite3", None),
    ("sqlite3", "message"),
    ("sqlite3", "file"),
]


def content(bag: Bag) -> list[Sample]:
    return [(stamp_ns, bag.topics[topic].name, data) for stamp_ns, topic, data in bag.messages()]


def read(path: Path, **options: Any) -> list[Sample]:
    with open_bag(path, **options) as bag:
        return content(bag)


@pytest.mark.parametrize(("storage", "compression"), STORAGES)
def test_every_storage_gives_the_same_messages(
    tmp_path: Path, bag_maker: Maker, samples: list[Sample], storage: str, compression: str | None
) -> None:
    path = bag_maker(tmp_path / "bag", samples, storage=storage, compression=compression)
    with open_bag(path) as bag:
        assert content(bag) == samples
        assert bag.storage_id == storage
        assert (bag.start_ns, bag.end_ns, bag.message_count) == (1000, 1290, 30)
        assert (bag.recording_start_ns, bag.recording_end_ns) == (1000, 1290)
        assert [(t.name, t.type_name, t.message_count) for t in bag.topics] == [
            (f"/t{i}", "std_msgs/msg/UInt64", 10) for i in range(3)
        ]
        assert {t.schema_text for t in bag.topics} == {"uint64 data\n"}
        assert {(t.schema_encoding, t.serialization_format) for t in bag.topics} == {
            ("ros2msg", "cdr")
        }
        assert {t.type_hash for t in bag.topics} == {
            "RIHS01_fbdc52018fc13755dce18024d1a671c856aa8b4aaf63adfb095b608f98e8c943"
        }


@pytest.mark.parametrize(("storage", "compression"), STORAGES)
def test_a_single_file_serves_without_metadata(
    tmp_path: Path, bag_maker: Maker, samples: list[Sample], storage: str, compression: str | None
) -> None:
    folder = bag_maker(tmp_path / "bag", samples, storage=storage, compression=compression)
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    assert read(file) == samples


@pytest.mark.parametrize("name", MCAP_WRITERS)
def test_every_way_to_write_mcap_gives_the_same_messages(
    tmp_path: Path, mcap_maker: Maker, samples: list[Sample], name: str
) -> None:
    path = mcap_maker(tmp_path / "a.mcap", samples, chunk_size=150, **MCAP_WRITERS[name])
    with open_bag(path) as bag:
        assert content(bag) == samples
        assert (bag.start_ns, bag.end_ns, bag.message_count) == (1000, 1290, 30)
        assert [(t.name, t.message_count) for t in bag.topics] == [(f"/t{i}", 10) for i in range(3)]
    assert read(path, topics=["/t1"], start_offset_ns=100) == [
        sample for sample in samples if sample[1] == "/t1" and sample[0] >= 1100
    ]


stamped = st.lists(
    st.tuples(st.integers(0, 20), st.sampled_from(["/a", "/b", "/c"])), min_size=1, max_size=40
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(stamped, st.sampled_from(sorted(MCAP_WRITERS)), st.sampled_from([1, 90, 200, 10_000]))
def test_messages_come_by_time_and_equal_times_as_written(
    mcap_maker: Maker, stamps: list[tuple[int, str]], name: str, chunk_size: int
) -> None:
    samples = [(stamp, topic, b"\0\1\0\0%d" % i) for i, (stamp, topic) in enumerate(stamps)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.mcap")
        mcap_maker(path, samples, chunk_size=chunk_size, **MCAP_WRITERS[name])
        with open_bag(path) as bag:
            assert content(bag) == sorted(samples, key=lambda sample: sample[0])
            assert bag.start_ns == min(stamps)[0]
            assert bag.end_ns == max(stamps)[0]


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    deadline=None,
    max_examples=cases(10, 30),
)
@given(stamped, st.integers(0, 20), st.sets(st.sampled_from(["/a", "/b", "/c"]), min_size=1))
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_selection_and_offset_leave_exactly_what_they_say(
    mcap_maker: Maker,
    bag_maker: Maker,
    storage: str,
    stamps: list[tuple[int, str]],
    offset_ns: int,
    topics: set[str],
) -> None:
    samples = [(stamp, topic, b"\0\1\0\0%d" % i) for i, (stamp, topic) in enumerate(stamps)]
    first_ns = min(stamps)[0] + offset_ns
    there = topics & {topic for _, topic, _ in samples}
    expected = sorted(
        (s for s in samples if s[0] >= first_ns and s[1] in there), key=lambda sample: sample[0]
    )
    with tempfile.TemporaryDirectory() as folder:
        if storage == "mcap":
            path = mcap_maker(Path(folder, "a.mcap"), samples, chunk_size=100)
        else:
            path = bag_maker(Path(folder, "a"), samples, storage="sqlite3")
        if not expected:
            with pytest.raises(rsltrace.errors.BagError):
                open_bag(path, topics=sorted(topics), start_offset_ns=offset_ns)
            return
        with open_bag(path, topics=sorted(there), start_offset_ns=offset_ns) as bag:
            assert content(bag) == expected
            assert bag.message_count == len(expected)
            assert (bag.start_ns, bag.end_ns) == (expected[0][0], expected[-1][0])


def test_the_files_of_a_split_bag_are_one_stream(tmp_path: Path, bag_maker: Maker) -> None:
    parts = [
        [(10, "/a", b"\0\1\0\0a"), (30, "/a", b"\0\1\0\0b"), (40, "/b", b"\0\1\0\0c")],
        [(30, "/b", b"\0\1\0\0d"), (35, "/a", b"\0\1\0\0e"), (50, "/c", b"\0\1\0\0f")],
    ]
    for storage in ("mcap", "sqlite3"):
        folder = bag_maker(tmp_path / storage, parts[0], storage=storage)
        suffix = {"mcap": ".mcap", "sqlite3": ".db3"}[storage]
        second = bag_maker(tmp_path / f"{storage}_1", parts[1], storage=storage)
        (second / f"{storage}_1{suffix}").rename(folder / f"{storage}_1{suffix}")
        metadata = folder / "metadata.yaml"
        entry = f"  - {storage}{suffix}\n"
        text = metadata.read_text(encoding="utf-8")
        assert entry in text
        metadata.write_text(
            text.replace(entry, f"{entry}  - {storage}_1{suffix}\n"), encoding="utf-8"
        )
        with open_bag(folder) as bag:
            assert [data[4:] for _, _, data in content(bag)] == [b"a", b"b", b"d", b"e", b"c", b"f"]
            assert [(t.name, t.message_count) for t in bag.topics] == [
                ("/a", 3),
                ("/b", 2),
                ("/c", 1),
            ]
            assert (bag.start_ns, bag.end_ns, bag.message_count) == (10, 50, 6)


def test_messages_between_indexed_chunks_are_not_passed_over(
    tmp_path: Path, mcap_bytes: Any
) -> None:
    file = mcap_bytes()
    file.loose(0, 5, b"a").chunk([(0, 10, b"c"), (1, 30, b"e")]).loose(1, 7, b"b")
    file.record(0x0C, bytes(8)).loose(0, 20, b"d").chunk([(1, 40, b"g")]).loose(1, 35, b"f")
    path = file.finish(tmp_path / "a.mcap", ["/a", "/b"])
    with open_bag(path) as bag:
        assert b"".join(data for _, _, data in bag.messages()) == b"abcdefg"
        assert bag.message_count == 7
        assert [topic.message_count for topic in bag.topics] == [3, 4]


def test_one_name_with_two_types_is_two_topics(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        for stamp_ns, name in enumerate(["std_msgs/msg/Int8", "std_msgs/msg/Bool"]):
            schema = writer.register_schema(name, "ros2msg", b"int8 data")
            # Two publishers of one type are one topic, even as two channels.
            for _ in range(2):
                channel = writer.register_channel("/x", "cdr", schema)
                writer.add_message(channel, stamp_ns, b"\0\1\0\0\1", stamp_ns)
        writer.finish()
    with open_bag(path) as bag:
        assert [(t.name, t.type_name, t.message_count) for t in bag.topics] == [
            ("/x", "std_msgs/msg/Int8", 2),
            ("/x", "std_msgs/msg/Bool", 2),
        ]
        assert [topic for _, topic, _ in bag.messages()] == [0, 0, 1, 1]


def test_globs_select_topics_hidden_ones_too(tmp_path: Path, mcap_maker: Maker) -> None:
    names = ["/imu/a", "/imu/b/c", "/tf", "/add/_service_event", "/go/_action/status"]
    path = mcap_maker(tmp_path / "a.mcap", [(i, name, b"\0\1\0\0") for i, name in enumerate(names)])

    def selected(**options: Any) -> list[str]:
        with open_bag(path, **options) as bag:
            return [topic.name for topic in bag.topics]

    assert selected() == names
    assert selected(topics=["/imu/*"]) == ["/imu/a", "/imu/b/c"]
    assert selected(topics=["/imu/?", "/tf"]) == ["/imu/a", "/tf"]
    assert selected(exclude=["/imu/*", "*/_*"]) == ["/tf"]
    assert selected(topics=["*"], exclude=["/nothing"]) == names
    assert selected(topics=["*/_service_event"]) == ["/add/_service_event"]


def test_topics_without_messages_are_listed(tmp_path: Path, bag_maker: Maker) -> None:
    path = bag_maker(tmp_path / "bag", [(1, "/a", b"\0\1\0\0")], topics=["/quiet", "/a"])
    with open_bag(path) as bag:
        assert [(t.name, t.message_count) for t in bag.topics] == [("/quiet", 0), ("/a", 1)]


@pytest.mark.parametrize(("storage", "version"), [("mcap", 8), ("mcap", 9), ("sqlite3", 8)])
def test_offered_qos_is_read(tmp_path: Path, bag_maker: Maker, storage: str, version: int) -> None:
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    qos = Qos(
        QosHistory.KEEP_LAST,
        5,
        QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL,
        QosTime(1, 500),
        QosTime(9223372036, 854775807),
        QosLiveliness.AUTOMATIC,
        QosTime(0, 0),
        False,
    )
    path = bag_maker(
        tmp_path / "bag", [(1, "/a", b"\0\1\0\0")], storage=storage, version=version, qos=[qos]
    )
    with open_bag(path) as bag:
        assert bag.topics[0].qos == BagQos(
            history="keep_last",
            depth=5,
            reliability="best_effort",
            durability="transient_local",
            deadline_ns=1_000_000_500,
            lifespan_ns=2**63 - 1,
            liveliness="automatic",
            liveliness_lease_duration_ns=0,
            avoid_ros_namespace_conventions=False,
        )


@pytest.mark.parametrize("schema_version", [1, 2])
def test_databases_of_early_versions_are_read(tmp_path: Path, schema_version: int) -> None:
    path = tmp_path / "old.db3"
    database = sqlite3.connect(path)
    extra = ", offered_qos_profiles TEXT NOT NULL" if schema_version == 2 else ""
    database.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        f"serialization_format TEXT NOT NULL{extra});"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
    )
    qos = ("- {history: 3, depth: 0, reliability: 1, durability: 2}",) if extra else ()
    row = (1, "/a", "std_msgs/msg/UInt64", "cdr", *qos)
    database.execute(f"INSERT INTO topics VALUES ({', '.join('?' * len(row))})", row)
    # Equal times, and no index on them: still in the order of the rows.
    rows = [(1, stamp, b"\0\1\0\0%d" % i) for i, stamp in enumerate([5, 3, 5, 3, 5])]
    database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.commit()
    database.close()
    with open_bag(path) as bag:
        assert [data[4:] for _, _, data in bag.messages()] == [b"1", b"3", b"0", b"2", b"4"]
        assert (bag.topics[0].schema_text, bag.topics[0].type_hash) == (None, "")
        qos_read = bag.topics[0].qos
        assert (qos_read.reliability if qos_read else None) == ("reliable" if extra else None)


def test_a_database_whose_log_was_not_merged_is_read_whole(
    tmp_path: Path, bag_maker: Maker, samples: list[Sample]
) -> None:
    path = bag_maker(tmp_path / "bag", samples, storage="sqlite3") / "bag.db3"
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 5000, x'00')")
    database.commit()
    assert read(path) == [*samples, (5000, "/t0", b"\0")]
    database.close()


def test_several_iterators_run_at_once(
    tmp_path: Path, mcap_maker: Maker, samples: list[Sample]
) -> None:
    with open_bag(mcap_maker(tmp_path / "a.mcap", samples, chunk_size=100)) as bag:
        assert [one for pair in zip(bag.messages(), bag.messages(), strict=True) for one in pair][
            ::2
        ] == list(bag.messages())


@pytest.mark.long
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_memory_does_not_grow_with_the_bag(
    tmp_path: Path, mcap_maker: Maker, bag_maker: Maker, storage: str
) -> None:
    samples = [(i * 1000, f"/t{i % 4}", b"\0\1\0\0" + bytes(60)) for i in range(200_000)]
    if storage == "mcap":
        path = mcap_maker(tmp_path / "a.mcap", samples)
    else:
        path = bag_maker(tmp_path / "bag", samples, storage=storage)
    del samples
    peaks = []
    for wanted in (20_000, 200_000):
        with open_bag(path) as bag:
            tracemalloc.start()
            count = 0
            for _ in bag.messages():
                count += 1
                if count == wanted:
                    break
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert count == wanted
    assert peaks[1] - peaks[0] < 1 << 20
    assert peaks[1] < 8 << 20


def test_reading_imports_no_ros_and_no_numpy(
    tmp_path: Path, mcap_maker: Maker, samples: list[Sample]
) -> None:
    mcap_maker(tmp_path / "a.mcap", samples)
    root = Path(rsltrace.errors.__file__).parents[1]
    code = (
        f"import sys; sys.path.insert(0, {str(root)!r})\n"
        "from rsltrace.trace.recordings import open_bag\n"
        "print(len(list(open_bag('a.mcap').messages())))\n"
        "bad = {'rclpy', 'numpy', 'rosbags', 'pydantic'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(bad)) or 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def data_folder() -> Path:
    default = Path(rsltrace.errors.__file__).parents[2] / "shared" / "data"
    return Path(os.environ.get("RSLTRACE_DATA", default))


@pytest.mark.parametrize(
    ("name", "count", "start_ns", "end_ns"),
    [
        ("husky_outdoor", 16_806, 1_432_235_498_025_043_042, 1_432_235_893_332_159_182),
        ("turtlebot3_gazebo", 10_527, 112_540_000_000, 203_880_780_307),
    ],
)
def test_real_recordings_read_as_rosbags_reads_them(
    name: str, count: int, start_ns: int, end_ns: int
) -> None:
    path = data_folder() / name
    if not path.is_dir():
        pytest.skip(f"no recording {name} (set RSLTRACE_DATA to the folder that has it)")
    from rosbags.rosbag2 import Reader

    with open_bag(path) as bag, Reader(path) as other:
        assert (bag.message_count, bag.start_ns, bag.end_ns) == (count, start_ns, end_ns)
        theirs = [(stamp, c.topic, bytes(data)) for c, stamp, data in other.messages()]
        assert content(bag) == theirs
        assert {t.name: t.message_count for t in bag.topics} == {
            name: info.msgcount for name, info in other.topics.items()
        }
