"""How fast a trace becomes a Rerun recording, in what memory, and how large it gets.

    python benchmarks/rerun_export.py [EVENTS]

The trace is a chain of nodes at 100 Hz: every other event is a timer that publishes a message
(Float64, Twist or UInt64 by turns), the one after it the subscription that gets it.
"""

from __future__ import annotations

import resource
import struct
import sys
import tempfile
import time
from pathlib import Path

from rsltrace.trace.format import CDR_HEADER, EVENT_REST, OUTPUT_CONTENT
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

EVENTS = 1_000_000
NODES = 8
PERIOD_NS = 10_000_000
_VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
_TYPES = (
    ("std_msgs/msg/Float64", "float64 data\n", "<d"),
    (
        "geometry_msgs/msg/Twist",
        f"Vector3 linear\nVector3 angular\n{'=' * 80}\nMSG: geometry_msgs/Vector3\n{_VECTOR}",
        "<6d",
    ),
    ("std_msgs/msg/UInt64", "uint64 data\n", "<Q"),
)


def write_trace(path: Path, events: int) -> None:
    """Write a run of ``events`` events."""
    mask = 2**64 - 1
    with TraceWriter(path, force=True) as writer:
        lines = []
        for number in range(NODES):
            node = 4 * number + 1
            type_name, schema, layout = _TYPES[number % len(_TYPES)]
            topic = f"/topic_{number}"
            for entity in (
                Entity(node, node, EntityKind.NODE, f"/node_{number}", "", 0, {}),
                Entity(node + 1, node, EntityKind.TIMER, f"Node{number}.on_timer", "", 0, {}),
                Entity(node + 2, node, EntityKind.PUBLISHER, topic, type_name, 0, {}),
                Entity(node + 3, node, EntityKind.SUBSCRIPTION, topic, type_name, 0, {}),
            ):
                writer.add_entity(entity)
            channel = writer.add_channel(topic, type_name, schema)
            lines.append((node, channel, struct.Struct(layout)))
        for index in range(0, events, 2):
            step, number = divmod(index // 2, NODES)
            stamp = (step + 1) * PERIOD_NS
            node, channel, layout = lines[number]
            count = len(layout.format) if layout.size > 8 else 1
            values = [step % 1000 * 0.1] * (6 if layout.size == 48 else count)
            if layout.format.endswith("Q"):
                values = [step]
            sequence = writer.add_payload(channel, stamp, CDR_HEADER + layout.pack(*values))
            seed = index * 0x9E3779B97F4A7C15 & mask
            writer.add_output(OUTPUT_CONTENT.pack(seed, node + 2, OutputKind.MESSAGE))
            writer.add_sequence(sequence)
            rest = EVENT_REST.pack(
                *(index, stamp, NO_EVENT, step, seed ^ mask, 0, node + 1, 0, 1),
                *(EventKind.TIMER, 0),
            )
            writer.add_event(rest, seed * 3 & mask)
            rest = EVENT_REST.pack(
                *(index + 1, stamp, index, seed, 0, 0, node + 3, 0, 0),
                *(EventKind.SUBSCRIPTION, 0),
            )
            writer.add_event(rest, seed * 5 & mask)
        end = str((events // 2 // NODES + 1) * PERIOD_NS)
        result = {"stop_reason": "benchmark", "exit_code": "0", "end_time": end, "start_time": "0"}
        writer.close(result=result)


def read_everything(path: Path) -> float:
    """Return the seconds that reading all events, outputs and messages takes."""
    start = time.perf_counter()
    with Trace.open(path) as trace:
        for _ in zip(trace.events(), trace.outputs(), strict=True):
            pass
        for number in range(NODES):
            for _ in trace.messages(f"/topic_{number}"):
                pass
    return time.perf_counter() - start


def main(events: int = EVENTS) -> None:
    """Measure and print."""
    from rsltrace_viewer.rerun_export import sdk

    sdk.require()
    from rsltrace_viewer.rerun_export.export import export

    with tempfile.TemporaryDirectory() as folder:
        trace, recording = Path(folder) / "run.mcap", Path(folder) / "run.rrd"
        write_trace(trace, events)
        before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        start, cpu = time.perf_counter(), time.process_time()
        done = export([trace], recording)
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        after_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        reading = read_everything(trace)
        print(f"{events} events with {events // 2} messages, trace {done.trace_bytes / 1e6:.1f} MB")
        print(f"export: {seconds:.1f} s, {events / seconds:,.0f} events/s; processors {cpu:.1f} s")
        print(f"reading the same with rsltrace alone: {reading:.1f} s")
        print(
            f"recording: {done.bytes / 1e6:.1f} MB, {done.bytes / done.trace_bytes:.2f} x the trace"
        )
        print(f"memory: {after_mb:.0f} MB at most, {before_mb:.0f} MB before")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
