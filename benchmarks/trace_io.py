"""How fast traces are written and read, beside the mcap package doing the same, in one run.

    python benchmarks/trace_io.py [EVENTS]

Prints thousands of messages per second (an event with its output and its payload is three), the
ratio to the mcap package, and what opening a trace and looking up an event cost. Nothing is hashed
here: these are the costs of the file alone.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rsltrace.trace.format import CDR_HEADER, EVENT_REST, OUTPUT, OUTPUT_CONTENT
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

EVENTS = 300_000
MESSAGES_PER_EVENT = 3
_PAYLOAD = CDR_HEADER + bytes(60)
_TOPIC, _TYPE, _SCHEMA = "/topic", "std_msgs/msg/UInt64MultiArray", "uint64[] data\n"


def write_trace(path: Path, events: int) -> None:
    """Write ``events`` events, each with one output that is a message."""
    pack_event, pack_output = EVENT_REST.pack, OUTPUT_CONTENT.pack
    with TraceWriter(path, force=True) as writer:
        writer.add_entity(Entity(1, 0, EntityKind.PUBLISHER, _TOPIC, _TYPE, 0, {}))
        channel = writer.add_channel(_TOPIC, _TYPE, _SCHEMA)
        kind, output_kind = int(EventKind.TIMER), int(OutputKind.MESSAGE)
        for index in range(events):
            stamp = index * 1000
            sequence = writer.add_payload(channel, stamp, _PAYLOAD)
            writer.add_output(pack_output(index * 7, 1, output_kind))
            writer.add_sequence(sequence)
            rest = pack_event(index, stamp, 0, index * 3, index * 5, 0, 1, 0, 1, kind, 0)
            writer.add_event(rest, index * 11)
        writer.close(result={"stop_reason": "benchmark", "exit_code": "0"})


def write_mcap(path: Path, events: int) -> None:
    """Write the same messages with the mcap package."""
    pack_event, pack_output = EVENT_REST.pack, OUTPUT.pack
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        schema = writer.register_schema(_TYPE, "ros2msg", _SCHEMA.encode())
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/e", "/o", "/t")]
        for index in range(events):
            stamp = index * 1000
            rest = pack_event(index, stamp, 0, index * 3, index * 5, 0, 1, 0, 1, 2, 0)
            datas = (
                CDR_HEADER + (index * 11).to_bytes(8, "little") + rest,
                CDR_HEADER + pack_output(index, index * 7, 1, 1, index),
                _PAYLOAD,
            )
            for channel, data in zip(channels, datas, strict=True):
                writer.add_message(channel, stamp, data, stamp, index)
        writer.finish()


def read_events(path: Path) -> int:
    """Read all events as arrays and return how many there are."""
    with Trace.open(path) as trace:
        return sum(len(events) for events in trace.events())


def read_messages(path: Path) -> int:
    """Read all messages of the ROS topic and return how many there are."""
    with Trace.open(path) as trace:
        return sum(1 for _ in trace.messages(_TOPIC))


def read_mcap(path: Path) -> int:
    """Read the same messages of the ROS topic with the mcap package."""
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(topics=[_TOPIC]))


def open_trace(path: Path) -> None:
    """Open a trace and ask for its digest."""
    with Trace.open(path) as trace:
        assert len(trace.digest) == 16


def look_up(path: Path, count: int = 200) -> float:
    """Return the seconds that looking up one event, its outputs and a payload takes, at random."""
    rng = random.Random(1)
    with Trace.open(path) as trace:
        indexes = [rng.randrange(trace.event_count) for _ in range(count)]
        start = time.perf_counter()
        for index in indexes:
            trace.event(index)
            for output in trace.outputs_of(index):
                trace.payload(output)
        return (time.perf_counter() - start) / count


def best_of(function: Callable[[], object], repeat: int = 3) -> float:
    """Return the shortest of some runs, in seconds: the least disturbed by others."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main(events: int = EVENTS) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "run.mcap", Path(folder) / "mcap.mcap"
        messages = events * MESSAGES_PER_EVENT / 1000
        write_ours = best_of(lambda: write_trace(ours, events))
        write_theirs = best_of(lambda: write_mcap(theirs, events), repeat=1)
        read_theirs = best_of(lambda: read_mcap(ours), repeat=1)
        read_ours = best_of(lambda: read_messages(ours))
        thousands = events / 1000
        rows = (
            ("write, rsltrace", messages / write_ours, write_theirs / write_ours),
            ("write, mcap package", messages / write_theirs, 1.0),
            ("read events, rsltrace", thousands / best_of(lambda: read_events(ours)), None),
            ("read one topic, rsltrace", thousands / read_ours, read_theirs / read_ours),
            ("read one topic, mcap package", thousands / read_theirs, 1.0),
        )
        print(
            f"{events} events, {ours.stat().st_size / 1e6:.1f} MB "
            f"(mcap package: {theirs.stat().st_size / 1e6:.1f} MB)"
        )
        print(f"{'':30} 1000 messages/s   ratio")
        for name, rate, ratio in rows:
            print(f"{name:30} {rate:15.0f}   {'' if ratio is None else f'{ratio:.1f}'}")
        print(f"write, per event: {write_ours / events * 1e6:.2f} us")
        print(f"open and digest: {best_of(lambda: open_trace(ours), repeat=10) * 1e3:.2f} ms")
        print(f"look up an event with its payload: {look_up(ours) * 1e3:.2f} ms")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
