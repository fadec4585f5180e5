"""What there is to know of each of the two runs as a whole."""

from __future__ import annotations

from rsltrace.diff.facts.remarks import Remark, TruncatedRecording
from rsltrace.diff.result import ComparedRun
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace


def stop_reason(trace: Trace) -> str:
    if not trace.complete:
        return "interrupted"
    return trace.result.get("stop_reason") or "no reason given"


def side(trace: Trace) -> ComparedRun:
    """Return what there is to know of a run as a whole."""
    return ComparedRun(
        path=trace.name,
        digest="" if is_native(trace) else trace.digest,
        events=trace.event_count,
        end_ns=trace.stamp(trace.end_ns),
        complete=trace.complete,
        stop_reason=stop_reason(trace),
    )


def interruptions(a: Trace, b: Trace) -> list[Remark]:
    """Return a remark for each run whose recording was cut off."""
    return [
        TruncatedRecording(name, trace.name, trace.event_count, trace.end_ns)
        for name, trace in (("a", a), ("b", b))
        if not trace.complete
    ]
