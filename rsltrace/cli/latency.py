"""``rsltrace latency``: how long data takes from a topic to another, through nodes."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rsltrace.checks.latency.measure import measure_latencies
from rsltrace.cli.output.latency_text import (
    as_csv,
    as_json,
    compared_json,
    compared_text,
    text,
)
from rsltrace.errors import TraceError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace

if TYPE_CHECKING:
    from rsltrace.checks.latency.measure import Latencies


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("other", type=click.Path(path_type=Path), required=False)
@click.option("--from", "start", metavar="TOPIC", help="Only chains that begin with this topic.")
@click.option(
    "--to", "end", metavar="TOPIC", help="Only chains that end with this topic, or in this node."
)
@click.option(
    "--chain",
    metavar="TOPIC,TOPIC,…",
    help="One chain, by all of its topics: /scan,/objects,/cmd_vel (a node may be the last).",
)
@click.option(
    "--via",
    multiple=True,
    metavar="NODE",
    help="A node (or a glob of nodes) that makes use of the last message that it received, as a "
    "timer does that samples. Can be given several times.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(("text", "json", "csv")),
    default="text",
    show_default=True,
    help="What to print: tables, JSON, or a line for each output of each chain.",
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
    """Print how long data takes through the chains of TRACE, from a sensor to an actuator; of two
    traces side by side, with the difference.

    A chain is a row of topics: each message but the first was published because of the one before.
    Without options all chains are found, from messages that nothing caused (timers, bags) to those
    that caused nothing. Times are simulated: those of --chain and of --from to --to lie between two
    messages leaving their publishers.

    \b
    latency         from an input to the first output that came of it
    data age        how old the input of an output is when that leaves
    ... at most     the same, when the next output leaves
    reaction        from an input to the first output that came of it, or of a later one
    ... at worst    the same, from the input before: what happens right after it waits as long

    \b
    link   a message is on its way          held   the node has taken it, and waits
    queue  it waits for the callback        runs   the callback that publishes is running
    """
    topics = _topics(chain, start, end)
    if form == "csv" and other is not None:
        raise click.UsageError("--format csv is for one trace")
    with ExitStack() as stack:
        opened = [stack.enter_context(Trace.open(one)) for one in (trace, other) if one is not None]
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
            "--chain says where the chain begins and ends: leave --from and --to"
        )
    topics = tuple(topic.strip() for topic in chain.split(","))
    if len(topics) < 2 or not all(topics):
        raise click.BadParameter(
            f"{chain!r} is no chain: give its topics, as in /scan,/objects,/cmd_vel",
            param_hint="--chain",
        )
    return topics


def _print(trace: Path, other: Path | None, found: Sequence[Latencies]) -> None:
    if not any(one.chains for one in found):
        notes = "".join(f"\n  {note}" for one in found for note in one.notes)
        raise TraceError(f"{trace}: no message was caused by another one; there is no chain{notes}")
    lines = text(found[0]) if other is None else compared_text(*found)
    say("\n".join(map(printable, lines)))
    for note in dict.fromkeys(note for one in found for note in one.notes):
        tell(printable(f"rsltrace: note: {note}"))
    worst = found[0].chains[0].worst("latency") if other is None else None
    if worst is not None:
        tell(f"next: rsltrace view {shlex.quote(str(trace))} --at {worst.output_event}")
