"""The page of a run: what it is, what went wrong, its graph, what ran how often, logs and plots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby

from markupsafe import Markup

from rsltrace.errors import RsltraceError, SetupError
from rsltrace.simulation.middleware.overview import GraphEnd, GraphLink, GraphNode, GraphOverview
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.operation import NODE_TOPICS, is_built_in
from rsltrace.trace.model.texts import format_duration, shortened
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.logs import LEVEL_WARN
from rsltrace.trace.words.phrases import path_word
from rsltrace_viewer.model.logs import Logs, read_logs
from rsltrace_viewer.model.overview import (
    Checks,
    OverviewSection,
    callbacks_of,
    nodes_of,
    topics_of,
    troubles_of,
    unheard_of,
)
from rsltrace_viewer.model.plots.runs import RunPlots
from rsltrace_viewer.model.plots.series import most_telling
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.pages.charts import curves
from rsltrace_viewer.pages.page import render_page
from rsltrace_viewer.session import Session

_ROWS_MAX = 100
_NAME_MAX = 80
_LOGS_MAX = 100
_PLOTS_MAX = 8
_SENDERS = {
    EntityKind.PUBLISHER: "topic",
    EntityKind.CLIENT: "service",
    EntityKind.ACTION_CLIENT: "action",
}
_RECEIVERS = {
    EntityKind.SUBSCRIPTION: "topic",
    EntityKind.SERVICE: "service",
    EntityKind.ACTION_SERVER: "action",
}


def run_page(
    trace: Trace,
    facts: Sequence[tuple[str, str]],
    summary: str,
    draw: Callable[[GraphOverview], str],
) -> str:
    """Return the page of a run, given its facts, its summary as text, and what draws graphs.

    Raises TraceError.
    """
    run = Run(trace)
    session = Session(run)
    for _ in session.survey():
        pass
    *_, logs = read_logs(run)
    overview, checks = session.overviews["a"], session.checks.get("a", Checks())
    violated = [
        (one.name, found.text, "" if found.event is None else str(found.event))
        for one in checks.violated
        for found in one.violations
    ]
    troubles = [one for one in troubles_of(run, overview, logs) if one.count]
    bad = [one.first for one in troubles if one.bad]
    bad += [found.event for one in checks.violated for found in one.violations]
    first = min((one for one in bad if one is not None), default=None)
    at = "" if first is None else f" --at {first}"
    return render_page(
        "run.html",
        name=run.name,
        facts=facts,
        summary=summary,
        good=trace.complete and not violated and not any(one.bad for one in troubles),
        troubles=[(one.what, str(one.count), _text(one.first)) for one in troubles],
        unheard=unheard_of(run),
        checks=checks,
        violated=violated[:_ROWS_MAX],
        graph=_graph(trace, draw),
        nodes=[*_sections(nodes_of(run, overview))],
        callbacks=[*_sections(callbacks_of(run, overview))],
        topics=[*_sections(topics_of(run, overview))],
        chains=[
            (one.name, *(format_duration(ns) for ns in (of.p50_ns, of.p95_ns, of.max_ns)))
            for one in session.chains.get("a", ())[:_ROWS_MAX]
            if (of := one.latency) is not None
        ],
        logs=[*_logs(run, logs)],
        log_count=len(logs.lines),
        plots=[*_plots(run)],
        commands=[] if is_native(trace) else [f"rsltrace view {path_word(trace.name)}{at}"],
    )


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _sections(found: Sequence[OverviewSection]) -> Iterator[tuple[str, ...]]:
    for one in found[:_ROWS_MAX]:
        rate = "" if one.rate_hz is None else f"{one.rate_hz:.4g}"
        times = [
            f"{format_duration(of.mean_ns, 3)} / {format_duration(of.most_ns, 3)}"
            if of is not None and of.count
            else ""
            for of in (one.waited, one.took)
        ]
        of = ("", "") if one.name == one.node else (one.kind, one.node)
        yield (one.name, *of, f"{one.count:,}", rate, f"{one.share:.1%}", *times)


def _logs(run: Run, logs: Logs) -> Iterator[tuple[str, ...]]:
    """Yield warnings and worse; without any, the last records."""
    worse = [line for line in logs.lines if line.record.level >= LEVEL_WARN]
    for line in (worse or logs.lines[-_LOGS_MAX:])[:_LOGS_MAX]:
        record = line.record
        time = f"{(line.stamp_ns - run.base_ns) / 1e9:.6f}"
        yield time, record.level_name, record.name, line.text, record.place


def _graph(trace: Trace, draw: Callable[[GraphOverview], str]) -> Markup | None:
    """Draw who publishes and subscribes; None where what lays it out is not installed."""
    entities = [
        replace(one, name=shortened(one.name, _NAME_MAX), type=shortened(one.type, _NAME_MAX))
        for one in trace.entities.values()
        if not is_built_in(one)
    ]
    nodes = [GraphNode(one.name, one.type, ()) for one in entities if one.kind is EntityKind.NODE]

    def key(one: Entity) -> tuple[str, str]:
        return {**_SENDERS, **_RECEIVERS}[one.kind], one.name

    ends = sorted((one for one in entities if one.kind in {**_SENDERS, **_RECEIVERS}), key=key)
    links = [
        GraphLink(kind, name, group[0].type, _ends(trace, group, _SENDERS), others)
        for (kind, name), found in groupby(ends, key)
        if (group := [*found]) is not None
        and ((others := _ends(trace, group, _RECEIVERS)) or name not in NODE_TOPICS)
    ]
    try:
        return Markup(draw(GraphOverview(tuple(nodes), tuple(links))))
    except SetupError:
        return None


def _ends(
    trace: Trace, group: Sequence[Entity], kinds: dict[EntityKind, str]
) -> tuple[GraphEnd, ...]:
    return tuple(
        GraphEnd(shortened(trace.node_of(one).name, _NAME_MAX))
        for one in group
        if one.kind in kinds
    )


def _plots(run: Run) -> Iterator[tuple[str, Markup]]:
    """Yield a plot of the most telling field of each topic."""
    plots = RunPlots((run,), "", topic="", stamp_ns=None)
    for topic in [name for name in plots.topics() if name not in NODE_TOPICS][:_PLOTS_MAX]:
        with suppress(RsltraceError):  # the events say what is damaged
            if fields := plots.fields(topic):
                source = most_telling(fields, plots.messages(topic))
                *_, series = plots.series(source)
                if (drawn := curves(series, source.label, None)) is not None:
                    yield source.label, drawn
