"""What is said of each of the two runs as a whole."""

from __future__ import annotations

from rsltrace.diff.result.traces import Side
from rsltrace.model.stamp import format_seconds
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace


def stop_reason(trace: Trace) -> str:
    """Return why a run ended, in words."""
    if not trace.complete:
        return "interrupted"
    return trace.result.get("stop_reason") or "no reason given"


def side(trace: Trace) -> Side:
    """Return what is said of a run as a whole."""
    return Side(
        path=trace.name,
        digest="" if is_native(trace) else trace.digest,
        events=trace.event_count,
        end_ns=trace.end_ns,
        complete=trace.complete,
        stop_reason=stop_reason(trace),
    )


def interruptions(a: Trace, b: Trace) -> list[str]:
    """Return a note for each run whose recording was cut off."""
    return [
        f"the recording of {name} ({trace.name}) was interrupted: compared is what is there, "
        f"{trace.event_count} events up to {format_seconds(trace.end_ns)} s"
        for name, trace in (("a", a), ("b", b))
        if not trace.complete
    ]
