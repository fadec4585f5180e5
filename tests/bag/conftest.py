"""Makers of recordings: with rosbags' writer, with mcap's writer, and byte by byte."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

Sample = tuple[int, str, bytes]
"""Log time in nanoseconds, topic, CDR bytes."""

UINT64 = "std_msgs/msg/UInt64"
SCHEMA_TEXT = "uint64 data\n"


def uint64(value: int) -> bytes:
    return b"\x00\x01\x00\x00" + struct.pack("<Q", value)


def make_samples(count: int, topics: int = 3, step_ns: int = 10) -> list[Sample]:
    """Messages at regular times, one topic after the other."""
    return [(1000 + i * step_ns, f"/t{i % topics}", uint64(i)) for i in range(count)]


def write_mcap(
    path: Path,
    samples: Sequence[Sample],
    *,
    profile: str = "ros2",
    encoding: str = "cdr",
    metadata: dict[str, str] | None = None,
    **options: Any,
) -> Path:
    """Write an MCAP file with the ``mcap`` package; ``options`` are its writer's."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile=profile, library="test")
        schema = writer.register_schema(UINT64, "ros2msg", SCHEMA_TEXT.encode())
        channels: dict[str, int] = {}
        for sequence, (stamp_ns, topic, data) in enumerate(samples):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, schema, metadata or {})
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns, sequence)
        writer.finish()
    return path


def write_bag(
    path: Path,
    samples: Sequence[Sample],
    *,
    storage: str = "mcap",
    compression: str | None = None,
    version: Any = 9,
    qos: Sequence[Any] = (),
    topics: Sequence[str] = (),
) -> Path:
    """Write a bag folder with rosbags; ``topics`` are there even without messages."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=version, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        names = dict.fromkeys([*topics, *(topic for _, topic, _ in samples)])
        connections = {
            name: writer.add_connection(
                name, UINT64, typestore=typestore, offered_qos_profiles=list(qos)
            )
            for name in names
        }
        for stamp_ns, topic, data in samples:
            writer.write(connections[topic], stamp_ns, data)
    return path


class McapBytes:
    """An MCAP file built record by record, for what no writer would write."""

    MAGIC = b"\x89MCAP0\r\n"

    def __init__(self, profile: str = "ros2") -> None:
        self.data = self.MAGIC
        self.indexes: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.stamps: list[int] = []
        self.record(0x01, self.text(profile) + self.text("test"))

    @staticmethod
    def text(value: str) -> bytes:
        return struct.pack("<I", len(value.encode())) + value.encode()

    def record(self, opcode: int, content: bytes) -> McapBytes:
        self.data += struct.pack("<BQ", opcode, len(content)) + content
        return self

    def schema(self, encoding: str = "ros2msg") -> bytes:
        body = struct.pack("<H", 1) + self.text(UINT64) + self.text(encoding)
        return body + self.text(SCHEMA_TEXT)

    def channel(self, number: int, topic: str, encoding: str = "cdr") -> bytes:
        return struct.pack("<HH", number, 1) + self.text(topic) + self.text(encoding) + bytes(4)

    @staticmethod
    def message(channel: int, stamp_ns: int, data: bytes) -> bytes:
        return struct.pack("<HIQQ", channel, 0, stamp_ns, stamp_ns) + data

    def loose(self, channel: int, stamp_ns: int, data: bytes) -> McapBytes:
        """Add a message outside chunks."""
        self._count(channel, stamp_ns)
        return self.record(0x05, self.message(channel, stamp_ns, data))

    def chunk(
        self,
        messages: Sequence[tuple[int, int, bytes]],
        *,
        times: tuple[int, int] | None = None,
        crc: int | None = None,
        compression: str = "",
        size: int | None = None,
        inner: bytes | None = None,
    ) -> McapBytes:
        """Add a chunk of (channel, log time, data); the rest can be given wrongly."""
        if inner is None:
            inner = b""
            for message in messages:
                content = self.message(*message)
                inner += struct.pack("<BQ", 0x05, len(content)) + content
        for channel, stamp_ns, _ in messages:
            self._count(channel, stamp_ns)
        stamps = [stamp_ns for _, stamp_ns, _ in messages] or [0]
        start_ns, end_ns = times or (min(stamps), max(stamps))
        offset = len(self.data)
        self.record(
            0x06,
            struct.pack(
                "<QQQI",
                start_ns,
                end_ns,
                len(inner) if size is None else size,
                zlib.crc32(inner) if crc is None else crc,
            )
            + self.text(compression)
            + struct.pack("<Q", len(inner))
            + inner,
        )
        length = len(self.data) - offset
        self.indexes.append(
            struct.pack("<QQQQIQ", start_ns, end_ns, offset, length, 0, 0)
            + self.text(compression)
            + struct.pack("<QQ", len(inner), len(inner))
        )
        return self

    def _count(self, channel: int, stamp_ns: int) -> None:
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.stamps.append(stamp_ns)

    def finish(self, path: Path, topics: Sequence[str], encoding: str = "cdr") -> Path:
        """Write the file with a complete summary."""
        self.record(0x0F, bytes(4))
        summary_at = len(self.data)
        self.record(0x03, self.schema())
        for number, topic in enumerate(topics):
            self.record(0x04, self.channel(number, topic, encoding))
        for index in self.indexes:
            self.record(0x08, index)
        stamps = self.stamps or [0]
        counts = b"".join(struct.pack("<HQ", *item) for item in self.counts.items())
        self.record(
            0x0B,
            struct.pack(
                "<QHIIIIQQI",
                len(self.stamps),
                1,
                len(topics),
                0,
                0,
                len(self.indexes),
                min(stamps),
                max(stamps),
                len(counts),
            )
            + counts,
        )
        self.record(0x02, struct.pack("<QQI", summary_at, 0, 0))
        path.write_bytes(self.data + self.MAGIC)
        return path


@pytest.fixture
def samples() -> list[Sample]:
    return make_samples(30)


@pytest.fixture
def mcap_bytes() -> type[McapBytes]:
    return McapBytes


@pytest.fixture
def mcap_maker() -> Callable[..., Path]:
    return write_mcap


@pytest.fixture
def bag_maker() -> Callable[..., Path]:
    return write_bag
