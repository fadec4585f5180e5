"""``rsltrace latency``: end-to-end latencies of chains."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from rsltrace.checks.latency.instances import HopMessages, HopTimes, LatencyFigures, figures
from rsltrace.checks.latency.measure import MEASURES, ChainLatency, Latencies, measure_latencies
from rsltrace.errors import TraceError
from rsltrace.terminal import say, tell, tell_notes, terminal_width
from rsltrace.trace.model.texts import format_duration, format_seconds, printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.phrases import notes_on, table


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("other", type=click.Path(path_type=Path), required=False)
@click.option(
    "--from", "start", metavar="TOPIC", help="Show only chains that start with this topic."
)
@click.option(
    "--to",
    "end",
    metavar="TOPIC",
    help="Show only chains that end with this topic or in this node.",
)
@click.option(
    "--chain",
    metavar="TOPIC,TOPIC,…",
    help="Show one chain, given by its topics: /scan,/objects,/cmd_vel. The last may be a node.",
)
@click.option(
    "--via",
    multiple=True,
    metavar="NODE",
    help="Treat this node (or glob) as one that samples: its outputs depend on the last message "
    "that it received. Repeatable.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json", "csv")),
    default="text",
    show_default=True,
    help="Print tables, JSON, or CSV with a line per output of each chain.",
)
def latency(
    trace: Path,
    other: Path | None,
    start: str | None,
    end: str | None,
    chain: str | None,
    via: tuple[str, ...],
    form: str,
) -> None:
    """Measure the end-to-end latencies of the chains in TRACE, or compare those of two traces.

    A chain is a sequence of topics in which each message was published because of the one before.
    Without options, all chains are shown, from messages without a cause (timers, bags) to messages
    without an effect. Times are simulated, and measured from publish to publish.

    \b
    latency         from an input to the first output that it caused
    data age        from an input to the output that used it
    ... at most     from an input to the next output after that
    reaction        from an input to the first output that it or a later input caused
    ... at worst    the same, from the input before: the worst case of an event between two inputs

    \b
    link   the message is in transit         held   the node has received it and waits
    queue  it waits for the callback         runs   the callback that publishes is running
    """
    topics = _topics(chain, start, end)
    if form == "csv" and other is not None:
        raise click.UsageError("--format csv needs a single trace")
    with ExitStack() as stack:
        opened = [stack.enter_context(Trace.open(one)) for one in (trace, other) if one is not None]
        for one in opened:
            tell_notes(notes_on(one))
        found = [
            measure_latencies(one, start=start, end=end, topics=topics, via=via) for one in opened
        ]
        if form == "csv":
            for line in _as_csv(found[0]):
                say(printable(line))
        elif form == "json":
            values = _as_json(found[0]) if other is None else _compared_json(*found)
            say(json.dumps(values, indent=2))
        else:
            _print(trace, other, found)


def _topics(chain: str | None, start: str | None, end: str | None) -> tuple[str, ...]:
    if chain is None:
        return ()
    if start is not None or end is not None:
        raise click.UsageError(
            "--chain already sets the first and last topic: leave out --from and --to"
        )
    topics = tuple(topic.strip() for topic in chain.split(","))
    if len(topics) < 2 or not all(topics):
        raise click.BadParameter(
            f"{chain!r} is not a chain: give its topics, such as /scan,/objects,/cmd_vel",
            param_hint="--chain",
        )
    return topics


def _print(trace: Path, other: Path | None, found: Sequence[Latencies]) -> None:
    if not any(one.chains for one in found):
        notes = "".join(f"\n  {note}" for one in found for note in one.notes)
        raise TraceError(f"{trace} has no chain: no message was caused by another one{notes}")
    lines = _as_text(found[0]) if other is None else _compared_text(*found)
    say("\n".join(map(printable, lines)))
    tell_notes(dict.fromkeys(note for one in found for note in one.notes))
    worst = found[0].chains[0].worst("latency") if other is None else None
    if worst is not None:
        tell(f"next: rsltrace view {shlex.quote(str(trace))} --at {worst.output_event}")


# Chains as text, JSON and CSV.


_WORDS = {
    "latency": "latency",
    "age": "data age",
    "last_age": "... at most",
    "reaction": "reaction",
    "worst_reaction": "... at worst",
}
_PARTS = ("link", "queue", "held", "runs")
_PASSED = ("sent", "received", "lost", "overwritten", "waiting", "used")
_QUANTILES = ("min", "p50", "p95", "p99", "max", "jitter")
_NAMED = ("input_event", "input_ns", "output_event", "output_ns")
_NUMBERS = frozenset(range(1, 12))


def _as_text(found: Latencies) -> list[str]:
    """Return the chains of a trace as lines."""
    lines: list[str] = []
    for one in found.chains:
        lines += [*([""] if lines else []), *_head(one)]
        rows: list[tuple[str, ...]] = [("  ", "count", *_QUANTILES)]
        rows += [_row(measure, one.figures(measure)) for measure in MEASURES]
        lines += [*table(rows, right=_NUMBERS), *_hops(one)]
        worst = one.worst("latency")
        if worst is not None:
            lines.append(
                f"  longest: {format_duration(worst.duration_ns)} from event {worst.input_event} "
                f"({format_seconds(worst.input_ns)} s) to event {worst.output_event} "
                f"({format_seconds(worst.output_ns)} s)"
            )
    return lines


def _head(one: ChainLatency) -> list[str]:
    nodes = " → ".join(hop.node or RUN_NAME for hop in one.hops)
    return [one.name, f"  published by {nodes}; {one.inputs} inputs, {one.outputs} outputs"]


def _row(measure: str, of: LatencyFigures | None) -> tuple[str, ...]:
    if of is None:
        return (f"  {_WORDS[measure]}", "0", *("-" for _ in _QUANTILES))
    return (
        f"  {_WORDS[measure]}",
        str(of.count),
        *(format_duration(_value(of, q), 4) for q in _QUANTILES),
    )


def _value(of: LatencyFigures, quantile: str) -> int:
    value: int = getattr(of, f"{quantile}_ns")
    return value


def _hops(one: ChainLatency) -> list[str]:
    rows: list[tuple[str, ...]] = [("  mean (max) of outputs", *_PARTS, *_PASSED)]
    for hop, after, parts, passed in zip(
        one.hops[:-1], one.hops[1:], one.parts, one.passages, strict=True
    ):
        times = [_mean_and_max(getattr(parts, part)) for part in _PARTS]
        counts = [str(getattr(passed, name)) for name in _PASSED]
        rows.append((f"  {hop.topic} → {after.node or RUN_NAME}", *times, *counts))
    lines, width = table(rows, right=_NUMBERS), terminal_width()
    if width is None or all(len(line) <= width for line in lines):
        return lines
    spent = [row[: 1 + len(_PARTS)] for row in rows]
    passages = [("  messages", *_PASSED), *((row[0], *row[len(spent[0]) :]) for row in rows[1:])]
    return [*table(spent, right=_NUMBERS), *table(passages, right=_NUMBERS)]


def _mean_and_max(durations: Any) -> str:
    if not len(durations):
        return "-"
    most = int(durations.max())
    return f"{format_duration(durations.mean(), 4)} ({format_duration(most, 4)})" if most else "0"


def _as_json(found: Latencies) -> dict[str, Any]:
    """Return the chains of a trace as JSON-compatible values; times in ns."""
    return {"chains": [_chain(one) for one in found.chains], "notes": list(found.notes)}


def _chain(one: ChainLatency) -> dict[str, Any]:
    return {
        "name": one.name,
        "hops": [hop._asdict() for hop in one.hops],
        "inputs": one.inputs,
        "outputs": one.outputs,
        **{measure: _measure(one, measure) for measure in MEASURES},
        "between": [
            _between(parts, passed) for parts, passed in zip(one.parts, one.passages, strict=True)
        ],
    }


def _measure(one: ChainLatency, measure: str) -> dict[str, Any] | None:
    of, worst = one.figures(measure), one.worst(measure)
    if of is None or worst is None:
        return None
    return {**_figures(of), "worst": asdict(worst)}


def _figures(of: LatencyFigures) -> dict[str, Any]:
    return {**asdict(of), "jitter_ns": of.jitter_ns}


def _between(parts: HopTimes, passed: HopMessages) -> dict[str, Any]:
    times = {part: figures(getattr(parts, part)) for part in _PARTS}
    return {
        **{part: None if of is None else _figures(of) for part, of in times.items()},
        **asdict(passed),
    }


def _as_csv(found: Latencies) -> Iterator[str]:
    """Yield a header, then a line for each output of each chain. Times in ns, summed over hops."""
    yield ",".join(("chain", "first", *_NAMED, "age_ns", *(f"{part}_ns" for part in _PARTS)))
    for one in found.chains:
        came = one.found
        events, ages, first = one.events(), came.ages_ns().tolist(), set(came.first.tolist())
        inputs = came.input_ns[came.source].tolist()
        sums = [sum(getattr(parts, part) for parts in one.parts).tolist() for part in _PARTS]
        rows = zip(
            events[:, 0].tolist(),
            inputs,
            events[:, -1].tolist(),
            came.output_ns.tolist(),
            ages,
            *sums,
            strict=True,
        )
        for place, row in enumerate(rows):
            line = io.StringIO()
            csv.writer(line, lineterminator="").writerow((one.name, int(place in first), *row))
            yield line.getvalue()


def _compared_text(a: Latencies, b: Latencies) -> list[str]:
    """Return the chains of two traces as lines, side by side."""
    lines: list[str] = []
    for one, other in _pairs(a, b):
        some = one or other
        assert some is not None
        nodes = " → ".join(hop.node or RUN_NAME for hop in some.hops)
        lines += [*([""] if lines else []), some.name, f"  published by {nodes}"]
        if one is None or other is None:
            lines.append(f"  only in {'a' if other is None else 'b'}: {some.outputs} outputs")
            continue
        lines.append(
            f"  a: {one.inputs} inputs, {one.outputs} outputs; "
            f"b: {other.inputs} inputs, {other.outputs} outputs"
        )
        rows: list[tuple[str, ...]] = [("  ", "", *_QUANTILES)]
        for measure in MEASURES:
            rows += _compared_rows(measure, one.figures(measure), other.figures(measure))
        lines += table(rows, right=frozenset(range(2, 12)))
    return lines


def _compared_rows(
    measure: str, a: LatencyFigures | None, b: LatencyFigures | None
) -> Iterator[tuple[str, ...]]:
    for name, of in (("a", a), ("b", b)):
        values = ["-" if of is None else format_duration(_value(of, one), 4) for one in _QUANTILES]
        yield f"  {_WORDS[measure]}" if name == "a" else "", name, *values
    if a is not None and b is not None:
        by = [_value(b, one) - _value(a, one) for one in _QUANTILES]
        yield "", "b − a", *(format_duration(ns, 4, signed=True) if ns else "0" for ns in by)


def _compared_json(a: Latencies, b: Latencies) -> dict[str, Any]:
    """Return the chains of two traces as JSON-compatible values."""
    return {
        "chains": [
            {
                "name": (one or other).name,  # type: ignore[union-attr]  # one of them is there
                "a": None if one is None else _chain(one),
                "b": None if other is None else _chain(other),
                "difference": None if one is None or other is None else _difference(one, other),
            }
            for one, other in _pairs(a, b)
        ],
        "notes": list(dict.fromkeys((*a.notes, *b.notes))),
    }


def _difference(a: ChainLatency, b: ChainLatency) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for measure in MEASURES:
        of_a, of_b = a.figures(measure), b.figures(measure)
        if of_a is not None and of_b is not None:
            values[measure] = {f"{q}_ns": _value(of_b, q) - _value(of_a, q) for q in _QUANTILES}
    return values


def _pairs(a: Latencies, b: Latencies) -> list[tuple[ChainLatency | None, ChainLatency | None]]:
    of_a, of_b = ({one.hops: one for one in found.chains} for found in (a, b))
    return [(of_a.get(hops), of_b.get(hops)) for hops in dict.fromkeys((*of_a, *of_b))]
