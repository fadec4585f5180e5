"""Other programs' eyes: the mcap package and rosbags take a trace for a ROS 2 recording."""

from __future__ import annotations

from pathlib import Path

import pytest
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosReliability
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore
from trace_maker import Feeder, write_run

from rsltrace.trace.reader import Trace

EVENTS = 5000  # two segments


@pytest.fixture(scope="module", params=["zstd", ""])
def run(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Feeder]:
    path = tmp_path_factory.mktemp("interop") / "run.mcap"
    return path, write_run(path, EVENTS, compression=request.param)


def expected_counts(feeder: Feeder) -> dict[str, int]:
    return {
        "/rsltrace/events": len(feeder.events),
        "/rsltrace/outputs": sum(map(len, feeder.outputs)),
        "/rsltrace/entities": len(feeder.entities),
        "/rsltrace/details": len(feeder.details),
        **dict(
            zip(
                ("/count", "/rosout", "/rsltrace/request/check", "/rsltrace/response/check"),
                (len(feeder.payloads[channel]) for channel in (5, 6, 7, 8)),
                strict=True,
            )
        ),
    }


def test_mcap_reads_every_record_with_its_checksums(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    counts: dict[int, int] = {}
    with path.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if type(record).__name__ == "Message":
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
    assert sorted(counts.values()) == sorted(expected_counts(feeder).values())


def test_mcap_summary_and_indexes_are_those_of_the_messages(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        statistics = summary.statistics
        counts = {
            summary.channels[channel].topic: count
            for channel, count in statistics.channel_message_counts.items()
        }
        assert counts == expected_counts(feeder)
        assert statistics.message_count == sum(counts.values())
        assert statistics.chunk_count == len(summary.chunk_indexes)
        assert statistics.message_start_time == feeder.events[0].stamp_ns
        assert statistics.message_end_time == feeder.events[-1].stamp_ns
        assert statistics.attachment_count == len(list(reader.iter_attachments())) == 2
        names = [metadata.name for metadata in reader.iter_metadata()]
        assert statistics.metadata_count == len(names) == 5
        # By topic: this goes through chunk index and message index.
        found = [
            (message.log_time, message.data)
            for _, _, message in reader.iter_messages(topics=["/count"])
        ]
    assert found == feeder.payloads[5]


def test_indexes_name_every_message_but_events_and_outputs(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    indexed = dict.fromkeys(expected_counts(feeder), 0)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        topics = {channel.id: channel.topic for channel in summary.channels.values()}
        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, MessageIndex):
                indexed[topics[record.channel_id]] += len(record.records)
    rows = dict.fromkeys(("/rsltrace/events", "/rsltrace/outputs"), 0)
    assert indexed == expected_counts(feeder) | rows
    # Foxglove's reader refuses a file with a chunk that has no message index at all; the C++ one a
    # file whose first chunk has none.
    for chunk in summary.chunk_indexes:
        assert chunk.message_index_length > 0
        assert chunk.message_index_offsets


def test_events_are_messages_of_their_topic_all_the_same(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    with Trace.open(path) as trace:
        stamps = [stamp for stamp, _, _ in trace.messages("/rsltrace/events")]
    assert stamps == [event.stamp_ns for event in feeder.events]


def test_mcap_merges_chunks_by_time_without_losing_order(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    owners = [output.event for outputs in feeder.outputs for output in outputs]
    with path.open("rb") as stream:
        times, sequences = [], {"/rsltrace/events": [], "/rsltrace/outputs": []}
        for _, channel, message in make_reader(stream).iter_messages():
            times.append(message.log_time)
            assert message.publish_time == message.log_time
            if channel.topic in sequences:
                sequences[channel.topic].append(message.sequence)
                owner = message.sequence
                if channel.topic == "/rsltrace/outputs":
                    owner = owners[owner]
                assert message.log_time == feeder.events[owner].stamp_ns
    assert times == sorted(times)
    assert sequences["/rsltrace/events"] == list(range(len(feeder.events)))
    assert sequences["/rsltrace/outputs"] == list(range(len(owners)))


def test_rosbags_opens_it_as_a_bag_and_decodes_it(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    store = Typestore()
    with AnyReader([path], default_typestore=store) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts == expected_counts(feeder)
        values = [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages(
                [c for c in reader.connections if c.topic == "/count"]
            )
        ]
        with path.open("rb") as stream:
            topic = "/rsltrace/events"
            events = [
                reader.deserialize(message.data, schema.name)
                for schema, _, message in make_reader(stream).iter_messages(topics=[topic])
            ]
        hashes = [(event.index, event.stamp, event.chain_hash, event.kind) for event in events]
        count = next(c for c in reader.connections if c.topic == "/count")
        assert count.ext.offered_qos_profiles[0].reliability is QosReliability.RELIABLE
        assert count.ext.offered_qos_profiles[0].depth == 10
    assert values == [int.from_bytes(data[4:], "little") for _, data in feeder.payloads[5]]
    assert hashes == [(e.index, e.stamp_ns, e.chain_hash, e.kind) for e in feeder.events]


def test_rosbags_decodes_every_own_message_by_its_schema(run: tuple[Path, Feeder]) -> None:
    path, feeder = run
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            if not channel.topic.startswith("/rsltrace/") or message.sequence:
                continue
            if schema.name.startswith("std_srvs"):
                continue
            store = Typestore()
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
            decoded = store.deserialize_cdr(message.data, schema.name)
            if channel.topic == "/rsltrace/outputs":
                output = feeder.outputs[0][0]
                assert (decoded.event, decoded.hash) == (output.event, output.hash)
                assert (decoded.entity, decoded.kind) == (output.entity, output.kind)
                assert decoded.sequence == output.sequence


def test_mcap_refuses_what_is_damaged(run: tuple[Path, Feeder], tmp_path: Path) -> None:
    """The checksums are there for other readers, too: the mcap package finds a flipped bit."""
    path, _ = run
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)

    def read() -> None:
        with damaged.open("rb") as stream:
            for _ in StreamReader(stream, validate_crcs=True).records:
                pass

    with pytest.raises((McapError, ValueError, zstandard.ZstdError)):
        read()
