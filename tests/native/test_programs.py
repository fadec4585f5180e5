"""What programs in C have noted becomes spans, however they end."""

from __future__ import annotations

import struct
from itertools import count
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.wire import RecordReader, packed_qos, packed_text
from rsltrace.adapters.rclpy.handles.logs import QOS_ROSOUT
from rsltrace.native.processes import record_file
from rsltrace.native.processes.programs import ProgramSpans
from rsltrace.native.processes.record_file import Record, RecordFile, RecordKind
from rsltrace.native.span_recorder import CallbackSpan, SentMessage
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventFlag, EventKind

MAIN, OTHER = 7, 8
WALL = 10**18
CAPACITY = 256
CONSTRUCT, TIMER, SUBSCRIPTION = EventKind.CONSTRUCT, EventKind.TIMER, EventKind.SUBSCRIPTION


class Program:
    """Says what the library in a process would say, a nanosecond apart."""

    def __init__(self) -> None:
        self.spans = ProgramSpans("a program", MAIN, count(1), count(1))
        self.now_ns = 0
        end = packed_text("std_msgs/msg/String") + packed_qos(QOS_ROSOUT) + bytes(16)
        self.say(RecordKind.NODE, struct.pack("<I", 1) + packed_text("node") + packed_text("/"))
        topic = packed_text("/topic")
        self.say(RecordKind.PUBLISHER, struct.pack("<II", 2, 1) + topic + end)
        self.say(RecordKind.SUBSCRIPTION, struct.pack("<II", 3, 1) + topic + end)
        self.say(RecordKind.TIMER, struct.pack("<Iq", 4, 1000))

    def say(self, kind: RecordKind, body: bytes = b"", thread: int = MAIN) -> None:
        self.now_ns += 1
        fields = RecordReader(memoryview(body))
        self.spans.add(Record(kind, self.now_ns, self.now_ns + WALL, thread, 0, fields))

    def take(self, thread: int = MAIN) -> None:
        self.say(RecordKind.TAKE, struct.pack("<IQqq16sIQ", 3, 1, 0, 0, b"", 0, 9), thread)

    def call(self, thread: int = MAIN) -> None:
        self.say(RecordKind.CALL, struct.pack("<Iq", 4, 0), thread)

    def send(self, thread: int = MAIN) -> None:
        self.say(RecordKind.SENDING, struct.pack("<IIqIQ", 2, 0, 1, 0, 9) + b"data", thread)

    def sent(self, is_sent: bool = True, thread: int = MAIN) -> None:
        self.say(RecordKind.SENT, struct.pack("<Iq", is_sent, 1), thread)

    def mark(self, kind: RecordKind, thread: int = MAIN) -> None:
        self.say(kind, struct.pack("<Q", 0xCA11), thread)

    def finished(self, patience_ns: int | None = None) -> list[CallbackSpan]:
        return self.spans.finished(self.now_ns + 1, patience_ns)[0]

    def events(self) -> list[tuple[int, int, int]]:
        """Return the kind of each event, its length and how many messages it has sent."""
        return [
            (one.kind, one.end_ns - one.start_ns, len(messages(one))) for one in self.finished()
        ]


def messages(span: CallbackSpan) -> list[SentMessage]:
    return [output for output in span.outputs if isinstance(output, SentMessage)]


def test_a_callback_ends_where_its_thread_waits_or_takes_the_next() -> None:
    program = Program()
    program.say(RecordKind.WAIT)
    program.take()
    program.send()
    program.sent()
    program.take()
    program.say(RecordKind.WAIT)
    program.send()  # by the main itself
    program.sent(False)
    expected = [(CONSTRUCT, 4, 0), (SUBSCRIPTION, 3, 1), (SUBSCRIPTION, 1, 0)]
    assert program.events() == [*expected, (EventKind.RESUME, 2, 0)]


def test_a_callback_that_says_so_begins_in_another_thread_and_ends_there() -> None:
    program = Program()
    program.say(RecordKind.CALLBACK, struct.pack("<QI", 0xCA11, 4))
    name = packed_text("Node::tick()")
    program.say(RecordKind.NAME, struct.pack("<Q", 0xCA11) + name)
    program.say(RecordKind.WAIT)
    program.call()
    program.mark(RecordKind.BEGIN, OTHER)
    program.send(OTHER)
    program.sent(thread=OTHER)
    program.mark(RecordKind.END, OTHER)
    program.send(OTHER)  # of no callback
    program.sent(thread=OTHER)
    construct, timer, outside = program.finished()
    assert (timer.kind, timer.end_ns - timer.start_ns, len(messages(timer))) == (TIMER, 3, 1)
    assert (timer.thread, outside.thread, outside.kind) == (2, 2, EventKind.OUTSIDE)
    (sent,) = messages(timer)
    assert timer.wall_ns == timer.start_ns + WALL
    assert (sent.before_ns, sent.after_ns) == (timer.wall_ns + 1, timer.wall_ns + 2)
    assert timer.entity is not None
    assert timer.entity.name == "Node::tick()"
    made = [one.name for one in construct.outputs if isinstance(one, Entity)]
    assert made == ["a program", "/node", "/topic", "/topic", "Node::tick()"]


def test_what_a_process_was_sending_when_it_was_killed_may_have_left() -> None:
    program = Program()
    program.say(RecordKind.WAIT)
    program.call()
    program.send()
    assert len(program.finished(10**9)) == 1  # it may still fail
    (timer,) = program.finished()
    assert [one.data for one in messages(timer)] == [b"data"]
    assert timer.flags == EventFlag.SUSPENDED


def test_nothing_after_lost_records_is_of_a_callback_before_them() -> None:
    program = Program()
    program.say(RecordKind.WAIT)
    program.take()
    program.say(RecordKind.LOST, bytes(8))
    program.send()
    program.sent()
    assert [event[::2] for event in program.events()] == [
        (CONSTRUCT, 0),
        (SUBSCRIPTION, 0),
        (EventKind.RESUME, 1),
    ]


def test_a_file_is_read_around_its_end_and_without_what_is_being_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_file, "now_ns", lambda: 1000)
    path = tmp_path / "7.1"
    path.write_bytes(bytes(4096 + CAPACITY))
    with pytest.raises(ValueError, match="nothing"):
        RecordFile(path)
    body = b"twenty-one bytes long"
    head_of_it = struct.pack("=IIqqII", 32 + len(body), RecordKind.WAIT, 30, WALL, MAIN, 5)
    record = head_of_it + body + bytes(3)
    ring = bytearray(CAPACITY)
    for place, byte in enumerate(record, start=CAPACITY - 20):
        ring[place % CAPACITY] = byte
    start = 10 * CAPACITY - 20
    head = (record_file._MAGIC, CAPACITY, start + len(record), start, 1, 3, 0)
    path.write_bytes(struct.pack("=7Q", *head).ljust(4096, b"\0") + ring)
    file = RecordFile(path)
    assert not path.exists()
    (found,) = file.read()
    assert (found.kind, found.steady_ns, found.wall_ns) == (RecordKind.WAIT, 30, WALL)
    assert found.thread == MAIN
    assert (found.spent_ns, found.fields.rest(), file.lost) == (5, body, 3)
    assert file.until_ns == 30  # another one is being written
    file._head[4] = 0
    assert file.read() == []
    assert file.until_ns == 1000
    file._head[2] += 32
    file._map[4096:] = bytes(CAPACITY)
    with pytest.raises(ValueError, match="has written over its records"):
        file.read()
