"""``rsltrace info``: a summary of a trace."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any, TypeAlias

import click

from rsltrace.cli.output.text_file import write_text
from rsltrace.terminal import say, terminal_width
from rsltrace.trace.contents import TraceCounts, count_trace
from rsltrace.trace.format import (
    EVENTS_PER_SEGMENT,
    FORMAT_VERSION,
    METADATA_GUARD,
    METADATA_NATIVE,
)
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.finding import decode_drops, decode_unseen, decode_waits, unseen_notes
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.regular_file import check_not_input
from rsltrace.trace.model.texts import (
    NS_PER_S,
    format_duration,
    format_milliseconds,
    format_seconds,
    printable,
)
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import DurationStatistics, busy_threads, callback_figures
from rsltrace.trace.words.code import entity_places, places_text
from rsltrace.trace.words.entities import kind_label
from rsltrace.trace.words.phrases import table

_NO_DIGEST = "none: no two native runs have the same times"
_NO_EVENTS = "none: the file is cut before its first event"
_FORMATS = ("text", "json", "html")
_CLOCKS = ("wall_ns", "steady_ns", "mode", "ignored")


def real_time(trace: Trace) -> str:
    """Return when a native run started, and how long it took."""
    begun = datetime.fromtimestamp(trace.start_ns // NS_PER_S, timezone.utc)
    length = format_duration(max(trace.end_ns - trace.start_ns, 0))
    return f"real time, from {begun:%Y-%m-%d %H:%M:%S} UTC  ({length})"


def native_lines(trace: Trace) -> list[str]:
    """Return the settings of a native run, and a table of its callbacks' times."""
    described = trace.metadata(METADATA_NATIVE)
    rows = [
        (f"  {printable(key)}", printable(value))
        for key, value in described.items()
        if key not in _CLOCKS
    ]
    if described.get("ignored"):
        rows.append(("  ignored keys of the job", printable(described["ignored"])))
    if levels := trace.result.get("thread_priorities"):
        rows.append(("  real-time priorities", printable(levels)))
    if missing := trace.result.get("missing"):
        rows.append(("  missing", printable(missing)))
    observer, pen = (trace.result.get(key, "") for key in ("observer_ns", "pen_ns"))
    if observer.isdigit() and pen.isdigit():
        text = f"{format_duration(int(observer))} per callback in its thread (median), and "
        rows.append(("  overhead", f"{text}{format_duration(int(pen))} in the writing thread"))
    if (spent := trace.result.get("callback_ns", "")).isdigit():
        whole = "of CPU time per callback, with rclpy and the middleware"
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
    """Return the same as JSON values; durations in nanoseconds."""
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


def _text(found: DurationStatistics | None) -> str:
    if found is None:
        return "-"
    return " ".join(
        format_milliseconds(value) for value in (found.median_ns, found.p95_ns, found.max_ns)
    )


_Kinds: TypeAlias = type[EventKind] | type[OutputKind]
_VALUE_MAX = 100
_OPTIONAL = (8, 4, 6)
"""Columns of entities that a narrow terminal does without, in this order: code, type, outputs."""


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMATS),
    default="text",
    show_default=True,
    help="Format of the summary; html is a page for the browser.",
)
@click.option("--json", "form", flag_value="json", help="Print one JSON object.")
@click.option(
    "--all", "show_all", is_flag=True, help="List every entity (--json always lists all)."
)
@click.option(
    "--check",
    is_flag=True,
    help="First verify all checksums, hashes and messages of the file.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the summary to FILE.",
)
def info(trace: Path, form: str, show_all: bool, check: bool, output: Path | None) -> None:
    """Summarize TRACE: its digest, counts, nodes, and entities with their rates.

    Runs with the same digest are identical. A rate is events (for publishers: messages) per second
    of simulated time, between the first and the last. If the run was killed, the
    summary covers what was written. A native run has no digest; its callback times are listed.
    """
    if output is not None:
        check_not_input(output, [trace])
    with Trace.open(trace) as opened:
        if check:
            from rsltrace.cli.output.search_progress import working
            from rsltrace.trace.contents import check_contents

            with working(f"checking {opened.name}"):
                opened.check()
                check_contents(opened)
        counts = count_trace(opened)
        width = terminal_width() if output is None and form == "text" else None
        text = "\n".join(_as_text(opened, counts, show_all or form == "html", width))
        if form == "json":
            text = json.dumps(_as_json(opened, counts), indent=2)
        elif form == "html":
            from rsltrace_viewer.pages.run_page import run_page

            from rsltrace.cli.output.graph_svg import graph_svg

            draw = partial(graph_svg, in_page=True)
            text = run_page(opened, _facts(opened, counts), text, draw)
        if output is None:
            say(text)
        else:
            write_text(output, f"{text}\n")


