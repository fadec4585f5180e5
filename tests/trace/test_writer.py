"""What the writer puts into a file, and how it says no."""

from __future__ import annotations

import re
import subprocess
import sys
import tracemalloc
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from mcap.reader import make_reader
from ruamel.yaml import YAML
from trace_maker import MS, QOS_YAML, START_NS, UINT64_HASH, Opened, boundaries, opcodes, write_run

from rsltrace.errors import OutputError
from rsltrace.trace import writer as writer_module
from rsltrace.trace.format import (
    EVENT_REST,
    EVENTS_PER_SEGMENT,
    OUTPUT_CONTENT,
    OUTPUTS_PER_SEGMENT,
    PAYLOAD_BYTES_PER_CHUNK,
)
from rsltrace.trace.mcap.records import crc_of, joined_crc
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

CHUNK, ATTACHMENT, METADATA = 0x06, 0x09, 0x0C


# -- opening --------------------------------------------------------------------------------------


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"run\.mcap: it exists; use --force .* or -o"):
        TraceWriter(path, force=False)
    assert path.read_bytes() == b"precious"


def test_force_replaces_a_longer_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(10_000_000))
    feeder = write_run(path, 10, force=True)
    assert path.stat().st_size < 100_000
    with Trace.open(path) as trace:
        assert trace.digest == feeder.digest


