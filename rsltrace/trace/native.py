"""Which traces are of native runs.

A native run was observed on rclpy's own executors in real time. Its digest cannot repeat; instead
it has the times of the callbacks (``trace.timings``).
"""

from __future__ import annotations

from rsltrace.errors import TraceError
from rsltrace.trace.format import METADATA_NATIVE
from rsltrace.trace.model.texts import NS_PER_S
from rsltrace.trace.reader import Trace

CUT_AFTER_NS = 2 * NS_PER_S
"""A longer callback is in the trace in parts."""


def is_native(trace: Trace) -> bool:
    return trace.metadata(METADATA_NATIVE).get("mode") == "native"


def run_name(trace: Trace) -> str:
    return "native" if is_native(trace) else trace.digest


def refuse_native(trace: Trace, what: str) -> None:
    """Raise TraceError if a trace is of a native run, which has no ``what``."""
    if is_native(trace):
        raise TraceError(
            f"{trace.name} is of a native run: it was observed, not simulated, so {what}; record "
            "the job without --native for a run that repeats"
        )
