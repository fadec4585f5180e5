"""How long a diff takes, beside reading both traces up to the divergence and comparing.

    python benchmarks/diff.py            1e4, 1e5 and 1e6 events, about three minutes
    python benchmarks/diff.py --large    1e7 events, too (3.5 GB of files, some minutes more)

Each run is compared with itself and with runs that part from it at 10, 50 and 99 %. "diff" is what
a user waits for: a new process, from start to exit, the best of five. "linear" is the mcap
package's reader going through the messages of both files in its usual order until they differ,
without the start of a process; "events" the same with the events only, for somebody who knows what
these are. What is marked with ~ was not waited for, but scaled from the half of 1e6 events. All
files are in the page cache. They are kept in the temporary folder for the next time.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from rsltrace.diff.engine import diff_traces
from rsltrace.model.entity import Entity, EntityKind
from rsltrace.model.event import NO_EVENT, NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace import chunks
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import (
    CDR_HEADER,
    EVENT_DTYPE,
    EVENT_REST_DTYPE,
    OUTPUT_DTYPE,
    OUTPUT_HASHED,
    SEGMENT_DTYPE,
    TOPIC_EVENTS,
)
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

SIZES = (10_000, 100_000, 1_000_000)
LARGE = 10_000_000
PLACES = (0.10, 0.50, 0.99)
NODES = 8
PAYLOADS_MAX = 1_000_000
LINEAR_MAX = 500_000
"""Events read one by one; the time for more is that of so many, scaled."""

_SEGMENT = 4096
_STEP_NS = 100_000
_ENTITIES_PER_NODE = 4
_VERSION = 1
_REST_AT = EVENT_DTYPE.itemsize - EVENT_REST_DTYPE.itemsize


class BulkWriter(TraceWriter):
    """Writes whole segments that numpy has made, where a recorder adds one event at a time."""

    def add_segment(self, events: np.ndarray, outputs: np.ndarray) -> None:
        """Write the next events (EVENT_DTYPE) with their outputs (OUTPUT_DTYPE)."""
        stream = self._stream
        outputs_at = stream.chunk(
            chunks.outputs_chunk(outputs, events, self._outputs_written, self._output_channel)
        )
        row = np.zeros(1, dtype=SEGMENT_DTYPE)
        row["first_event"], row["events"] = self._events_written, len(events)
        row["first_output"], row["outputs"] = self._outputs_written, len(outputs)
        row["chain_hash"] = self._last_chain_hash = int(events["chain_hash"][-1])
        row["start_stamp"], row["end_stamp"] = events["stamp"].min(), events["stamp"].max()
        row["outputs_offset"], row["outputs_length"] = outputs_at
        at = stream.chunk(chunks.events_chunk(events, self._event_channel))
        row["events_offset"], row["events_length"] = at
        self._segments.append(row.tobytes())
        self._events_written += len(events)
        self._outputs_written += len(outputs)


def write_trace(path: Path, count: int, parts_at: int | None, *, payloads: bool) -> None:
    """Write a run of 8 nodes in a ring: timers publish, the next node receives and publishes on.

    From event ``parts_at`` on all values are others.
    """
    with BulkWriter(path, force=True) as writer:
        channels = []
        for node in range(NODES):
            first = 1 + node * _ENTITIES_PER_NODE
            name, topic = f"/node{node}", f"/topic{node}"
            last, type_ = f"/topic{(node - 1) % NODES}", "std_msgs/msg/UInt64"
            for entity in (
                Entity(first, first, EntityKind.NODE, name, "bench:Node", 0, {}),
                Entity(first + 1, first, EntityKind.TIMER, "tick", "", 0, {}),
                Entity(first + 2, first, EntityKind.SUBSCRIPTION, last, type_, 0, {}),
                Entity(first + 3, first, EntityKind.PUBLISHER, topic, type_, 0, {}),
            ):
                writer.add_entity(entity)
            if payloads:
                channels.append(writer.add_channel(topic, type_, "uint64 data\n"))
        sequences = np.zeros(NODES, dtype=np.int64)
        values = _values(count, parts_at)
        chain = last_value = 0
        for first in range(0, count, _SEGMENT):
            size = min(_SEGMENT, count - first)
            chain, last_value = _write_segment(
                writer, first, next(values)[:size], chain, last_value, channels, sequences
            )
        writer.close(result={"stop_reason": "benchmark", "exit_code": "0"})


def _values(count: int, parts_at: int | None) -> Iterator[np.ndarray]:
    """Yield what the events publish, a segment at a time: the same up to ``parts_at``."""
    one, other = np.random.default_rng(1), np.random.default_rng(2)
    for first in range(0, count, _SEGMENT):
        values = one.integers(0, 2**63, _SEGMENT, dtype=np.uint64)
        if parts_at is not None and first + _SEGMENT > parts_at:
            later = np.arange(first, first + _SEGMENT) >= parts_at
            values[later] = other.integers(0, 2**63, _SEGMENT, dtype=np.uint64)[later]
        yield values


def _write_segment(
    writer: BulkWriter,
    first: int,
    values: np.ndarray,
    chain: int,
    last_value: int,
    channels: list[int],
    sequences: np.ndarray,
) -> tuple[int, int]:
    index = np.arange(first, first + len(values))
    received = index % 2 == 1  # even: a timer fires; odd: the next node receives that
    node = (index // 2 + received) % NODES
    entity = 1 + node * _ENTITIES_PER_NODE
    stamps = index // 2 * _STEP_NS

    outputs = np.zeros(len(index), dtype=OUTPUT_DTYPE)
    outputs["event"], outputs["hash"] = index, values
    outputs["entity"], outputs["kind"] = entity + 3, OutputKind.MESSAGE
    outputs["sequence"] = NO_SEQUENCE
    if channels:
        for one in range(NODES):
            own = np.flatnonzero(node == one)
            outputs["sequence"][own] = sequences[one] + np.arange(len(own))
            sequences[one] += len(own)
        for n, stamp, value in zip(node.tolist(), stamps.tolist(), values.tolist(), strict=True):
            writer.add_payload(channels[n], stamp, CDR_HEADER + value.to_bytes(8, "little"))
    writer._write_payloads()

    events = np.zeros(len(index), dtype=EVENT_DTYPE)
    events["index"], events["stamp"] = index, stamps
    before = np.concatenate(([np.uint64(last_value)], values[:-1]))
    events["cause_event"] = np.where(received, index - 1, 0).astype(np.uint64)
    events["cause_event"][~received] = NO_EVENT
    events["input_hash"] = np.where(received, before, stamps.astype(np.uint64) + np.uint64(1))
    events["entity"] = entity + np.where(received, 2, 1)
    events["kind"] = np.where(received, EventKind.SUBSCRIPTION, EventKind.TIMER)
    events["outputs"] = 1
    packed = outputs.tobytes()
    size = OUTPUT_DTYPE.itemsize
    events["output_hash"] = [
        hash64(packed[at : at + size][OUTPUT_HASHED]) for at in range(0, len(packed), size)
    ]
    packed, size, hashes = events.tobytes(), EVENT_DTYPE.itemsize, []
    for at in range(0, len(packed), size):
        chain = hash64(packed[at + _REST_AT : at + size], chain)
        hashes.append(chain)
    events["chain_hash"] = hashes
    writer.add_segment(events, outputs)
    return chain, int(values[-1])


def traces(count: int) -> list[tuple[str, Path, Path]]:
    """Return (where they part, one trace, the other), written now if they are not there yet."""
    folder = Path(tempfile.gettempdir()) / f"rsltrace-benchmark-diff-{_VERSION}"
    folder.mkdir(exist_ok=True)
    payloads = count <= PAYLOADS_MAX
    places = {"same": None, **{f"{p:.0%}": int(count * p) for p in PLACES}}
    paths = {}
    for name, parts_at in places.items():
        path = paths[name] = folder / f"{count}-{name.rstrip('%')}.mcap"
        if not path.exists():
            print(f"writing {path.name} …", end="\r", file=sys.stderr, flush=True)
            unfinished = path.with_suffix(".part")
            write_trace(unfinished, count, parts_at, payloads=payloads)
            os.replace(unfinished, path)
    return [(name, paths["same"], path) for name, path in paths.items()]


def run_diff(a: Path, b: Path) -> tuple[float, float]:
    """Return the seconds of ``rsltrace diff`` as a process (the best of some), its peak in MB."""
    command = [sys.executable, "-m", "rsltrace", "diff", str(a), str(b)]
    best, peak = float("inf"), 0.0
    for _ in range(5):
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        best = min(best, time.perf_counter() - start)
        process.returncode = os.waitstatus_to_exitcode(status)
        peak = max(peak, usage.ru_maxrss / 1024)
        if process.returncode not in (0, 1):
            raise SystemExit(f"{' '.join(command)} failed")
    return best, peak


def read_linearly(a: Path, b: Path, topics: list[str] | None) -> float:
    """Return the seconds until the mcap package has found a message that differs, or the end."""
    start = time.perf_counter()
    with a.open("rb") as stream_a, b.open("rb") as stream_b:
        messages = [make_reader(stream).iter_messages(topics) for stream in (stream_a, stream_b)]
        for mine, theirs in zip_longest(*messages):
            if mine is None or theirs is None or mine[2].data != theirs[2].data:
                break
    return time.perf_counter() - start


class Linear:
    """Times linear reading, in processes of their own: memory of this one would count as theirs."""

    def __init__(self) -> None:
        self._per_event: dict[str, float] = {}

    def seconds(self, a: Path, b: Path, what: str, events: int) -> tuple[float, bool]:
        """Return the seconds for so many events, and whether they were measured."""
        if events > LINEAR_MAX and what in self._per_event:
            return self._per_event[what] * events, False
        command = [sys.executable, __file__, "--read", what, str(a), str(b)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        self._per_event[what] = float(done.stdout) / events
        return float(done.stdout), True


HEAD = "   events  part at   diff s  peak MB  read kB    of kB  linear s   ratio  events s   ratio"


def measure(count: int, linear: Linear) -> None:
    """Measure one size and print its rows."""
    for name, a, b in sorted(traces(count), key=lambda trace: trace[0]):
        taken, peak = run_diff(a, b)
        with Trace.open(a) as trace_a, Trace.open(b) as trace_b:
            found = diff_traces(trace_a, trace_b)
            whole = trace_a.size + trace_b.size
        parts_at = count if name == "same" else int(count * float(name[:-1]) / 100)
        assert found.agreeing == parts_at, (found.agreeing, parts_at)
        row = f"{count:>9}  {name:>7}  {taken:>7.3f}  {peak:>7.0f}  {found.bytes_read / 1e3:>7.0f}"
        row += f"  {whole / 1e3:>7.0f}"
        for what in ("all", "events"):
            seconds, measured = linear.seconds(a, b, what, parts_at)
            text = f"{'' if measured else '~'}{seconds:.2f}"
            row += f"  {text:>8}  {seconds / taken:>6.0f}"
        print(row, flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time diffs of traces of several sizes.")
    parser.add_argument("--large", action="store_true", help=f"{LARGE} events, too")
    parser.add_argument("--read", nargs=3, metavar=("WHAT", "A", "B"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.read is not None:
        what, a, b = arguments.read
        print(read_linearly(Path(a), Path(b), [TOPIC_EVENTS] if what == "events" else None))
        return
    print(HEAD)
    linear = Linear()
    for count in (*SIZES, *((LARGE,) if arguments.large else ())):
        measure(count, linear)


if __name__ == "__main__":
    main()