@pytest.mark.parametrize("content", [b"nodes: []\n", b"\x89PNG\r\n", b"\x89MCAB", bytes(9)])
def test_force_replaces_nothing_but_traces(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "job.yaml"
    path.write_bytes(content)
    with pytest.raises(
        OutputError, match=r"job\.yaml: the existing file is not a trace \(not MCAP"
    ):
        TraceWriter(path, force=True)
    assert path.read_bytes() == content


@pytest.mark.parametrize("content", [b"", b"\x89MCA"])
def test_force_replaces_what_was_cut_off(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    write_run(path, 10, force=True)
    assert path.stat().st_size > 100


def test_a_missing_folder_is_named_and_not_made(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"the folder .*nowhere does not exist; create it"):
        TraceWriter(tmp_path / "nowhere" / "run.mcap", force=False)
    assert not (tmp_path / "nowhere").exists()


def test_a_folder_in_which_no_file_can_be_created_is_named() -> None:
    with pytest.raises(OutputError, match=r"x\.mcap: no file can be created in /proc; choose"):
        TraceWriter(Path("/proc/x.mcap"), force=False)


def test_a_link_that_leads_nowhere_is_named(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").symlink_to("/nowhere/x.mcap")
    with pytest.raises(OutputError, match=r"it is a link to /nowhere/x\.mcap"):
        TraceWriter(tmp_path / "run.mcap", force=False)


@pytest.mark.parametrize("force", [False, True])
def test_a_folder_is_no_file(tmp_path: Path, force: bool) -> None:
    with pytest.raises(OutputError, match="it is a folder"):
        TraceWriter(tmp_path, force=force)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="file is not a folder"):
        TraceWriter(tmp_path / "file" / "run.mcap", force=False)


def test_an_unknown_compression_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'zstd' or ''"):
        TraceWriter(tmp_path / "run.mcap", force=False, compression="lz4")
    assert not (tmp_path / "run.mcap").exists()


# -- the bytes ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("compression", ["zstd", ""])
def test_the_same_calls_give_the_same_bytes_under_any_name(
    tmp_path: Path, compression: str
) -> None:
    (tmp_path / "folder").mkdir()
    paths = [tmp_path / "a.mcap", tmp_path / "folder" / "with_another_name.mcap"]
    for path in paths:
        write_run(path, 10_000, compression=compression)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_segment_is_entities_then_payloads_then_outputs_then_events(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    feeder = write_run(path, 2 * EVENTS_PER_SEGMENT + 100)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    kinds = [
        {topics[c] for c in index.message_index_offsets}
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    ]
    assert kinds.pop(0) == {"/rsltrace/entities"}
    own = ({"/rsltrace/outputs"}, {"/rsltrace/events"})
    for start in range(0, 9, 3):
        assert not kinds[start] & (own[0] | own[1] | {"/rsltrace/entities"})
        assert tuple(kinds[start + 1 : start + 3]) == own
    assert len(kinds) == 9
    with Trace.open(path) as trace:
        assert trace.segments["events"].tolist() == [4096, 4096, len(feeder.events) - 8192]


def test_what_a_segment_refers_to_is_in_the_file_before_its_events(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, EVENTS_PER_SEGMENT + 1, close=False)  # the second segment never got there
    with Trace.open(path) as trace:
        assert trace.event_count == EVENTS_PER_SEGMENT
        for index in range(trace.event_count):
            assert trace.event(index).entity in trace.entities
            for output in trace.outputs_of(index):
                assert output.entity in trace.entities
                assert (trace.payload(output) is None) == (output.sequence == NO_SEQUENCE)


def test_payloads_are_written_when_half_a_megabyte_has_gathered(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap", compression="") as feeder:
        channel = feeder.writer.add_channel("/image", "x/msg/Image", "uint8[] data\n")
        before = feeder.writer.size
        feeder.payload(channel, 0, bytes(PAYLOAD_BYTES_PER_CHUNK - 100))
        assert feeder.writer.size == before
        feeder.payload(channel, 0, bytes(100))
        assert feeder.writer.size > before + PAYLOAD_BYTES_PER_CHUNK


def test_a_segment_with_very_many_outputs_ends_early(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        timer = feeder.entity(EntityKind.TIMER, "burst", node=0)
        for step in range(3):
            for _ in range(OUTPUTS_PER_SEGMENT // 2):
                feeder.output(OutputKind.TIMER, timer, b"x")
            feeder.event(EventKind.TIMER, timer, step)
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        assert trace.segments["events"].tolist() == [2, 1]
        assert trace.event_count == 3
        trace.check()
        assert len(trace.outputs_of(1)) == OUTPUTS_PER_SEGMENT // 2


def test_outputs_of_an_event_that_never_ended_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        feeder.output(OutputKind.SHUTDOWN, 0, b"whole")
        feeder.event(EventKind.SHUTDOWN, 0, 5)
        feeder.output(OutputKind.SHUTDOWN, 0, b"half")
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        assert (trace.event_count, trace.output_count) == (1, 1)
        trace.check()


def test_a_run_without_events_is_a_trace(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        assert feeder.writer.digest == "0" * 16
        feeder.writer.close(result={"stop_reason": "nothing to do"})
    with Trace.open(path) as trace:
        assert (trace.digest, trace.event_count, trace.start_ns, trace.end_ns) == (
            "0" * 16,
            0,
            0,
            0,
        )
        assert list(trace.events()) == list(trace.outputs()) == []
        assert trace.result["stop_reason"] == "nothing to do"
        trace.check()


def test_times_and_hashes_use_all_64_bits(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        channel = feeder.writer.add_channel("/t", "x/msg/T", "uint8 a\n")
        for stamp_ns in (2**63 - 1, 2**63, 2**64 - 1):
            sequence = feeder.payload(channel, stamp_ns, b"data")
            feeder.output(OutputKind.MESSAGE, 1, b"x", sequence)
            feeder.event(EventKind.TIMER, 1, stamp_ns, input_hash=2**64 - 1)
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        stamps = [2**63 - 1, 2**63, 2**64 - 1]
        assert [trace.event(i).stamp_ns for i in range(3)] == stamps
        assert [stamp for stamp, _, _ in trace.messages("/t")] == stamps
        assert (trace.start_ns, trace.end_ns) == (2**63 - 1, 2**64 - 1)


def test_equal_schemas_are_written_once_and_a_topic_has_one_channel(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        writer = feeder.writer
        first = writer.add_channel("/a", "x/msg/T", "uint8 a\n", qos_yaml=QOS_YAML)
        assert writer.add_channel("/a", "x/msg/T", "uint8 a\n") == first
        assert writer.add_channel("/b", "x/msg/T", "uint8 a\n") == first + 1
        assert writer.add_channel("/a", "x/msg/U", "uint8 b\n") == first + 2
        writer.close(result={})
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    names = [schema.name for schema in summary.schemas.values()]
    assert sorted(names[4:]) == ["x/msg/T", "x/msg/U"]


def test_too_many_topics_is_an_output_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rsltrace.trace.mcap.writer.CHANNELS_MAX", 6)
    with Opened(tmp_path / "run.mcap") as feeder:
        feeder.writer.add_channel("/a", "x/msg/T", "")
        feeder.writer.add_channel("/b", "x/msg/T", "")
        with pytest.raises(OutputError, match="/c is one topic too many"):
            feeder.writer.add_channel("/c", "x/msg/T", "")


def test_qos_that_is_no_yaml_sequence_is_an_output_error(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder, pytest.raises(OutputError, match=r"QoS .*of /a"):
        feeder.writer.add_channel("/a", "x/msg/T", "", qos_yaml="history: keep_last")


@pytest.mark.parametrize("buffer", ["RecordBuffer", "PythonRecordBuffer"])
def test_too_many_messages_for_a_sequence_is_an_output_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, buffer: str
) -> None:
    monkeypatch.setattr(writer_module, "RecordBuffer", getattr(writer_module, buffer))
    with Opened(tmp_path / "run.mcap") as feeder:
        channel = feeder.writer.add_channel("/a", "x/msg/T", "")
        feeder.writer._sequences[channel] = NO_SEQUENCE - 2
        assert feeder.writer.add_payload(channel, 0, b"") == NO_SEQUENCE - 2
        with pytest.raises(OutputError, match=f"more than {NO_SEQUENCE} messages"):
            feeder.writer.add_payload(channel, 0, b"")
        with pytest.raises(OutputError, match=f"more than {NO_SEQUENCE} messages"):
            feeder.writer.close(result={})


# -- what rosbag2 reads ---------------------------------------------------------------------------


def bag_metadata(path: Path) -> dict:
    with path.open("rb") as stream:
        records = {m.name: m.metadata for m in make_reader(stream).iter_metadata()}
    return YAML(typ="safe").load(records["rosbag2"]["serialized_metadata"])


def test_bag_metadata_says_what_the_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "my_run.mcap"
    feeder = write_run(path, 500)
    metadata = bag_metadata(path)
    assert metadata["version"] == 9
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["ros_distro"] == "jazzy"  # of the environment
    assert metadata["relative_file_paths"] == ["trace.mcap"]
    assert metadata["starting_time"] == {"nanoseconds_since_epoch": START_NS}
    last_ns = feeder.events[-1].stamp_ns
    assert metadata["duration"] == {"nanoseconds": last_ns - START_NS}
    topics = {
        entry["topic_metadata"]["name"]: (entry["message_count"], entry["topic_metadata"])
        for entry in metadata["topics_with_message_count"]
    }
    assert metadata["message_count"] == sum(count for count, _ in topics.values())
    count, topic = topics["/count"]
    assert count == len(feeder.payloads[5])
    assert topic["type"] == "std_msgs/msg/UInt64"
    assert topic["type_description_hash"] == UINT64_HASH
    assert topic["offered_qos_profiles"] == YAML(typ="safe").load(QOS_YAML)
    assert topics["/rsltrace/events"][0] == len(feeder.events)
    assert topics["/rsltrace/events"][1]["offered_qos_profiles"] == []


def test_bag_metadata_quotes_what_yaml_would_misread(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    names = ["/on", "no", "1", "a: b", "- x", "'", '"', "#", "", "null", "line\nbreak"]
    with Opened(path) as feeder:
        for name in names:
            feeder.writer.add_channel(name, name, "")
        feeder.writer.close(result={})
    topics = [t["topic_metadata"] for t in bag_metadata(path)["topics_with_message_count"]]
    assert [t["name"] for t in topics[4:]] == names
    assert [t["type"] for t in topics[4:]] == names


def test_channel_metadata_is_that_of_rosbag2(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    with path.open("rb") as stream:
        channels = {c.topic: c for c in make_reader(stream).get_summary().channels.values()}
    assert channels["/count"].metadata == {
        "offered_qos_profiles": QOS_YAML.strip(),
        "topic_type_hash": UINT64_HASH,
    }
    # An empty text, which rosbag2 stumbles over, never stands there.
    assert channels["/rsltrace/events"].metadata == {"offered_qos_profiles": "[]"}


# -- a disk that refuses --------------------------------------------------------------------------


def fill(path: Path) -> str:
    """Record until the disk is full; return the error's text."""
    rng = np.random.default_rng(1)
    with Opened(path) as feeder:
        channel = feeder.writer.add_channel("/noise", "x/msg/T", "uint8[] data\n")

        def run() -> None:
            for step in range(1_000_000):
                data = rng.bytes(100)
                sequence = feeder.payload(channel, step, data)
                feeder.output(OutputKind.MESSAGE, 1, data, sequence)
                feeder.event(EventKind.TIMER, 1, step)

        with pytest.raises(OutputError) as caught:
            run()
        with pytest.raises(OutputError):
            feeder.writer.close(result={})  # says the same again, and closes the file
        return str(caught.value)


def check_readable(path: Path, message: str) -> None:
    with Trace.open(path) as trace:
        assert not trace.complete
        assert trace.event_count > 0
        said = int(re.search(r"([0-9]+) events", message)[1])
        # One more segment where the disk was full between a chunk and its indexes.
        assert trace.event_count - said in (0, EVENTS_PER_SEGMENT)
        assert str(path.stat().st_size) in message
        trace.check()


def test_a_disk_that_fills_up_leaves_a_readable_trace(tmp_path: Path) -> None:
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(tmp_path)],
        capture_output=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip("only root may mount a small disk")
    try:
        path = tmp_path / "run.mcap"
        message = fill(path)
        assert "No space left on device (ENOSPC)" in message
        assert "free some space" in message
        check_readable(path, message)
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


LIMITED = """
import resource, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
import make
from rsltrace.errors import OutputError
from rsltrace.trace.model.event import EventKind
import random
try:
    with make.Opened(Path(sys.argv[1])) as feeder:
        channel = feeder.writer.add_channel("/noise", "x/msg/T", "")
        rng = random.Random(1)
        for step in range(1_000_000):
            feeder.payload(channel, step, rng.randbytes(100))
            feeder.event(EventKind.TIMER, 1, step)
except OutputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no file size limits")
def test_a_file_size_limit_leaves_a_readable_trace(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    script = LIMITED.format(tests=str(Path(__file__).parent))
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    assert "File too large (EFBIG)" in done.stdout
    check_readable(path, done.stdout)


# -- interruptions and mistakes -------------------------------------------------------------------


def test_an_interrupt_in_the_middle_of_a_write_ends_the_trace_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:

        def run(events: int) -> None:
            for step in range(events):
                feeder.event(EventKind.TIMER, 1, step)

        run(EVENTS_PER_SEGMENT + 10)
        real = writer_module.segments.events_chunk

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(writer_module.segments, "events_chunk", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(EVENTS_PER_SEGMENT)
        monkeypatch.setattr(writer_module.segments, "events_chunk", real)
        with pytest.raises(OutputError, match="interrupted in the middle of a segment"):
            feeder.writer.close(result={})
    with Trace.open(path) as trace:
        assert not trace.complete
        assert trace.event_count == EVENTS_PER_SEGMENT


def test_leaving_the_block_without_close_leaves_an_interrupted_trace(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with TraceWriter(path, force=False) as writer:
        for index in range(EVENTS_PER_SEGMENT + 5):
            writer.add_event(EVENT_REST.pack(index, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0), index)
    with Trace.open(path) as trace:
        assert not trace.complete
        assert trace.event_count == EVENTS_PER_SEGMENT


@pytest.mark.parametrize("buffer", ["RecordBuffer", "PythonRecordBuffer"])
def test_a_recorder_that_miscounts_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, buffer: str
) -> None:
    monkeypatch.setattr(writer_module, "RecordBuffer", getattr(writer_module, buffer))
    event = [EVENT_REST.pack(i, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0) for i in (0, 2)]
    with TraceWriter(tmp_path / "a.mcap", force=False) as writer:
        for rest in event:
            writer.add_event(rest, 0)
        with pytest.raises(AssertionError, match="not numbered"):
            writer.close(result={})
    with TraceWriter(tmp_path / "b.mcap", force=False) as writer:
        writer.add_output(OUTPUT_CONTENT.pack(0, 0, 1))
        writer.add_sequence(0)
        writer.add_event(EVENT_REST.pack(0, 0, 0, 0, 0, 0, 0, 0, 2, 2, 0), 0)
        with pytest.raises(AssertionError, match="do not match"):
            writer.close(result={})
    with TraceWriter(tmp_path / "c.mcap", force=False) as writer:
        writer.add_output(OUTPUT_CONTENT.pack(0, 0, 1))  # and no sequence, as a draw has none
        writer.add_event(EVENT_REST.pack(0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 0), 0)
        with pytest.raises(AssertionError, match="do not match their sequences"):
            writer.close(result={})


@pytest.mark.long
def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    """Per segment, 88 bytes of table and some 300 of indexes may stay; per event, nothing."""
    rest_of = EVENT_REST.pack

    def peak(events: int) -> int:
        with TraceWriter(tmp_path / f"{events}.mcap", force=False) as writer:
            channel = writer.add_channel("/a", "x/msg/T", "")
            tracemalloc.start()
            for index in range(events):
                sequence = writer.add_payload(channel, index, b"x" * 20)
                writer.add_output(OUTPUT_CONTENT.pack(1, 1, 1))
                writer.add_sequence(sequence)
                writer.add_event(rest_of(index, index, 0, 0, 0, 0, 0, 0, 1, 2, 0), index)
            writer.close(result={})
            _, highest = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            return highest

    peak(EVENTS_PER_SEGMENT)  # what is imported or cached once
    # Both files are larger than the pieces in which closing reads them.
    short, long = peak(13 * EVENTS_PER_SEGMENT), peak(33 * EVENTS_PER_SEGMENT)
    assert long - short < 20 * 2000


def test_counts_and_digest_are_known_while_writing(tmp_path: Path) -> None:
    with Opened(tmp_path / "run.mcap") as feeder:
        for step in range(EVENTS_PER_SEGMENT + 3):
            feeder.output(OutputKind.TIMER, 1, b"")
            feeder.event(EventKind.TIMER, 1, step * MS)
            if step in (0, EVENTS_PER_SEGMENT - 1, EVENTS_PER_SEGMENT):
                assert feeder.writer.digest == feeder.digest
                assert feeder.writer.event_count == feeder.writer.output_count == step + 1


def test_the_format_record_comes_first(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    data = path.read_bytes()
    offsets = boundaries(data)
    assert opcodes(data, offsets)[:2] == [0x01, METADATA]
    assert b"rsltrace:format" in data[offsets[1] : offsets[2]]


# -- large messages -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["noise", "zeros"])
@pytest.mark.parametrize("size", [(64 << 10) - 100, 64 << 10, 1 << 20, 5 << 20])
def test_large_messages_are_kept_and_packed_only_if_that_pays(
    tmp_path: Path, kind: str, size: int
) -> None:
    data = b"\0\1\0\0" + (np.random.default_rng(7).bytes(size) if kind == "noise" else bytes(size))
    files = []
    for name in ("a.mcap", "b.mcap"):
        with Opened(tmp_path / name) as feeder:
            channel = feeder.writer.add_channel("/image", "std_msgs/msg/String", "string data\n")
            for n, message in enumerate((b"\0\1\0\0first", data, b"\0\1\0\0last", data[:-1])):
                feeder.writer.add_payload(channel, START_NS + n, message)
            feeder.writer.close(result={})
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [m.data for _, c, m in reader.iter_messages() if c.topic == "/image"]
        summary = reader.get_summary()
    assert found == [b"\0\1\0\0first", data, b"\0\1\0\0last", data[:-1]]
    assert summary is not None
    plain = [index.compression == "" for index in summary.chunk_indexes]
    assert any(plain) == (kind == "noise" and size >= 64 << 10)
    with Trace.open(tmp_path / "a.mcap") as trace:
        trace.check()


def test_what_did_not_get_smaller_is_trusted_not_to_for_some_messages(tmp_path: Path) -> None:
    noise, zeros = np.random.default_rng(7).bytes(1 << 20), bytes(1 << 20)
    with Opened(tmp_path / "a.mcap") as feeder:
        one = feeder.writer.add_channel("/one", "std_msgs/msg/String", "string data\n")
        other = feeder.writer.add_channel("/other", "std_msgs/msg/String", "string data\n")
        for n, (channel, data) in enumerate([(one, noise), (other, zeros), *[(one, zeros)] * 17]):
            feeder.writer.add_payload(channel, START_NS + n, b"\0\1\0\0" + data)
        feeder.writer.close(result={})
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    large = [index for index in summary.chunk_indexes if index.uncompressed_size > 1 << 20]
    packed = [bool(index.compression) for index in large]
    assert packed == [False, True, *[False] * 15, True, True]


def test_a_checksum_of_pieces_is_that_of_the_whole() -> None:
    rng = np.random.default_rng(11)
    for first in (0, 1, 4096, 70_001):
        for second in (0, 1, 2, 255, 65_536, 1_000_003):
            a, b = rng.bytes(first), rng.bytes(second)
            assert joined_crc(crc32(a), crc32(b), second) == crc32(a + b)
            assert crc_of((a, b, a)) == crc32(a + b + a)
