"""The file into which the library of a program in C or C++ writes records of what happens.

The library (``adapters/processes/observer``) and the run both map it. The records are in the order
of their times, and there even if the process is killed.
"""

from __future__ import annotations

import mmap
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum, auto
from pathlib import Path

from rsltrace.adapters.processes.wire import RecordReader
from rsltrace.native.span_recorder import now_ns
from rsltrace.trace.model.entity import EntityKind


class RecordKind(IntEnum):
    """What a record is of."""

    NODE = 1
    PUBLISHER = auto()
    SUBSCRIPTION = auto()
    SERVICE = auto()
    CLIENT = auto()
    TIMER = auto()
    TIMER_OF = auto()
    CALLBACK = auto()
    NAME = auto()
    TAKE = auto()
    CALL = auto()
    BEGIN = auto()
    END = auto()
    WAIT = auto()
    SENDING = auto()
    SENT = auto()
    LOST = auto()


ENDPOINTS = {
    RecordKind.PUBLISHER: EntityKind.PUBLISHER,
    RecordKind.SUBSCRIPTION: EntityKind.SUBSCRIPTION,
    RecordKind.SERVICE: EntityKind.SERVICE,
    RecordKind.CLIENT: EntityKind.CLIENT,
}


_MAGIC = 0x32656361_72746C73
_HEAD_SIZE = 4096
_CAPACITY, _WRITTEN, _READ, _IS_WRITING, _LOST, _CPU_NS, _RESERVED = range(1, 8)
_MADE_WRITTEN, _MADE_READ, _TRIGGERED_NS, _TRIGGER, _ENDED, _UNCHECKED, _STARTS = range(8, 15)
_PARTS = 256
_MADE_SIZE = 1 << 20
_RECORD = struct.Struct("=IIqqII")


@dataclass(slots=True)
class Record:
    """One record: when and in which thread, and how long it took to make."""

    kind: int
    steady_ns: int
    wall_ns: int
    thread: int
    spent_ns: int
    fields: RecordReader


class RecordFile:
    """The file of one process."""

    def __init__(self, path: Path) -> None:
        """:raises OSError, ValueError: it is not complete yet."""
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 0)
        self._head = memoryview(self._map)[:_HEAD_SIZE].cast("Q")  # each read as a whole
        if self._head[0] != _MAGIC:
            raise ValueError("nothing has been written")
        path.unlink()  # it is there for as long as it is mapped
        self.until_ns = 0
        """There are no other records of before."""
        self.overwritten = False
        """Whether there were records before those that ``last`` has returned."""
        self._made = bytearray()
        """If only the last records are kept: all those that make entities."""
        self.checked: list[Record] = []
        """These, and those that checks are about, until somebody has taken them."""

    @property
    def lost(self) -> int:
        """How many records found no room."""
        return self._head[_LOST]

    @property
    def unchecked(self) -> int:
        """How many messages no check has seen."""
        return self._head[_UNCHECKED]

    def cpu_ns(self, process: int) -> int:
        """Return the processor time since then, 0 if the process is no more."""
        with suppress(OSError):  # as clock_getcpuclockid(3) has it
            return time.clock_gettime_ns(~process << 3 | 2) - self._head[_CPU_NS]
        return 0

    def read(self) -> list[Record]:
        """Take what there is, and make room for more."""
        head, at_ns = self._head, now_ns()
        is_quiet = not head[_IS_WRITING]
        end = head[_WRITTEN]
        data = self._part(_HEAD_SIZE, head[_CAPACITY], head[_READ], end)
        head[_READ] = end
        records = list(_records(memoryview(data)))
        if is_quiet:
            self.until_ns = at_ns
        elif records:
            self.until_ns = max(self.until_ns, records[-1].steady_ns)
        return records

    def _part(self, begin: int, capacity: int, start: int, end: int) -> bytes:
        """Return what lies between two counts of a ring."""
        place, size = start % capacity, end - start
        first = min(size, capacity - place)
        at = begin + place
        return self._map[at : at + first] + self._map[begin : begin + size - first]

    # -- if only the last records are kept --------------------------------------------------------

    @property
    def triggered_ns(self) -> int:
        """When a message came last that a file is to be written for, 0 if none did."""
        return self._head[_TRIGGERED_NS]

    @property
    def trigger(self) -> str:
        """The topic or service of that message."""
        for record in _records(memoryview(bytes(self._made))):
            if record.kind in ENDPOINTS and record.fields.number() == self._head[_TRIGGER]:
                record.fields.number()
                return record.fields.text()
        return ""

    @property
    def status(self) -> int | None:
        """The exit status, None if the process has not ended by itself."""
        ended = self._head[_ENDED]
        return ended & 0xFF if ended else None

    def read_made(self) -> None:
        """Take what makes entities, and what checks are about, and make room for more."""
        head = self._head
        start, end = head[_MADE_READ], head[_MADE_WRITTEN]
        if start != end:
            begin = _HEAD_SIZE + head[_CAPACITY]
            data = memoryview(self._part(begin, _MADE_SIZE, start, end))
            head[_MADE_READ] = end
            self.checked += _records(data)
            self._made += b"".join(_records_of(data, RecordKind.NAME))

    def last(self) -> tuple[list[Record], Iterator[Record]]:
        """Return the records that make entities, and of the others those that are left."""
        self.read_made()
        head = self._head
        end, capacity = head[_WRITTEN], head[_CAPACITY]
        starts = sorted({0, *head[_STARTS : _STARTS + _PARTS]})
        begin = _first(starts, end - capacity, end)
        data = self._part(_HEAD_SIZE, capacity, begin, end)
        whole = _first(starts, head[_RESERVED] - capacity, end)  # others were written over
        self.overwritten = whole > 0
        left = memoryview(data)[max(whole - begin, 0) :]
        return list(_records(memoryview(bytes(self._made)))), _records(left)


def _first(starts: list[int], low: int, end: int) -> int:
    return next((one for one in starts if low <= one < end), end)


def _records(data: memoryview) -> Iterator[Record]:
    for one in _records_of(data):
        size, kind, steady_ns, wall_ns, thread, spent_ns = _RECORD.unpack_from(one)
        fields = RecordReader(one[_RECORD.size : size])
        yield Record(kind, steady_ns, wall_ns, thread, spent_ns, fields)


def _records_of(data: memoryview, kind_max: int = RecordKind.LOST) -> Iterator[memoryview]:
    """Yield the bytes of records of the kinds up to one."""
    at = 0
    while at < len(data):
        size, kind, *_ = _RECORD.unpack_from(data, at)
        if size < _RECORD.size:
            raise ValueError("the process has written over its records")
        end = at + (size + 7) // 8 * 8
        if kind <= kind_max:
            yield data[at:end]
        at = end
