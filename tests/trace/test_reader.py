"""Asking a trace: everything that was written comes back, at random and in a row."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from trace_maker import Feeder, Opened, boundaries, opcodes, uint64_message, write_run

from rsltrace.errors import TraceError, TraceFormatError
from rsltrace.trace import index as index_module
from rsltrace.trace.dtypes import EVENT_DTYPE, OUTPUT_DTYPE
from rsltrace.trace.format import EVENTS_PER_SEGMENT
from rsltrace.trace.index import read_chunk
from rsltrace.trace.mcap.records import RecordSpan
from rsltrace.trace.mcap.source import FileSource
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_SEQUENCE, EventFlag, EventKind, OutputKind
from rsltrace.trace.reader import RUN, Trace
from rsltrace.trace.writer import TraceWriter

EVENTS = 2 * EVENTS_PER_SEGMENT + 500


@pytest.fixture(scope="module", params=["complete", "interrupted"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    """(trace, what was fed): once with its end, once killed after the last event was written."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    feeder = write_run(path, EVENTS)
    if request.param == "interrupted":
        data = path.read_bytes()
        offsets = boundaries(data)
        # Everything behind the last chunk and its indexes goes.
        last = max(i for i, opcode in enumerate(opcodes(data, offsets)) if opcode == 0x07)
        path.write_bytes(data[: offsets[last + 1]])
    with Trace.open(path) as trace:
        assert trace.complete == (request.param == "complete")
        yield trace, feeder


