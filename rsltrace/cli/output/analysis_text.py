"""The report of ``rsltrace analyze``: chains with bounds and worst observed response times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from textwrap import fill
from typing import Any

from rsltrace.native.timing.analysis import ChainResult, TimingAnalysis, WorstResponse
from rsltrace.trace.model.texts import format_duration
from rsltrace.trace.words.phrases import table

_NS_PER_MS = 1e6


def picture_of(found: TimingAnalysis) -> Any:
    """Return a matplotlib figure of the chains: bound, observations and deadline of each."""
    from matplotlib.figure import Figure

    chains = list(reversed(found.chains))
    figure = Figure(figsize=(9, 1.2 + 0.5 * len(chains)), layout="constrained")
    axes = figure.add_subplot()
    rows = range(len(chains))
    bounds = [(one.bound_ns or 0) / _NS_PER_MS for one in chains]
    axes.barh(rows, bounds, height=0.6, color="#c6d4e1", label="bound")
    for row, one in zip(rows, chains, strict=True):
        marks = [(one.simulated, "o", "#1b6ca8", "simulated, worst")]
        marks += [(seen, "x", "#b5482a", "native, worst") for seen in one.native]
        for seen, mark, color, label in marks:
            if seen is not None:
                axes.plot(seen.worst_ns / _NS_PER_MS, row, mark, color=color, label=label)
        if one.deadline_ns is not None:
            at = one.deadline_ns / _NS_PER_MS
            axes.plot([at, at], [row - 0.4, row + 0.4], color="black", label="deadline")
        if one.bound_ns is None:
            axes.text(0, row, " no bound", va="center", color="#b5482a")
    axes.set_yticks(list(rows), [fill(one.name, 45) for one in chains])
    axes.set_xlabel("response time in ms")
    handles, labels = axes.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=len(shown))
    return figure


_TIMES = {
    "job": "maximum of the job's execution:",
    "max": "maximum measured",
    "p99": "99 % quantile measured; bounds hold only as often",
}


def text(found: TimingAnalysis, times: str, native: Sequence[str]) -> list[str]:
    """Return a table of chains, of executors, and how many chains meet their deadlines."""
    columns = ["native" if len(native) == 1 else f"native {n + 1}" for n in range(len(native))]
    rows = [("chain", "period", "bound", "simulated", *columns, "deadline", "", "by")]
    for one in found.chains:
        rows.append(
            (
                one.name,
                _time(one.period_ns),
                "none" if one.bound_ns is None else _time(one.bound_ns),
                _seen(one.simulated),
                *map(_seen, one.native),
                _time(one.deadline_ns),
                one.verdict,
                one.method,
            )
        )
    right = frozenset(range(1, len(columns) + 5))
    lines = [f"execution times: {_TIMES[times]}", "", *table(rows, right=right), ""]
    loads = ", ".join(f"{name} {part:.1%}" for name, part in found.load.items())
    if loads:
        lines.append(f"maximum load: {loads}")
    late = [one for one in found.chains if one.verdict in ("misses", "may miss")]
    if late:
        lines += [_why(one) for one in late]
    else:
        lines.append("every chain meets its deadline")
    return lines


def _why(one: ChainResult) -> str:
    deadline = format_duration(one.deadline_ns or 0)
    if one.verdict == "misses":
        seen = format_duration(one.seen_ns or 0)
        return f"{one.name} misses its deadline of {deadline}: it took {seen}"
    if one.bound_ns is None:
        return f"{one.name} may miss its deadline of {deadline}: there is no bound"
    bound = format_duration(one.bound_ns)
    return f"{one.name} may miss its deadline of {deadline}: it takes up to {bound}"


def as_json(found: TimingAnalysis, times: str) -> dict[str, Any]:
    """Return the analysis as JSON-compatible values; times in nanoseconds."""
    return {
        "times": times,
        "meets": found.all_meet,
        "chains": [
            {
                "name": one.name,
                "callbacks": [callback._asdict() for callback in one.chain],
                "period_ns": one.period_ns,
                "deadline_ns": one.deadline_ns,
                "bound_ns": one.bound_ns,
                "analysis": one.method,
                "simulated": None if one.simulated is None else asdict(one.simulated),
                "native": [None if seen is None else asdict(seen) for seen in one.native],
                "verdict": one.verdict,
            }
            for one in found.chains
        ],
        "executors": dict(found.load),
        "execution_ns": [
            {**callback._asdict(), "longest_ns": longest_ns}
            for callback, longest_ns in found.times.items()
        ],
        "notes": list(found.notes),
    }


def _time(time_ns: int | None) -> str:
    return "-" if time_ns is None else format_duration(time_ns)


def _seen(seen: WorstResponse | None) -> str:
    return "-" if seen is None else format_duration(seen.worst_ns)
