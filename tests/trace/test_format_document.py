"""``docs/trace-format.md`` is enough: ``Independent`` was written from it and the specification of
MCAP alone, with ``struct``, ``zlib``, ``zstandard`` and ``xxhash``, and no code of ours."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import pytest
import xxhash
import zstandard
from trace_maker import write_run

from rsltrace.trace import dtypes
from rsltrace.trace import format as layout
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind

DOCUMENT = Path(__file__).parents[2] / "docs" / "trace-format.md"


class Independent:
    """Reads a whole trace, finished or interrupted, into lists."""

    def __init__(self, data: bytes) -> None:
        self.topics, self.metadata, self.attachments = {}, {}, {}
        self.events, self.outputs, self.payloads = [], [], {}
        position = 8
        while position + 9 <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, position)
            body = data[position + 9 : position + 9 + length]
            if opcode in (0, 0x0F) or len(body) < length:  # cut off, or the data section ends
                break
            if opcode == 0x04:  # Channel: id, schema id, topic
                self.topics[struct.unpack_from("<H", body)[0]] = self.text(body, 4)[0]
            elif opcode == 0x06:
                self.chunk(body)
            elif opcode == 0x09:
                assert zlib.crc32(body[:-4]) == struct.unpack("<I", body[-4:])[0]
                name, at = self.text(body, 16)
                _, at = self.text(body, at)
                self.attachments[name] = body[at + 8 : -4]
            elif opcode == 0x0C:
                name, at = self.text(body, 0)
                end = at + 4 + struct.unpack_from("<I", body, at)[0]
                at += 4
                self.metadata[name] = {}
                while at < end:
                    key, at = self.text(body, at)
                    self.metadata[name][key], at = self.text(body, at)
                if name.startswith("rsltrace:"):
                    said = self.metadata[name].pop("checksum")
                    texts = [name, *sum(sorted(self.metadata[name].items()), ())]
                    assert said == xxhash.xxh3_64_hexdigest("\0".join(texts).encode())
            position += 9 + length

    @staticmethod
    def text(body: bytes, at: int) -> tuple[str, int]:
        (length,) = struct.unpack_from("<I", body, at)
        return body[at + 4 : at + 4 + length].decode(), at + 4 + length

    def chunk(self, body: bytes) -> None:
        size, crc = struct.unpack_from("<QI", body, 16)
        compression, at = self.text(body, 28)
        records = body[at + 8 :]
        if compression == "zstd":
            records = zstandard.ZstdDecompressor().decompress(records)
        assert (len(records), zlib.crc32(records)) == (size, crc)
        at = 0
        while at < len(records):
            _, length, channel, sequence, stamp, _ = struct.unpack_from("<BQHIQQ", records, at)
            message = records[at + 31 : at + 9 + length]
            topic = self.topics[channel]
            if topic == "/rsltrace/events":
                self.events.append(message[4:])
            elif topic == "/rsltrace/outputs":
                self.outputs.append(message[4:])
            else:
                self.payloads.setdefault(topic, []).append((sequence, stamp, message))
            at += 9 + length

    def digest(self) -> str:
        """Recompute all hashes and return the digest."""
        chain, done = 0, 0
        for event in self.events:
            chain_hash, index, *_, output_hash, _, _, _, count, _, _ = struct.unpack(
                "<QQQQQQQIIIBB", event
            )
            chain = xxhash.xxh3_64(event[8:], seed=chain).intdigest()
            folded = 0
            for output in self.outputs[done : done + count]:
                assert struct.unpack_from("<Q", output)[0] == index
                folded = xxhash.xxh3_64(output[8:24], seed=folded).intdigest()
            done += count
            assert (chain, folded) == (chain_hash, output_hash)
        return f"{chain:016x}"


@pytest.fixture(scope="module", params=["zstd", ""])
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    path = tmp_path_factory.mktemp("document") / "run.mcap"
    feeder = write_run(path, 6000, compression=request.param)
    return path.read_bytes(), feeder


def test_the_document_is_enough_to_read_a_trace(written: tuple) -> None:
    data, feeder = written
    read = Independent(data)
    assert read.digest() == feeder.digest == read.metadata["rsltrace:result"]["digest"]
    assert len(read.events) == len(feeder.events)
    assert len(read.outputs) == sum(map(len, feeder.outputs))
    assert read.payloads["/count"] == [(i, s, d) for i, (s, d) in enumerate(feeder.payloads[5])]
    assert read.metadata["rsltrace:format"] == {"version": "1", "checksums": "xxh3"}
    assert read.attachments["job.yaml"].startswith(b"nodes:")
    entities = []
    for _, stamp, message in read.payloads["/rsltrace/entities"]:
        number, node, kind = struct.unpack_from("<IIB", message, 4)
        (length,) = struct.unpack_from("<I", message, 16)
        entities.append((number, node, kind, message[20 : 20 + length - 1].decode(), stamp))
    assert entities == [
        (e.id, e.node, e.kind, e.name, e.created_ns) for e in feeder.entities.values()
    ]


def test_the_document_is_enough_for_an_interrupted_trace(written: tuple) -> None:
    data, feeder = written
    read = Independent(data[: len(data) * 9 // 10])
    assert len(read.events) == 4096
    assert read.digest() == f"{feeder.events[4095].chain_hash:016x}"
    assert "rsltrace:result" not in read.metadata


def test_the_segments_are_where_the_document_says(written: tuple) -> None:
    data, feeder = written
    rows = list(struct.iter_unpack("<11Q", Independent(data).attachments["rsltrace/segments"]))
    assert [row[:2] for row in rows] == [(0, 4096), (4096, len(feeder.events) - 4096)]
    for row in rows:
        first, count, _, _, chain, low, high, events_at, events_size, outputs_at, outputs_size = row
        events = feeder.events[first : first + count]
        assert chain == events[-1].chain_hash
        assert (low, high) == (events[0].stamp_ns, events[-1].stamp_ns)
        for offset, size in ((events_at, events_size), (outputs_at, outputs_size)):
            opcode, length = struct.unpack_from("<BQ", data, offset)
            assert (opcode, length + 9) == (0x06, size)


def test_the_document_names_every_constant_of_the_format() -> None:
    text = DOCUMENT.read_text()
    constants = [
        value
        for name, value in vars(layout).items()
        if name.startswith(("TOPIC_", "PREFIX_", "METADATA_", "ATTACHMENT_", "SCHEMA_"))
        and isinstance(value, str)
    ]
    assert len(constants) > 12
    for value in constants:
        assert value.rstrip("/") in text, value
    assert f"version {layout.FORMAT_VERSION}" in text.splitlines()[0]
    for dtype in (dtypes.EVENT_DTYPE, dtypes.OUTPUT_DTYPE, dtypes.SEGMENT_DTYPE):
        for name in dtype.names:
            assert re.search(rf"\b{name}\b", text), name


def test_the_document_gives_every_number_of_a_kind() -> None:
    text = " ".join(DOCUMENT.read_text().split())
    for kinds in (EventKind, OutputKind, EntityKind):
        for kind in kinds:
            label = kind.name.lower().replace("_", " ").replace("qos", "QoS")
            assert f"{int(kind)} {label}" in text, kind
    for flag in (EventFlag.RAISED, EventFlag.SUSPENDED):
        assert f"{int(flag)}: {flag.name.lower()}" in text


def test_the_document_gives_the_sizes() -> None:
    text = DOCUMENT.read_text()
    for layout_, size in (
        (dtypes.EVENT_MESSAGE_DTYPE, 105),
        (dtypes.OUTPUT_MESSAGE_DTYPE, 63),
        (dtypes.EVENT_DTYPE, 70),
        (dtypes.OUTPUT_DTYPE, 28),
        (dtypes.SEGMENT_DTYPE, 88),
    ):
        assert layout_.itemsize == size
        assert f"{size} bytes" in text
    for dtype in (dtypes.EVENT_DTYPE, dtypes.OUTPUT_DTYPE):
        for name, (_, offset) in dtype.fields.items():
            assert re.search(rf"^\| {offset} \| u\d+ \| {name} \|", text, re.MULTILINE), name
    assert f"{layout.OUTPUTS_PER_SEGMENT:,} outputs" in text
    assert f"segments of {layout.EVENTS_PER_SEGMENT} " in text