def test_totals(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    assert trace.digest == feeder.digest
    assert trace.event_count == len(feeder.events)
    assert trace.output_count == sum(map(len, feeder.outputs))
    assert trace.start_ns == feeder.events[0].stamp_ns
    assert trace.header == ("ros2", "rsltrace 0.1.0")
    trace.check()


def test_single_events_and_outputs(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    last = len(feeder.events) - 1
    for index in (0, 1, 17, 4095, 4096, 4097, 8191, 8192, last - 1, last, 3, 5000):
        assert trace.event(index) == feeder.events[index]
        assert trace.outputs_of(index) == feeder.outputs[index]
    assert trace.event(last).flags is EventFlag.RAISED


@pytest.mark.parametrize("index", [-1, 10**9])
def test_an_event_that_is_not_there(run: tuple[Trace, Feeder], index: int) -> None:
    trace, _ = run
    for ask in (trace.event, trace.outputs_of):
        with pytest.raises(IndexError, match=f"no event {index}"):
            ask(index)


@pytest.mark.parametrize(
    ("first", "last"),
    [(0, None), (0, 0), (5, 5), (7, 3), (0, 1), (4095, 4097), (4096, 8192), (8000, 10**9), (-5, 2)],
)
def test_ranges_of_events_and_their_outputs(
    run: tuple[Trace, Feeder], first: int, last: int | None
) -> None:
    trace, feeder = run
    wanted = range(len(feeder.events))[max(first, 0) : last]
    found = [int(i) for part in trace.events(first, last) for i in part["index"]]
    assert found == list(wanted)
    hashes = [int(h) for part in trace.outputs(first, last) for h in part["hash"]]
    assert hashes == [output.hash for index in wanted for output in feeder.outputs[index]]


def test_arrays_are_views_into_the_file(run: tuple[Trace, Feeder]) -> None:
    trace, _ = run
    events, outputs = next(trace.events()), next(trace.outputs())
    assert (events.dtype, outputs.dtype) == (EVENT_DTYPE, OUTPUT_DTYPE)
    assert not events.flags.owndata
    assert not events.flags.writeable
    assert not outputs.flags.writeable


def test_entities(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    assert trace.entities == {0: RUN, **feeder.entities}
    timer = next(e for e in trace.entities.values() if e.kind is EntityKind.TIMER)
    assert trace.node_of(timer).name == "/talker"
    assert trace.node_of(trace.node_of(timer)) == trace.node_of(timer)
    assert trace.node_of(trace.entity(0)) == RUN
    with pytest.raises(TraceError, match="no entity 77"):
        trace.entity(77)


def test_payloads_are_found_by_output(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    topics = {
        OutputKind.MESSAGE: "/count",
        OutputKind.REQUEST: "/rsltrace/request/check",
        OutputKind.RESPONSE: "/rsltrace/response/check",
        OutputKind.LOG: "/rosout",
    }
    channels = {channel.topic: channel.id for channel in trace.channels.values()}
    seen = set()
    for outputs in reversed(feeder.outputs):  # against the order of the file
        for output in outputs:
            found = trace.payload(output)
            if output.kind in topics:
                topic = topics[output.kind]
                stamp_ns, data = feeder.payloads[channels[topic]][output.sequence]
                assert found == (stamp_ns, topic, data)
                seen.add(output.kind)
            elif output.sequence == NO_SEQUENCE:
                assert found is None
    assert seen == set(topics)


def test_details(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    (event, nth, text) = feeder.details[0]
    exception = trace.outputs_of(event)[nth]
    assert exception.kind is OutputKind.EXCEPTION
    assert trace.detail(exception) == text
    message = trace.outputs_of(2)[0]
    assert message.kind is OutputKind.MESSAGE
    assert trace.detail(message) is None


def test_messages_of_a_topic(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    channel = next(c.id for c in trace.channels.values() if c.topic == "/count")
    expected = [(stamp, i, data) for i, (stamp, data) in enumerate(feeder.payloads[channel])]
    assert list(trace.messages("/count")) == expected
    assert trace.message_counts[channel] == len(expected)
    assert list(trace.messages("/nothing")) == []


def test_decoding(run: tuple[Trace, Feeder]) -> None:
    trace, _ = run
    _, _, data = next(trace.messages("/count"))
    channel = next(c for c in trace.channels.values() if c.topic == "/count")
    expected = int.from_bytes(data[4:], "little")
    for name in ("/count", channel, channel.id):
        assert trace.decode(name, data).data == expected
    _, _, log = next(trace.messages("/rosout"))
    assert trace.decode("/rosout", log).msg.startswith("received ")
    _, _, response = next(trace.messages("/rsltrace/response/check"))
    decoded = trace.decode("/rsltrace/response/check", response)
    assert decoded.success
    _, _, request = next(trace.messages("/rsltrace/request/check"))
    trace.decode("/rsltrace/request/check", request)
    for topic in ("/rsltrace/events", "/rsltrace/outputs", "/rsltrace/entities"):
        for _, _, own in trace.messages(topic):
            trace.decode(topic, own)
            break
    with pytest.raises(TraceError, match="no topic /nothing"):
        trace.decode("/nothing", data)
    with pytest.raises(TraceError, match=r"a message on /count does not fit its type std_msgs"):
        trace.decode("/count", data[:-1])


def test_job_environment_and_result(run: tuple[Trace, Feeder]) -> None:
    trace, feeder = run
    assert trace.environment == {"python": "3.12.3", "ros_distro": "jazzy"}
    assert trace.job["name"] == "job.yaml"
    assert trace.job_text.startswith("nodes:\n")
    assert trace.attachment("nothing") is None
    assert trace.metadata("nothing") == {}
    if trace.complete:
        assert trace.result["exit_code"] == "3"
        assert trace.result["events"] == str(len(feeder.events))
        assert trace.end_ns == int(trace.result["end_time"])
    else:
        assert trace.result == {}
        assert trace.end_ns == feeder.events[-1].stamp_ns


def test_a_topic_with_two_types_has_its_payloads_apart(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        ids = [
            feeder.entity(EntityKind.PUBLISHER, "/t", node=0, type_=name) for name in ("a/A", "b/B")
        ]
        for entity, type_ in zip(ids, ("a/A", "b/B"), strict=True):
            channel = feeder.writer.add_channel("/t", type_, "uint8 x\n")
            sequence = feeder.payload(channel, 1, type_.encode())
            feeder.output(OutputKind.MESSAGE, entity, b"x", sequence)
        feeder.event(EventKind.TIMER, 1, 1)
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        payloads = [trace.payload(output) for output in trace.outputs_of(0)]
        assert payloads == [(1, "/t", b"a/A"), (1, "/t", b"b/B")]
        assert [data for _, _, data in trace.messages("/t")] == [b"a/A", b"b/B"]


def test_hundreds_of_topics_do_not_each_keep_the_indexes_of_all_chunks(tmp_path: Path) -> None:
    topics, chunks = 200, 10
    with TraceWriter(tmp_path / "run.mcap", force=False) as writer:
        channels = [
            writer.add_channel(f"/topic{n}", "std_msgs/msg/UInt64", "uint64 data\n")
            for n in range(topics)
        ]
        for _ in range(chunks):
            for channel in channels:
                writer.add_payload(channel, 0, uint64_message(1))
            writer._write_payloads()
        writer.close(result={})
    with Trace.open(tmp_path / "run.mcap") as trace:
        tracemalloc.start()
        try:
            for channel in channels:
                trace.message(channel, chunks - 1)
            kept, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert kept / (topics * chunks) < 2000  # bytes for each message that the indexes name


def test_opening_reads_the_ends_of_the_file_only(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path, compression="") as feeder:
        channel = feeder.writer.add_channel("/big", "x/msg/T", "uint8[] data\n")
        for step in range(20):
            feeder.payload(channel, step, bytes(1_000_000))
            feeder.event(EventKind.TIMER, 1, step)
        feeder.writer.close(result={})
    read = 0

    class Counting(FileSource):
        def read_at(self, offset: int, length: int) -> bytes:
            nonlocal read
            read += length
            return super().read_at(offset, length)

    with Trace(Counting(path)) as trace:
        assert (trace.digest, trace.event_count) == (feeder.digest, 20)
        assert read < 20_000
        trace.event(7)
        assert read < 40_000


def test_looking_up_neighbours_unpacks_a_segment_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 1000)
    unpacked = []

    def count(source: FileSource, span: RecordSpan, size_max: int) -> bytes:
        unpacked.append(span)
        return read_chunk(source, span, size_max)

    monkeypatch.setattr("rsltrace.trace.segments.read_chunk", count)
    with Trace.open(path) as trace:
        for index in range(500):
            trace.event(index)
            trace.outputs_of(index)
    assert len(unpacked) == 2


def test_a_closed_trace_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    trace = Trace.open(path)
    events = list(trace.events())
    trace.close()
    trace.close()
    assert len(events[0]) > 0
    with pytest.raises(TraceError, match="cannot be read"):
        trace.event(0)


def test_a_trace_that_is_still_written_shows_what_is_there(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Opened(path) as feeder:
        feeder.entity(EntityKind.NODE, "/n")
        for step in range(EVENTS_PER_SEGMENT + 1):
            feeder.event(EventKind.TIMER, 1, step)
        with Trace.open(path) as trace:
            assert not trace.complete
            assert trace.event_count == EVENTS_PER_SEGMENT
            assert 1 in trace.entities
        feeder.writer.close(result={})
    with Trace.open(path) as trace:
        assert trace.complete


def test_reading_loads_no_ros_and_opening_loads_no_decoder(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    script = f"""
import sys
from rsltrace.trace.reader import Trace
with Trace.open({str(path)!r}) as trace:
    trace.digest, trace.event(3), trace.entities, trace.outputs_of(3)
print(sorted({{name.partition(".")[0] for name in sys.modules}}
             & {{"rclpy", "rosbags", "pydantic", "rich", "click"}}))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


# -- files that are something else ----------------------------------------------------------------


def plain_mcap(path: Path, *, profile: str = "ros2", finish: bool = True) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile, library="somebody's writer")
        schema = writer.register_schema("std_msgs/msg/UInt64", "ros2msg", b"uint64 data\n")
        channel = writer.register_channel("/t", "cdr", schema)
        writer.add_message(channel, 1, b"\x00\x01\x00\x00" + bytes(8), 1)
        if finish:
            writer.finish()
    return path


@pytest.mark.parametrize("finish", [True, False])
def test_a_plain_bag_is_named_as_one(tmp_path: Path, finish: bool) -> None:
    path = plain_mcap(tmp_path / "bag.mcap", finish=finish)
    with pytest.raises(
        TraceFormatError,
        match=r"plain MCAP recording .*somebody's writer.*`rsltrace view`.*bags:",
    ):
        Trace.open(path)


def test_an_mcap_of_another_profile_is_not_recommended_as_bag(tmp_path: Path) -> None:
    path = plain_mcap(tmp_path / "x.mcap", profile="")
    with pytest.raises(TraceFormatError, match=r"not a trace of rsltrace$"):
        Trace.open(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"nothing\.mcap does not exist"):
        Trace.open(tmp_path / "nothing.mcap")


def test_a_folder_and_a_bag_folder(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"is a folder; name the \.mcap file in it"):
        Trace.open(tmp_path)
    (tmp_path / "metadata.yaml").write_text("")
    with pytest.raises(TraceError, match="it holds a rosbag2 recording, which `rsltrace view`"):
        Trace.open(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes")
def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(TraceError, match="not a regular file"):
        Trace.open(tmp_path / "pipe")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"hello, world", "not a trace .it is not MCAP"),
        (b"SQLite format 3\0" + bytes(100), "it is an SQLite file, maybe a rosbag2 recording"),
        (b"\x89MCAP0\r", "ends in its first record"),
        (b"\x89MCAP0\r\n", "ends in its first record"),
        (b"\x89MCAP0\r\n\x01\xff\xff\xff\xff\xff\xff\xff\xff", "ends in its first record"),
        (b"\x89MCAP0\r\n" + bytes(100), "the header at offset 8 is damaged"),
    ],
)
def test_other_files(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(TraceFormatError if "damaged" not in message else TraceError, match=message):
        Trace.open(path)


def test_another_format_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, 10)
    monkeypatch.setattr(index_module, "FORMAT_VERSION", 2)
    with pytest.raises(
        TraceFormatError, match=r"trace format 1, this rsltrace reads 2; .*rsltrace 0\.1\.0"
    ):
        Trace.open(path)


def test_numpy_scalars_do_not_leak_into_events(run: tuple[Trace, Feeder]) -> None:
    trace, _ = run
    event = trace.event(3)
    assert not any(isinstance(getattr(event, name), np.generic) for name in event.__slots__)