def _facts(trace: Trace, counts: TraceCounts) -> list[tuple[str, str]]:
    """Return what the run is, as names with values."""
    start, end = (format_seconds(trace.stamp(at)) for at in (trace.start_ns, trace.end_ns))
    since = f", from simulated time {format_seconds(trace.start_ns)} s" if trace.start_ns else ""
    time = ("simulated", f"{start} s to {end} s  ({format_duration(_duration_ns(trace))}){since}")
    native = is_native(trace)
    if native:
        time = ("recorded", real_time(trace))
    size = f"{trace.size} bytes, format {FORMAT_VERSION}, {printable(trace.header.library)}"
    return [
        ("trace", f"{printable(Path(trace.name).name)}  ({size})"),
        ("state", _state(trace)),
        *(() if trace.complete or native else (("next", _TRUNCATED),)),
        *(("waiting", text) for text in _waits(trace)),
        ("digest", _digest(trace) or (_NO_DIGEST if native else _NO_EVENTS)),
        time,
        ("events", _by_kind(trace.event_count, counts.event_kinds, EventKind)),
        ("outputs", _by_kind(trace.output_count, counts.output_kinds, OutputKind)),
    ]


def _digest(trace: Trace) -> str | None:
    """Return the digest of a run, None if it has none."""
    has_events = trace.complete or trace.event_count
    return trace.digest if has_events and not is_native(trace) else None


def _as_text(trace: Trace, counts: TraceCounts, show_all: bool, width: int | None) -> list[str]:
    """Return the summary as lines, for a terminal of ``width`` columns (None: of any length)."""
    facts, lines = _facts(trace, counts), []
    indent = " " * (max(len(name) for name, _ in facts) + 2)
    for line in table(facts):
        lines += wrap(line, width, subsequent_indent=indent) if width else [line]
    for title, mapping in (("job", trace.job), ("environment", trace.environment)):
        if mapping:
            rows = [(f"  {printable(key)}", _short(value)) for key, value in mapping.items()]
            lines += ["", title, *table(rows)]
    if is_native(trace):
        lines += native_lines(trace)
    if edits := trace.edits:
        lines += ["", "edits of this branch", *(f"  {printable(e)}" for e in edits)]
    lines += _guard_lines(trace)
    lines += _drop_lines(trace)
    lines += (f"note: {one}" for one in unseen_notes(decode_unseen(trace.result)))
    lines += ["", *_node_lines(trace, counts)]
    return [*lines, "", *_entity_lines(trace, counts, show_all, width)]


def _short(value: str) -> str:
    """Return a value of metadata if it fits on a line, else its length."""
    text = printable(value)
    return text if len(text) <= _VALUE_MAX else f"{len(text)} characters; --json shows them"


_TRUNCATED = (
    f"the last events (up to {EVENTS_PER_SEGMENT - 1}) are missing; to get them, record the job "
    "again with --set record.segment_events=1"
)


def _state(trace: Trace) -> str:
    if not trace.complete:
        return "truncated: the run was killed, crashed, or is still running"
    reason = printable(trace.result.get("stop_reason", "no reason given"))
    return f"complete: {reason}, exit code {printable(trace.result.get('exit_code', 'unknown'))}"


def _waits(trace: Trace) -> list[str]:
    """Return the calls that were still waiting at the end."""
    return [
        f"since {format_seconds(trace.stamp(w.since_ns))} s: {w.text}"
        for w in decode_waits(trace.result)
    ]


def _node_lines(trace: Trace, counts: TraceCounts) -> list[str]:
    nodes = _nodes(trace)
    owned: defaultdict[int, list[int]] = defaultdict(list)
    for entity in trace.entities.values():
        owned[entity.node].append(entity.id)
    rows = [("  node", "entities", "events", "outputs")]
    for node in nodes:
        own = owned[node.id]
        events = sum(_count(counts.events, entity) for entity in own)
        outputs = sum(_count(counts.outputs, entity) for entity in own)
        rows.append((f"  {printable(node.name)}", str(len(own)), str(events), str(outputs)))
    title = f"nodes: {len(nodes)}"
    return [title, *table(rows, right=frozenset((1, 2, 3)))] if nodes else [title]


def _guard_lines(trace: Trace) -> list[str]:
    """Return the calls that the guard handled, the most serious first."""
    left_out = printable(trace.metadata(METADATA_GUARD).get("left_out", ""))
    lines = ["", f"state hashes leave out: {_short(left_out)}"] if left_out else []
    if not trace.guarded:
        return lines
    rows = [("  source", "done", "node", "call", "times", "code")]
    for met in sorted(trace.guarded, key=lambda met: (not met.is_finding, met.source, met.node)):
        row = (f"  {met.source.value}", met.mode.value, printable(met.node) or "-")
        places = trace.finding_places.get((met.node, met.call), [])
        code = printable(places_text(places, ", ")) or "-"
        rows.append((*row, printable(met.call), str(met.count), code))
    findings = sum(met.count for met in trace.guarded if met.is_finding)
    title = f"guard findings: {findings}" if findings else "guard: no findings"
    return [*lines, "", title, *table(rows, right=frozenset((4,)))]


def _drop_lines(trace: Trace) -> list[str]:
    """Return the messages that full queues dropped."""
    rows = [("  dropped", "depth", "node", "kind", "name", "queue")]
    for drop in decode_drops(trace.result):
        entity = trace.entities.get(drop.entity)
        if entity is None:
            continue
        whose = "the publisher's, in an outage" if drop.in_outage else "its own"
        row = (f"  {drop.count}", str(drop.depth), _owner(trace, entity), entity.kind.label)
        rows.append((*row, printable(entity.name) or "-", whose))
    return ["", "full queues", *table(rows, right=frozenset((0, 1)))] if rows[1:] else []


