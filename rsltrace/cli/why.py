"""``rsltrace why``: why a callback did not come, or came late."""

from __future__ import annotations

import json
from pathlib import Path

import click

from rsltrace.cli.cat import RunTimeParam
from rsltrace.job.values.times import TimeInRun
from rsltrace.terminal import say, tell, tell_notes
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.phrases import notes_on, path_word


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("node")
@click.argument("what", metavar="TOPIC|CALLBACK", default="")
@click.option(
    "--at",
    type=RunTimeParam(),
    metavar="T",
    help="Ask about time T of the run: seconds, or with a unit (90s, 5ms). @T is a simulated time.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def why(trace: Path, node: str, what: str, at: TimeInRun | None, as_json: bool) -> int:
    """Say why a callback of NODE did not come, or came late.

    TOPIC is that of a subscription, or the name of a service or client; CALLBACK is the function
    of one of these or of a timer (Planner.on_scan, or on_scan), or the number of an entity.
    Without either, those of the node are listed.

    Without --at, the whole run is looked at: the first message that the callback did not get, else
    the one it got latest. The line of code is that of what is to blame.

    Exit status: 0 if the callback ran as expected, 1 if there is a reason why it did not, 2 if
    there is no such node, topic or callback.
    """
    from rsltrace.why.answer import AsExpected, answer_lines
    from rsltrace.why.answer import as_json as reason_json
    from rsltrace.why.answer import why as find_reason

    with Trace.open(trace) as opened:
        tell_notes(notes_on(opened))
        at_ns = None if at is None else at.stamp_ns(opened.start_ns, opened.end_ns)
        reason = find_reason(opened, node, what, at_ns)
        if as_json:
            say(json.dumps(reason_json(reason), indent=2))
        else:
            say("\n".join(answer_lines(reason)))
    if reason.event is not None and not as_json:
        tell(f"next: rsltrace view {path_word(str(trace))} --at {reason.event}")
    return int(not isinstance(reason, AsExpected))
