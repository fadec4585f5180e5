"""``rsltrace latency``: end-to-end latencies of chains."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import click

from rsltrace.checks.latency.measure import Latencies, measure_latencies
from rsltrace.cli.output.latency_text import (
    as_csv,
    as_json,
    compared_json,
    compared_text,
    text,
)
from rsltrace.errors import TraceError
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import notes_on


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
            for line in as_csv(found[0]):
                say(printable(line))
        elif form == "json":
            values = as_json(found[0]) if other is None else compared_json(*found)
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
    lines = text(found[0]) if other is None else compared_text(*found)
    say("\n".join(map(printable, lines)))
    tell_notes(dict.fromkeys(note for one in found for note in one.notes))
    worst = found[0].chains[0].worst("latency") if other is None else None
    if worst is not None:
        tell(f"next: rsltrace view {shlex.quote(str(trace))} --at {worst.output_event}")