def _entity_lines(
    trace: Trace, counts: TraceCounts, show_all: bool, width: int | None
) -> list[str]:
    entities = _entities(trace, counts)
    shown = [e for e in entities if show_all or not _idle_built_in(e, counts)]
    title = f"entities: {len(entities)}"
    if not entities:
        return [title]
    if len(shown) < len(entities):
        left_out = len(entities) - len(shown)
        title += f"  ({left_out} unused built-in ones are hidden; --all shows them)"
    rows = [("  id", "node", "kind", "name", "type", "events", "outputs", "Hz", "code")]
    for entity in shown:
        rate = counts.rate_hz(entity.id) if entity.id else None
        rows.append(
            (
                f"  {entity.id}",
                _owner(trace, entity),
                entity.kind.label,
                printable(entity.name) or "-",
                printable(entity.type) or "-",
                str(_count(counts.events, entity.id)),
                str(_count(counts.outputs, entity.id)),
                "-" if rate is None else f"{rate:.4g}",
                printable(places_text(entity_places(trace, entity), ", ")) or "-",
            )
        )
    lines = table(rows, right=frozenset((0, 5, 6, 7)), width=width, optional=_OPTIONAL)
    missing = [name for name in rows[0] if name.strip() not in lines[0].split()]
    note = f"  (no room for {', '.join(missing)}: pipe into less -S to see all)"
    return [title, *lines, *([note] if missing else [])]


def _as_json(trace: Trace, counts: TraceCounts) -> dict[str, Any]:
    return {
        "trace": trace.name,
        "size_bytes": trace.size,
        "format_version": FORMAT_VERSION,
        "library": trace.header.library,
        "complete": trace.complete,
        "digest": _digest(trace),
        "native": native_json(trace) if is_native(trace) else None,
        "start_ns": trace.start_ns,
        "end_ns": trace.end_ns,
        "duration_ns": _duration_ns(trace),
        "events": trace.event_count,
        "outputs": trace.output_count,
        "event_kinds": _counts_by_kind(counts.event_kinds, EventKind),
        "output_kinds": _counts_by_kind(counts.output_kinds, OutputKind),
        "result": trace.result,
        "job": trace.job,
        "edits": list(trace.edits),
        "environment": trace.environment,
        "guard": [
            {
                "source": met.source.value,
                "mode": met.mode.value,
                "node": met.node,
                "call": met.call,
                "count": met.count,
            }
            for met in trace.guarded
        ],
        "drops": [asdict(drop) for drop in decode_drops(trace.result)],
        "nodes": [node.name for node in _nodes(trace)],
        "entities": [
            {
                "id": entity.id,
                "node": entity.node,
                "kind": entity.kind.name.lower(),
                "name": entity.name,
                "type": entity.type,
                "created_ns": entity.created_ns,
                "detail": entity.detail,
                "code": entity_places(trace, entity),
                "events": _count(counts.events, entity.id),
                "outputs": _count(counts.outputs, entity.id),
                "rate_hz": counts.rate_hz(entity.id),
            }
            for entity in _entities(trace, counts)
        ],
        "topics": [
            {
                "name": channel.topic,
                "type": channel.type,
                "messages": trace.message_counts.get(channel.id, 0),
            }
            for channel in trace.channels.values()
        ],
    }


def _nodes(trace: Trace) -> list[Entity]:
    return [e for e in trace.entities.values() if e.kind is EntityKind.NODE]


def _entities(trace: Trace, counts: TraceCounts) -> list[Entity]:
    """Return all entities; the run itself only if it had events."""
    return [
        entity
        for entity in sorted(trace.entities.values(), key=lambda e: e.id)
        if entity.id or _count(counts.events, 0) or _count(counts.outputs, 0)
    ]


def _idle_built_in(entity: Entity, counts: TraceCounts) -> bool:
    """Whether ``entity`` is one that rclpy creates in every node, and was not used."""
    if _count(counts.events, entity.id) or _count(counts.outputs, entity.id):
        return False
    return is_built_in(entity)


def _owner(trace: Trace, entity: Entity) -> str:
    owner = trace.entities.get(entity.node)
    return printable(owner.name) if owner is not None and owner.name else "-"


def _duration_ns(trace: Trace) -> int:
    return max(trace.end_ns - trace.start_ns, 0)


def _count(series: Mapping[int, Any], entity: int) -> int:
    return series[entity].count if entity in series else 0


def _by_kind(total: int, counts: Mapping[int, int], kinds: _Kinds) -> str:
    parts = ", ".join(f"{name} {n}" for name, n in _counts_by_kind(counts, kinds).items())
    return f"{total}  ({parts})" if parts else str(total)


def _counts_by_kind(counts: Mapping[int, int], kinds: _Kinds) -> dict[str, int]:
    return {kind_label(kinds, number): n for number, n in sorted(counts.items())}
