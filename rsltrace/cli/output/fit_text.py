"""The times of a native run, and the comparison with its simulation, as text and JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from rsltrace.checks.latency.instances import Durations
from rsltrace.native.fit.comparison import (
    NEAR,
    ChainCheck,
    LatencyCheck,
    SampleComparison,
    mismatched_percentiles,
)
from rsltrace.native.fit.fitted_job import Fit, time_text
from rsltrace.native.fit.models import DurationModel, as_job_has_it
from rsltrace.trace.model.texts import format_duration
from rsltrace.trace.words.phrases import table

_PERCENT = (50, 95, 99)
_HEAD = ("count", "p50", "p95", "p99", "max")
_NUMBERS = frozenset(range(1, 6))


def text(fit: Fit) -> list[str]:
    """Return links and callbacks with their durations as lines."""
    links: list[tuple[str, ...]] = [("delays", *_HEAD, "waits p50", "fitted as", "D")]
    links += [
        (f"  {link}", *_row(link.delays), _row(link.waits)[1], *_written(model))
        for link, model in fit.links
    ]
    executions: list[tuple[str, ...]] = [("execution", *_HEAD, "callback p50", "fitted as", "D")]
    executions += [
        (f"  {one.node}: {one.kind} {one.entity}", *_row(one.busy), _row(one.runs)[1], *_written(m))
        for one, m in fit.executions
    ]
    right = _NUMBERS | {6}
    return [
        *(table(links, right=right) if fit.links else ["no message was received"]),
        "",
        *table(executions, right=right),
    ]


def _row(durations: Durations) -> tuple[str, ...]:
    if not len(durations):
        return ("0", *("-" for _ in _HEAD[1:]))
    quantiles = [*np.percentile(durations, _PERCENT), durations.max()]
    return str(len(durations)), *(format_duration(one, 4) for one in quantiles)


def _written(model: DurationModel) -> tuple[str, str]:
    said = model.kind
    if model.kind == "empirical":
        said = f"table of {len(model.values['values'])}"
    if model.points:
        said = f"series of {len(model.points)}"
    if model.passed_over:
        said += f" (nearest: {model.passed_over})"
    return said, f"{model.distance:.3f}"


def checked_text(checked: LatencyCheck) -> list[str]:
    """Return the comparison of a simulation with a second native run as lines."""
    lines: list[str] = []
    for chain in checked.chains:
        lines += [*([""] if lines else []), chain.name]
        lines += _chain(chain)
    return lines


def _chain(chain: ChainCheck) -> list[str]:
    if chain.simulated is None:
        return ["  the simulated run does not have this chain"]
    of = chain.simulated
    rows: list[tuple[str, ...]] = [
        ("  latency", "second run", "simulated", "ratio", "95 % interval", "first run", "interval")
    ]
    natives = chain.native.quantiles if chain.native is not None else (None,) * len(of.quantiles)
    for one, native in zip(of.quantiles, natives, strict=True):
        beside = ("-", "-")
        if native is not None:
            beside = (_ratio(native.ratio), _interval(native.low, native.high))
        rows.append(
            (
                f"  p{one.percent:g}",
                format_duration(one.a_ns, 4),
                format_duration(one.b_ns, 4),
                _ratio(one.ratio),
                _interval(one.low, one.high),
                *beside,
            )
        )
    lines = table(rows, right=frozenset(range(1, 7)))
    lines.append(f"  simulated and second run: {_tested(of)}")
    if chain.native is not None:
        lines.append(f"  first and second run: {_tested(chain.native)}")
    if chain.own is not None:
        ratios = ", ".join(f"p{q.percent:g} {_ratio(q.ratio)}" for q in chain.own.quantiles)
        lines.append(f"  simulated and first run: {_tested(chain.own)}; ratios {ratios}")
    lines.append(f"  {_verdict(of, chain.native)}")
    return lines


def _verdict(simulated: SampleComparison, native: SampleComparison | None) -> str:
    within = f"within {NEAR * 100:g} % of the second run"
    if not mismatched_percentiles(simulated):
        return f"the simulated run is {within}"
    said = f"the simulated run is not {within}: {_named(mismatched_percentiles(simulated))}"
    if native is not None and mismatched_percentiles(native):
        said += f"; nor is the first run: {_named(mismatched_percentiles(native))}"
    return said


def _named(percent: list[float]) -> str:
    return ", ".join(f"p{one:g}" for one in percent)


def _ratio(ratio: float) -> str:
    return "-" if math.isnan(ratio) else f"{ratio:.3f}"


def _interval(low: float, high: float) -> str:
    return "-" if math.isnan(low) else f"{low:.3f} … {high:.3f}"


def _tested(of: SampleComparison) -> str:
    p_value = "p < 0.0001" if of.p_value < 1e-4 else f"p {of.p_value:.2g}"
    return (
        f"D {of.distance:.3f} ({p_value}; {of.count_b} and {of.count_a} latencies), "
        f"mean difference {format_duration(of.moved_ns, 4)}"
    )


def as_json(fit: Fit, notes: list[str], checked: LatencyCheck | None) -> dict[str, Any]:
    """Return what was measured as JSON-compatible values; times in ns."""
    values: dict[str, Any] = {
        "delays": [
            {
                "topic": link.topic,
                "from": link.sender,
                "to": link.receiver or None,
                "service": link.is_service,
                "delay": _figures(link.delays),
                "wait": _figures(link.waits),
                "negative": link.negative,
                "missing": link.missing,
                "model": _model(model),
            }
            for link, model in fit.links
        ],
        "execution": [
            {
                "node": one.node,
                "entity": one.entity,
                "kind": one.kind,
                "busy": _figures(one.busy),
                "callback": _figures(one.runs),
                "correlation": one.tied,
                "model": _model(model),
            }
            for one, model in fit.executions
        ],
        "executors": [asdict(one) for one in fit.measured.executors],
        "notes": notes,
    }
    if checked is not None:
        values["check"] = [_checked(chain) for chain in checked.chains]
    return values


def _figures(durations: Durations) -> dict[str, int] | None:
    if not len(durations):
        return None
    quantiles = np.percentile(durations, _PERCENT).astype(np.int64).tolist()
    return {
        "count": len(durations),
        **{f"p{p}_ns": value for p, value in zip(_PERCENT, quantiles, strict=True)},
        "max_ns": int(durations.max()),
    }


def _model(model: DurationModel) -> dict[str, Any]:
    return {"distance": model.distance, "said": as_job_has_it(model, time_text)}


def _checked(chain: ChainCheck) -> dict[str, Any]:
    def plain(of: SampleComparison | None) -> dict[str, Any] | None:
        if of is None:
            return None
        values = asdict(of)
        for quantile in values["quantiles"]:
            for key in ("ratio", "low", "high"):
                quantile[key] = None if math.isnan(quantile[key]) else quantile[key]
        return values

    return {
        "chain": chain.name,
        "simulated": plain(chain.simulated),
        "first_run": plain(chain.native),
        "simulated_to_first": plain(chain.own),
        "far": []
        if chain.simulated is None
        else [f"p{one:g}" for one in mismatched_percentiles(chain.simulated)],
    }
