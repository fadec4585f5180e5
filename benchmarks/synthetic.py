"""Large traces in little time, for benchmarks: whole segments made with numpy.

A run of 8 nodes in a ring: timers publish, the next node receives and publishes on. Hashes, chain
and index are what a recorder would have written.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rsltrace.trace.chain import hash64
from rsltrace.trace.dtypes import EVENT_DTYPE, EVENT_REST_DTYPE, OUTPUT_CONTENT_DTYPE, OUTPUT_DTYPE
from rsltrace.trace.format import CDR_HEADER, OUTPUT_HASHED
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace.writer import TraceWriter

NODES = 8
_STEP_NS = 100_000
_ENTITIES_PER_NODE = 4
_REST_AT = EVENT_DTYPE.itemsize - EVENT_REST_DTYPE.itemsize
_POOL_BYTES = 16 << 20
"""What fills large messages: longer than any window of the compressor, so it stays as large."""


class BulkWriter(TraceWriter):
    """Writes whole segments that numpy has made, where a recorder adds one event at a time."""

    def add_segment(self, events: np.ndarray, outputs: np.ndarray) -> None:
        """Write the next events (EVENT_DTYPE) with their outputs (OUTPUT_DTYPE)."""
        contents = np.empty(len(outputs), dtype=OUTPUT_CONTENT_DTYPE)
        for name in OUTPUT_CONTENT_DTYPE.names or ():
            contents[name] = outputs[name]
        self._write_rows(events.tobytes(), contents.tobytes(), outputs["sequence"].tobytes())


@dataclass(frozen=True)
class Shape:
    """What a trace is like. From event ``diverges_at`` on all values are others.

    ``payload_bytes`` is the length of the messages' arrays, None to record no payloads; ``segment``
    how many events a segment has.
    """

    events: int
    diverges_at: int | None = None
    payload_bytes: int | None = 0
    segment: int = 4096


def write_trace(path: Path, shape: Shape) -> None:
    """Write a trace, under another name until it is whole."""
    print(f"writing {path.name} …", file=sys.stderr, flush=True)
    unfinished = path.with_suffix(".part")
    _Synthesis(unfinished, shape).write()
    os.replace(unfinished, path)


class _Synthesis:
    def __init__(self, path: Path, shape: Shape) -> None:
        self._shape = shape
        self._writer = BulkWriter(path, force=True)
        self._channels: list[int] = []
        self._sequences = np.zeros(NODES, dtype=np.int64)
        self._pool = np.random.default_rng(3).bytes(_POOL_BYTES)
        self._chain = 0
        self._last_value = 0

    def write(self) -> None:
        with self._writer as writer:
            for node in range(NODES):
                self._add_node(node)
            first = 0
            for values in _values(self._shape):
                self._write_segment(first, values)
                first += len(values)
            writer.close(result={"stop_reason": "benchmark", "exit_code": "0"})

    def _add_node(self, node: int) -> None:
        first = 1 + node * _ENTITIES_PER_NODE
        name, topic = f"/node{node}", f"/topic{node}"
        last, type_ = f"/topic{(node - 1) % NODES}", "bench_msgs/msg/Block"
        for entity in (
            Entity(first, first, EntityKind.NODE, name, "bench:Node", 0, {}),
            Entity(first + 1, first, EntityKind.TIMER, "tick", "", 0, {}),
            Entity(first + 2, first, EntityKind.SUBSCRIPTION, last, type_, 0, {}),
            Entity(first + 3, first, EntityKind.PUBLISHER, topic, type_, 0, {}),
        ):
            self._writer.add_entity(entity)
        if self._shape.payload_bytes is not None:
            schema = "uint64 value\nuint8[] data\n"
            self._channels.append(self._writer.add_channel(topic, type_, schema))

    def _write_segment(self, first: int, values: np.ndarray) -> None:
        index = np.arange(first, first + len(values))
        received = index % 2 == 1  # even: a timer fires; odd: the next node receives that
        node = (index // 2 + received) % NODES
        entity = 1 + node * _ENTITIES_PER_NODE
        stamps = index // 2 * _STEP_NS

        outputs = np.zeros(len(index), dtype=OUTPUT_DTYPE)
        outputs["event"], outputs["hash"] = index, values
        outputs["entity"], outputs["kind"] = entity + 3, OutputKind.MESSAGE
        outputs["sequence"] = NO_SEQUENCE
        if self._channels:
            self._write_payloads(outputs["sequence"], node, stamps, values)

        events = np.zeros(len(index), dtype=EVENT_DTYPE)
        events["index"], events["stamp"] = index, stamps
        before = np.concatenate(([np.uint64(self._last_value)], values[:-1]))
        events["cause_event"] = np.where(received, index - 1, 0).astype(np.uint64)
        events["cause_event"][~received] = NO_EVENT
        events["input_hash"] = np.where(received, before, stamps.astype(np.uint64) + np.uint64(1))
        events["entity"] = entity + np.where(received, 2, 1)
        events["kind"] = np.where(received, EventKind.SUBSCRIPTION, EventKind.TIMER)
        events["outputs"] = 1
        packed, size = outputs.tobytes(), OUTPUT_DTYPE.itemsize
        events["output_hash"] = [
            hash64(packed[at : at + size][OUTPUT_HASHED]) for at in range(0, len(packed), size)
        ]
        packed, size = events.tobytes(), EVENT_DTYPE.itemsize
        chain, hashes = self._chain, []
        for at in range(0, len(packed), size):
            chain = hash64(packed[at + _REST_AT : at + size], chain)
            hashes.append(chain)
        events["chain_hash"] = hashes
        self._writer.add_segment(events, outputs)
        self._chain, self._last_value = chain, int(values[-1])

    def _write_payloads(
        self, sequences: np.ndarray, node: np.ndarray, stamps: np.ndarray, values: np.ndarray
    ) -> None:
        for one in range(NODES):
            own = np.flatnonzero(node == one)
            sequences[own] = self._sequences[one] + np.arange(len(own))
            self._sequences[one] += len(own)
        length = self._shape.payload_bytes or 0
        tail, add = length.to_bytes(4, "little"), self._writer.add_payload
        for n, stamp, value in zip(node.tolist(), stamps.tolist(), values.tolist(), strict=True):
            at = value % (_POOL_BYTES - length)
            data = value.to_bytes(8, "little") + tail + self._pool[at : at + length]
            add(self._channels[n], stamp, CDR_HEADER + data)
        self._writer._write_payloads()


def _values(shape: Shape) -> Iterator[np.ndarray]:
    """Yield what the events publish, a segment at a time: the same up to where they diverge."""
    one, other = np.random.default_rng(1), np.random.default_rng(2)
    diverges_at = shape.events if shape.diverges_at is None else shape.diverges_at
    for first in range(0, shape.events, shape.segment):
        size = min(shape.segment, shape.events - first)
        values = one.integers(0, 2**63, size, dtype=np.uint64)
        others = other.integers(0, 2**63, size, dtype=np.uint64)
        values[max(diverges_at - first, 0) :] = others[max(diverges_at - first, 0) :]
        yield values
