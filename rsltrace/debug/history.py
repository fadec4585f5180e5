"""What is known of a run's events: all of them from its trace, or those that have run so far."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from typing import Protocol

from rsltrace.guard.redirect import copy_of
from rsltrace.replay.verification import limit_of
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.format import EVENT_REST
from rsltrace.trace.reader import Trace

_ROW_BYTES = 8 + EVENT_REST.size
_ROWS_AT_ONCE = 4096
# Not those that a node's guard redirects: they are called in the middle of a run.
_pread = copy_of(os.pread)  # type: ignore[arg-type]
_pwrite = copy_of(os.pwrite)  # type: ignore[arg-type]
_fstat = copy_of(os.fstat)  # type: ignore[arg-type]


class History(Protocol):
    """The events of a run, by index."""

    trace: Trace | None
    ended: Stop | None
    """Why the run goes no further than ``limit``, where that is known beforehand."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What is open for it, and meant to be shared by all processes of a session."""

    @property
    def limit(self) -> int | None:
        """How many events there are at most, None if nobody knows."""

    @property
    def known(self) -> int:
        """How many events are known so far."""

    def hashes(self, first: int) -> Iterator[int]:
        """Yield the chain hashes of the events from ``first`` on, as far as they are known."""

    def learn(self, index: int, rest: bytes, chain_hash: int) -> bool:
        """Take note of an event that has not been there before; False if there can be none."""

    def row(self, index: int) -> tuple[bytes, int]:
        """Return an event, packed, and its chain hash. Raises IndexError."""


class TraceHistory:
    """The events of a trace: a run that has been recorded."""

    def __init__(self, trace: Trace) -> None:
        self.trace: Trace | None = trace
        self._trace = trace
        count, self.ended = limit_of(trace, None)
        self._limit = count if count >= 0 else trace.event_count

    @property
    def descriptors(self) -> tuple[int, ...]:
        return ()

    @property
    def limit(self) -> int | None:
        return self._limit

    @property
    def known(self) -> int:
        return self._limit

    def hashes(self, first: int) -> Iterator[int]:
        for rows in self._trace.events(first):
            yield from rows["chain_hash"].tolist()

    def learn(self, index: int, rest: bytes, chain_hash: int) -> bool:
        return False

    def row(self, index: int) -> tuple[bytes, int]:
        event = self._trace.event(index)
        rest = EVENT_REST.pack(
            event.index,
            event.stamp_ns,
            event.cause_event,
            event.input_hash,
            event.output_hash,
            event.state_hash,
            event.entity,
            event.cause_output,
            event.outputs,
            event.kind,
            event.flags,
        )
        return rest, event.chain_hash


class RunHistory:
    """The events of a run that has never been recorded, in a file that all its processes share."""

    trace: Trace | None = None
    ended: Stop | None = None
    limit: int | None = None

    def __init__(self) -> None:
        with tempfile.TemporaryFile(prefix="rsltrace-debug-") as file:
            self._number = os.dup(file.fileno())

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What is open for it, and meant to be shared."""
        return (self._number,)

    @property
    def known(self) -> int:
        return int(_fstat(self._number).st_size) // _ROW_BYTES

    def hashes(self, first: int) -> Iterator[int]:
        while True:
            data = _pread(self._number, _ROWS_AT_ONCE * _ROW_BYTES, first * _ROW_BYTES)
            whole = len(data) // _ROW_BYTES
            if not whole:
                return
            for start in range(0, whole * _ROW_BYTES, _ROW_BYTES):
                yield int.from_bytes(data[start : start + 8], "little")
            first += whole

    def learn(self, index: int, rest: bytes, chain_hash: int) -> bool:
        row = chain_hash.to_bytes(8, "little") + rest
        _pwrite(self._number, row, index * _ROW_BYTES)
        return True

    def row(self, index: int) -> tuple[bytes, int]:
        data = b""
        if index >= 0:
            data = _pread(self._number, _ROW_BYTES, index * _ROW_BYTES)
        if len(data) < _ROW_BYTES:
            raise IndexError(f"event {index} has not run yet")
        return data[8:], int.from_bytes(data[:8], "little")
