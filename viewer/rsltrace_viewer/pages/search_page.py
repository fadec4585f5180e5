"""The pages of searches: of ``explore`` with its failures, of ``verify`` and ``bisect`` with the
comparison of the two runs that differ."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rsltrace.diff import diff_files
from rsltrace.diff.options import DiffOptions
from rsltrace.errors import ExploreError
from rsltrace.search.explore.report import (
    FAILS,
    Exploration,
    FailureCause,
    SettingEffect,
    causes,
    effects,
    repeat_command,
    settings,
    view_command,
)
from rsltrace.search.explore.trial import TrialResult
from rsltrace.trace.model.texts import format_duration, shortened
from rsltrace_viewer.pages.charts import histogram, number, progress, scatter
from rsltrace_viewer.pages.diff_page import part_of
from rsltrace_viewer.pages.page import render_page

_RUNS_MAX = 200
_CHARTS_MAX = 24
_PLACES_MAX = 8
_TEXT_MAX = 24


def search_page(
    title: str, rows: Sequence[tuple[str, str]], commands: Sequence[str], traces: Sequence[Path]
) -> str:
    """Return the page of a search for a difference: what was found, the commands that repeat it,
    and the comparison of two traces if there are any. Raises TraceError."""
    found: Any = diff_files(*traces) if traces else None
    parts = [] if found is None else [part_of(found, DiffOptions())]
    return render_page("search.html", title=title, rows=rows, commands=commands, comparisons=parts)


def exploration_page(explored: Exploration) -> str:
    runs = len(explored.results)
    rate = runs / explored.wall_s if explored.wall_s > 0 else 0.0
    numbers = (
        (f"{runs:,}", "runs"),
        (f"{len(explored.failed):,}", "failed"),
        (f"{len(causes(explored)):,}", "causes"),
        (f"{explored.digests:,}", "different digests"),
        (format_duration(explored.wall_s * 1e9, 3), "of real time"),
        (f"{rate:.1f}", "runs per second"),
        (explored.strategy or "-", "strategy"),
    )
    metrics = [*_metrics(explored)]
    found, why_not = _effects(explored)
    failed = explored.failed
    return render_page(
        "exploration.html",
        explored=explored,
        numbers=numbers,
        causes=[(one, _commands(explored, one)) for one in causes(explored)],
        metrics=[row for row, _ in metrics],
        histograms=[drawn for _, drawn in metrics],
        varied=any(settings(one.trial) for one in explored.results),
        effects=[_effect_row(one) for one in found],
        why_not=why_not,
        scatters=[*_scatters(explored, found)],
        progress=_progress(explored),
        failed=[_row(one) for one in failed[:_RUNS_MAX]],
        more=len(failed) - _RUNS_MAX,
    )


def _commands(explored: Exploration, cause: FailureCause) -> list[str]:
    shown = cause.shortest
    lines = [line for line in (repeat_command(explored, shown), view_command(shown)) if line]
    if cause.reduced is not None:
        lines.insert(0, f"rsltrace record {cause.reduced.folder}/job.yaml")
    return lines


def _metrics(explored: Exploration) -> Iterator[tuple[tuple[str, ...], Markup]]:
    """Yield a row of numbers for each metric, and its distribution."""
    for name in dict.fromkeys(name for one in explored.results for name in one.metrics):
        values = [
            (float(one.metrics[name]), one.failure is not None)
            for one in explored.results
            if name in one.metrics and math.isfinite(one.metrics[name])
        ]
        if not values:
            continue
        ordered = sorted(value for value, _ in values)
        middle = ordered[len(ordered) // 2]
        cells = (ordered[0], middle, sum(ordered) / len(ordered), ordered[-1])
        named = _with_unit(explored, name)
        yield (named, f"{len(values):,}", *map(number, cells)), histogram(values, named)


def _effects(explored: Exploration) -> tuple[list[SettingEffect], str]:
    try:
        return effects(explored.results), "No setting varied, or all runs had the same outcome."
    except ExploreError as error:
        return [], str(error)


def _effect_row(one: SettingEffect) -> tuple[str, ...]:
    return (
        one.setting,
        one.outcome,
        f"{one.strength:.0%}",
        {1: "increases", -1: "decreases", 0: ""}[one.sign],
        "< 0.0001" if one.p < 0.0001 else f"{one.p:.4f}",
        f"{one.runs:,}",
    )


def _scatters(explored: Exploration, found: Sequence[SettingEffect]) -> Iterator[Markup]:
    """Yield charts of the effects on metrics, the surest first."""
    varied = [settings(one.trial) for one in explored.results]
    for effect in found[:_CHARTS_MAX]:
        if effect.outcome == FAILS:
            continue
        pairs = [
            (given[effect.setting], one.metrics[effect.outcome], one.failure is not None)
            for given, one in zip(varied, explored.results, strict=True)
            if effect.setting in given and effect.outcome in one.metrics
        ]
        texts = sorted({x for x, _, _ in pairs if isinstance(x, str)})
        if len(texts) > _PLACES_MAX:
            continue
        places = {text: float(index) for index, text in enumerate(texts)}
        points = [(x if isinstance(x, float) else places[x], y, bad) for x, y, bad in pairs]
        named = _with_unit(explored, effect.outcome)
        yield scatter(points, effect.setting, named, [shortened(text, _TEXT_MAX) for text in texts])


def _progress(explored: Exploration) -> list[Markup]:
    seen: set[str] = set()
    new = []
    for one in explored.results:
        new.append(one.digest not in seen)
        seen.add(one.digest)
    return [progress(new, [one.failure is not None for one in explored.results])] if new else []


def _row(result: TrialResult) -> tuple[str, ...]:
    failure = result.failure
    assert failure is not None
    event = "" if failure.event is None else str(failure.event)
    tries = (str(result.trial.number), result.trial.why)
    return (*tries, failure.key, event, f"{result.events:,}", result.digest, result.trace or "")


def _with_unit(explored: Exploration, name: str) -> str:
    unit = explored.units.get(name)
    return f"{name} [{unit}]" if unit else name
