"""Simulated runs turned into native ones, so that what a fit has to find is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from rsltrace.trace.format import ATTACHMENT_JOB, METADATA_NATIVE, TIMING
from rsltrace.trace.model.event import NO_EVENT, OutputKind, RandomDecision, encode_decision
from rsltrace.trace.reader import Trace
from rsltrace.trace.recorder import Recorder
from rsltrace.trace.writer import TraceWriter

BITS = encode_decision(1).bit_length() - 1
AHEAD_NS = 1_700_000_000 * 10**9
"""By how much the system clock is ahead of the steady one."""


def as_native(
    simulated: Path,
    path: Path,
    *,
    clock: Callable[[int], int] = lambda at_ns: at_ns + AHEAD_NS,
    unknown: frozenset[str] = frozenset(),
    before_ns: int = 0,
    together: Mapping[str, str] = MappingProxyType({}),
    executor: str = "",
) -> Path:
    """Write a simulated run as if it had been observed: what was drawn there has been measured.

    ``clock`` is the system clock at a steady time; of messages on topics that are ``unknown`` the
    sender is. ``before_ns`` is what an executor needs before a callback begins: that much of what
    was drawn as its time. Nodes that are ``together`` with another one ran in its thread;
    ``executor`` is what the trace says of executors.
    """
    with Trace.open(simulated) as trace, TraceWriter(path, force=False) as writer:
        writer.add_metadata("rsltrace:job", dict(trace.job))
        writer.add_attachment(ATTACHMENT_JOB, "application/yaml", trace.job_text.encode())
        writer.add_metadata(METADATA_NATIVE, {"mode": "native", "executor": executor})
        recorder = Recorder(writer, keep_payload=lambda topic: False)
        threads: dict[str, int] = {}
        places: dict[tuple[int, int], int] = {}
        left: dict[tuple[int, int], int] = {}
        delays: dict[tuple[int, int, int], int] = {}
        for index in range(trace.event_count):
            event = trace.event(index)
            entity = trace.entity(event.entity)
            busy_ns, sent = 0, -1
            for place, output in enumerate(trace.outputs_of(index)):
                kind, value = output.hash >> BITS, output.hash & (1 << BITS) - 1
                if output.kind is not OutputKind.DRAW:
                    sent = place
                    places[index, place] = recorder.outputs
                    left[index, place] = event.stamp_ns + busy_ns
                    if output.kind is OutputKind.ENTITY:
                        recorder.entity(trace.entity(output.entity))
                    else:
                        recorder.output(int(output.kind), output.entity, output.hash)
                elif kind == RandomDecision.EXECUTION:
                    busy_ns = value
                elif kind == RandomDecision.DELAY:
                    delays[index, sent, output.entity] = value
            cause = event.cause_event, event.cause_output
            source_ns = left.get(cause, 0)
            ready_ns = source_ns + delays.get((*cause, event.entity), 0) if source_ns else 0
            node = trace.node_of(entity).name
            late_ns = min(before_ns, busy_ns)
            known = event.cause_event != NO_EVENT and entity.name not in unknown
            recorder.writer.add_timing(
                TIMING.pack(
                    index,
                    event.stamp_ns + late_ns,
                    clock(event.stamp_ns + late_ns),
                    busy_ns - late_ns,
                    0,
                    clock(source_ns) if source_ns else 0,
                    clock(ready_ns if source_ns else event.stamp_ns),
                    0,
                    threads.setdefault(together.get(node, node), len(threads) + 1),
                ),
                event.stamp_ns,
            )
            recorder.end_event(
                event.stamp_ns + late_ns,
                int(event.kind),
                int(event.flags),
                event.entity,
                event.cause_event if known else NO_EVENT,
                places.get(cause, 0) if known else 0,
                event.input_hash,
            )
        writer.close(result={"exit_code": "0", "stop_reason": "the end"})
    return path
