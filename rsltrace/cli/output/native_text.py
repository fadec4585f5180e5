"""What ``rsltrace info`` says of a native run: how it was run, and its times."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime, timezone
from typing import Any

from rsltrace.trace.format import METADATA_NATIVE
from rsltrace.trace.model.printable import printable
from rsltrace.trace.model.stamp import NS_PER_S, format_duration
from rsltrace.trace.native import Spread, busy_threads, callback_figures
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.table import table

NO_DIGEST = "none: a native run is observed, and no other run has the same times"
_CLOCKS = ("wall_ns", "steady_ns", "mode", "ignored")


def real_time(trace: Trace) -> str:
    """Return when a native run was, and how long."""
    begun = datetime.fromtimestamp(trace.start_ns // NS_PER_S, timezone.utc)
    length = format_duration(max(trace.end_ns - trace.start_ns, 0))
    return f"real time, from {begun:%Y-%m-%d %H:%M:%S} UTC on  ({length})"


def native_lines(trace: Trace) -> list[str]:
    """Return how the run was made, and a table of its callbacks' times."""
    described = trace.metadata(METADATA_NATIVE)
    rows = [
        (f"  {printable(key)}", printable(value))
        for key, value in described.items()
        if key not in _CLOCKS
    ]
    if described.get("ignored"):
        rows.append(("  of the job without effect", printable(described["ignored"])))
    if levels := trace.result.get("thread_priorities"):
        rows.append(("  real-time priorities", printable(levels)))
    observer, pen = (trace.result.get(key, "") for key in ("observer_ns", "pen_ns"))
    if observer.isdigit() and pen.isdigit():
        text = f"{format_duration(int(observer))} per callback in its thread (median), and "
        rows.append(("  observer", f"{text}{format_duration(int(pen))} beside it"))
    if (spent := trace.result.get("callback_ns", "")).isdigit():
        whole = "of processor time per callback: all of the nodes, rclpy and the middleware"
        rows.append(("  callbacks", f"{format_duration(int(spent))} {whole}"))
    busy = ", ".join(f"{part:.1%}" for part in busy_threads(trace).values())
    if busy:
        rows.append(("  threads busy", busy))
    lines = ["", "native run", *table(rows)]
    figures = callback_figures(trace)
    if not figures:
        return lines
    head = ("  node", "callback", "of", "runs", "duration", "waited", "latency", "jitter", "lost")
    cells = [head]
    for one in figures:
        entity = one.entity
        cells.append(
            (
                f"  {printable(trace.node_of(entity).name)}",
                printable(entity.name),
                entity.kind.label,
                str(one.duration.count),
                _text(one.duration),
                _text(one.wait),
                _text(one.latency),
                _text(one.jitter),
                "-" if one.lost is None else str(one.lost),
            )
        )
    title = "times of callbacks: median, 95 % quantile and maximum in ms"
    return [*lines, "", title, *table(cells, right=frozenset((3, 4, 5, 6, 7, 8)))]


def native_json(trace: Trace) -> dict[str, Any]:
    """Return the same for programs; durations in nanoseconds."""
    return {
        **trace.metadata(METADATA_NATIVE),
        "threads_busy": busy_threads(trace),
        "callbacks": [
            {
                "entity": one.entity.id,
                **{
                    name: None if found is None else asdict(found)
                    for name in ("duration", "wait", "latency", "jitter")
                    for found in [getattr(one, name)]
                },
                "lost": one.lost,
            }
            for one in callback_figures(trace)
        ],
    }


def _text(found: Spread | None) -> str:
    if found is None:
        return "-"
    return " ".join(_ms(value) for value in (found.median_ns, found.p95_ns, found.max_ns))


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / 1e6:.3g}" if abs(duration_ns) < 10**9 else f"{duration_ns / 1e6:.0f}"
